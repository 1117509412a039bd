"""Publishing when single file operations fail; power cuts; locks. `--sweep 1` tests every operation."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tcmrl_data import Dataset, Recipe, open_dataset, verify_dataset
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.foundation import disk as publish
from tcmrl_data.foundation.disk import (
    LOCK,
    STAGING,
    abandoned,
    lock_file,
    lock_holder,
    publish_folder,
    remove_abandoned,
)
from tcmrl_data.foundation.errors import BuildError, LockedError, StorageError
from tcmrl_data.store import tables
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_COPY, read_manifest
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import PARTS, PartKey, part_file
from tests.simulated_disk import (
    FAULTS,
    LOSSES,
    Fault,
    Operation,
    PowerCut,
    PreparedParts,
    RecordingDisk,
    at_last_part,
    run_with_fault,
)

TASK = 3


@pytest.fixture(scope="module")
def parts(tiny: Dataset, tiny_recipe: Recipe) -> PreparedParts:
    return PreparedParts(tiny, tiny_recipe, [TASK])


def figures(text: str) -> None:
    """Prints the counts of a sweep; `pytest -s` shows them."""
    print(text)  # noqa: T201


def build(parts: PreparedParts, out: Path) -> None:
    """Builds; a unit that failed is an error."""
    with pytest.MonkeyPatch.context() as patch:
        failed = parts.build(out, patch).failed
    if failed:
        raise BuildError(failed[0])


def expect_whole(parts: PreparedParts, tiny: Dataset, out: Path) -> None:
    """Checks that one more build ends with each part of the reference once, and an empty staging folder."""
    with pytest.MonkeyPatch.context() as patch:
        report = parts.build(out, patch)
    assert report.failed == ()
    dataset = open_dataset(out)
    expected = [entry for task in parts.tasks for entry in tiny.parts.entries_of(task)]
    assert list(dataset.parts.entries()) == expected
    assert dataset.manifest.complete
    assert sorted(out.rglob("*.zip")) == sorted(out / part_file(entry.key) for entry in expected)
    assert verify_dataset(out).findings == ()
    assert list((out / STAGING).iterdir()) == []


@pytest.fixture(scope="module")
def half_built(parts: PreparedParts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A build that ended badly: a part in the log, a torn line, a part in no table, a damaged part."""
    out = tmp_path_factory.mktemp("half") / "data"
    with pytest.MonkeyPatch.context() as patch:
        at_last_part(parts, out, patch)
    table, seal = out / PARTS_TABLE, read_manifest(out).parts
    assert seal.lines == 1
    lines = table.read_bytes().splitlines(keepends=True)
    table.write_bytes(b"".join(lines[:2]) + lines[2][:50])
    damaged = out / part_file(PartKey(TASK, 150))
    damaged.write_bytes(damaged.read_bytes()[:5_000])
    (out / LOCK).unlink()
    return out


def copy_of(half_built: Path, out: Path, start: str) -> None:
    if start == "half built":
        shutil.copytree(half_built, out)


STARTS = ("new", "half built")


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("fault", FAULTS)
def test_one_more_build_recovers_from_a_fault_at_any_operation(
    parts: PreparedParts,
    tiny: Dataset,
    memory: Path,
    half_built: Path,
    fault: Fault,
    start: str,
    sweep: int,
) -> None:
    operations = len(logged(parts, half_built, memory, start))
    stride = max(1, sweep // 3)
    tried = range(FAULTS.index(fault) % stride, operations, stride)
    for at in tried:
        out = memory / f"{fault}-{at}" / "data"
        out.parent.mkdir()
        copy_of(half_built, out, start)
        status = run_with_fault(lambda: build(parts, out), at, fault)  # noqa: B023
        assert status == (-9 if fault in ("kill", "torn") else 1), f"operation {at} of {operations}: {status}"
        expect_whole(parts, tiny, out)
        shutil.rmtree(out.parent)
    figures(f"{fault}: {len(tried)} of {operations} operations failed, all recovered")


def logged(parts: PreparedParts, half_built: Path, memory: Path, start: str) -> list[Operation]:
    """All file operations of a build, in `memory`/whole."""
    recorder, out = RecordingDisk(), memory / "whole" / "data"
    out.parent.mkdir()
    copy_of(half_built, out, start)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(publish, "disk", recorder)
        patch.setattr(tables, "disk", recorder)
        parts.build(out, patch)
    return recorder.log


def states_after_power_cuts(
    root: Path, begun: Path | None, log: list[Operation], memory: Path, stride: int
) -> Iterator[tuple[str, Path, bool]]:
    """States after power cuts at every `stride`-th and last operation, with losses of every kind.

    Yields:
        Words, the dataset, and whether the build was finished before the power cut.
    """
    disk, work, last = PowerCut(root), memory / "cut", len(log) - 1
    if begun is not None:
        shutil.rmtree(root / "data")
        shutil.copytree(begun, root / "data")
        disk.load(root)
    for index, operation in enumerate(log):
        disk.apply(operation)
        if index % stride and index != last:
            continue
        for loss in LOSSES:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir()
            disk.leave(work, loss)
            yield f"after operation {index}, {loss} lost", work / "data", index == last


def flaw(out: Path, *, finished: bool) -> str | None:
    """The flaw after a power cut: a torn table or part, a lost part that a table names, or a lost build."""
    if not (out / MANIFEST).exists():
        return "the manifest of a finished build is lost" if finished else None
    findings = [finding for finding in verify_dataset(out).findings if not finding.foreign]
    if findings:
        return str(findings)
    return "a finished build is incomplete" if finished and not read_manifest(out).complete else None


@pytest.mark.parametrize("start", STARTS)
def test_a_power_cut_at_any_moment_loses_nothing_that_was_published(
    parts: PreparedParts, tiny: Dataset, memory: Path, half_built: Path, start: str, sweep: int
) -> None:
    operations = logged(parts, half_built, memory, start)
    begun = half_built if start == "half built" else None
    states = 0
    for place, out, finished in states_after_power_cuts(
        memory / "whole", begun, operations, memory, max(1, sweep // 4)
    ):
        assert flaw(out, finished=finished) is None, place
        out.mkdir(exist_ok=True)
        expect_whole(parts, tiny, out)
        states += 1
    figures(f"{states} states after power cuts, all recovered")


@pytest.mark.check
def test_every_sync_is_needed(parts: PreparedParts, half_built: Path, memory: Path) -> None:
    """Without the syncs of any one kind of file or folder, some power cut tears or loses data."""
    root, operations = memory / "whole", logged(parts, half_built, memory, "new")

    def kind(operation: Operation) -> str | None:
        name = re.sub(r"[0-9a-f]{32}|[0-9]{7}", "#", operation[1].relative_to(root).as_posix())
        return name if operation[0] == "sync" and "nodes.#" not in name else None

    kinds = sorted({label for label in map(kind, operations) if label})
    assert len(kinds) == 10, kinds
    for label in kinds:
        without = [operation for operation in operations if kind(operation) != label]
        states = states_after_power_cuts(root, None, without, memory, stride=3)
        flaws = (found for _, out, finished in states if (found := flaw(out, finished=finished)))
        assert next(flaws, None), f"syncs of {label} could be left out"
    figures(f"syncs of {len(kinds)} kinds of files and folders left out one by one, every omission found")


def test_a_full_disk_ends_in_a_clear_error_and_a_resumable_dataset(
    parts: PreparedParts, tiny: Dataset, tmp_path: Path
) -> None:
    disk = tmp_path / "small"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=72k", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"no tmpfs can be mounted here: {mounted.stderr.decode().strip()}")
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(BuildPlan, "part_bytes", 0)  # skips the check of free space
            (failure,) = parts.build(disk / "data", patch).failed
        assert "No space left on device; make room" in failure
        subprocess.run(["mount", "-o", "remount,size=10m", str(disk)], check=True)
        expect_whole(parts, tiny, disk / "data")
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_too_little_space_is_said_before_the_start(
    parts: PreparedParts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(BuildPlan, "part_bytes", 10**15)
    with pytest.raises(StorageError, match=r"3 parts take up to 3000.0 TB, \d+\.\d [kMGT]B are free"):
        parts.build(tmp_path / "data", monkeypatch)
    assert not (tmp_path / "data" / PARTS).exists()


def test_a_folder_that_stands_there_is_left_alone(tmp_path: Path) -> None:
    target = tmp_path / "target"
    assert publish_folder(tmp_path, target, {"a": b"1", "deep/b": b"2"}, attempt="x")
    assert not publish_folder(tmp_path, target, {"a": b"other"}, attempt="x")
    assert (target / "a").read_bytes() == b"1"
    assert list((tmp_path / STAGING).iterdir()) == []


HOLD = """
import sys
from pathlib import Path
from tcmrl_data.foundation.disk import lock_file
with lock_file(Path(sys.argv[1]), "the attempt"):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_gc_never_removes_a_live_attempt(tmp_path: Path) -> None:
    staging = tmp_path / STAGING
    for name in ("live.1", "dead.2", "lost.4"):
        (staging / name).mkdir(parents=True)
        (staging / f"{name}.lock").touch()
    (staging / "lost.4.lock").unlink()
    (staging / "manifest.json.3").touch()
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(staging / "live.1.lock")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        assert lock_holder(staging / "live.1.lock") == f"process {holder.pid} on {os.uname().nodename}"
        assert [path.name for path in abandoned(tmp_path)] == ["dead.2", "lost.4", "manifest.json.3"]
        remove_abandoned(tmp_path)
        assert sorted(path.name for path in staging.iterdir()) == ["live.1", "live.1.lock"]
        holder.kill()
    remove_abandoned(tmp_path)
    assert list(staging.iterdir()) == []


def test_two_builders_at_once_one_works_the_other_is_refused(
    parts: PreparedParts, tiny: Dataset, memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = memory / "data"
    out.mkdir()
    for _ in range(20):
        with lock_file(out / LOCK, "dataset"), pytest.raises(LockedError, match=f"process {os.getpid()} on"):
            parts.build(out, monkeypatch)
        expect_whole(parts, tiny, out)
        shutil.rmtree(out / PARTS)
        for name in (MANIFEST, MANIFEST_COPY):
            (out / name).unlink()
    assert lock_holder(out / LOCK) is None
