"""Publishing when single file operations fail; power cuts; locks. `--sweep 1` tests every operation."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tcmrl_data import Dataset, Recipe, open_dataset
from tcmrl_data.build.driver import check_part
from tcmrl_data.build.plan import BuildPlan
from tcmrl_data.foundation import disk as publish
from tcmrl_data.foundation.disk import LOCK, STAGING, lock_file, lock_holder, publish_folder, remove_abandoned
from tcmrl_data.foundation.errors import LockedError, StorageError, TcmrlError
from tcmrl_data.store.layout import GROUP
from tcmrl_data.store.manifest import part_folder, read_manifest
from tests.simulated_disk import (
    FAULTS,
    Fault,
    Operation,
    PowerCut,
    PreparedParts,
    RecordingDisk,
    run_with_fault,
)

TASK = 3


@pytest.fixture(scope="module")
def parts(tiny: Dataset, tiny_recipe: Recipe) -> PreparedParts:
    return PreparedParts(tiny, tiny_recipe, TASK)


@pytest.fixture
def memory() -> Iterator[Path]:
    """A folder in memory if the system has one, because thousands of syncs on a disk are slow."""
    shared = Path("/dev/shm")
    base = shared if os.access(shared, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=base) as folder:
        yield Path(folder)


@pytest.fixture
def log(parts: PreparedParts, memory: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[Operation]]:
    """A finished build, and all file operations that produced it."""
    recorder = RecordingDisk()
    (memory / "whole").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(publish, "disk", recorder)
        parts.build(memory / "whole" / "data", patch)
    return memory / "whole", recorder.log


def figures(text: str) -> None:
    """Prints the counts of a sweep; `pytest -s` shows them."""
    print(text)  # noqa: T201


def expect_whole(parts: PreparedParts, tiny: Dataset, out: Path) -> None:
    """Checks that one more build ends with every part of the reference and with an empty staging folder."""
    with pytest.MonkeyPatch.context() as patch:
        report = parts.build(out, patch)
    assert report.failed == ()
    ids = {part.step: part.id for part in read_manifest(out).parts}
    assert ids == {part.step: part.id for part in tiny.manifest.parts if part.task == TASK}
    assert read_manifest(out).complete
    open_dataset(out)
    assert list((out / STAGING).iterdir()) == []


@pytest.mark.parametrize("fault", FAULTS)
def test_one_more_build_recovers_from_a_fault_at_any_operation(
    parts: PreparedParts,
    tiny: Dataset,
    memory: Path,
    log: tuple[Path, list[Operation]],
    fault: Fault,
    sweep: int,
) -> None:
    operations = len(log[1])
    tried = range(FAULTS.index(fault) % sweep, operations, sweep)
    for at in tried:
        out = memory / f"{fault}-{at}" / "data"
        out.parent.mkdir()
        status = run_with_fault(parts, out, at, fault)
        assert status == (-9 if fault in ("kill", "torn") else 1), f"operation {at} of {operations}: {status}"
        expect_whole(parts, tiny, out)
        shutil.rmtree(out.parent)
    figures(f"{fault}: {len(tried)} of {operations} operations failed, all recovered")


def states_after_power_cuts(
    root: Path, log: list[Operation], memory: Path, stride: int
) -> Iterator[tuple[str, Path]]:
    """States after power cuts at every `stride`-th and last operation, with unsynced names lost or kept."""
    disk, work = PowerCut(root), memory / "cut"
    for index, operation in enumerate(log):
        disk.apply(operation)
        if index % stride and index != len(log) - 1:
            continue
        for names_survive in (False, True):
            work.mkdir()
            disk.leave(work, names_survive=names_survive)
            yield f"after operation {index}, names {'kept' if names_survive else 'lost'}", work / "data"
            shutil.rmtree(work)


def flaw(out: Path, *, finished: bool, tiny: Dataset) -> str | None:
    """The flaw after a power cut: a torn part, a lost part that the manifest names, or a lost build."""
    named = set()
    if (out / "manifest.json").exists():
        try:
            manifest = read_manifest(out)
        except TcmrlError as error:
            return str(error)
        named = {part.step for part in manifest.parts}
        if finished and not manifest.complete:
            return "the manifest of a finished build is not the last one"
    elif finished:
        return "the manifest of a finished build is lost"
    for step in tiny.snapshots(TASK):
        folder = out / part_folder(TASK, step)
        if not folder.is_dir():
            if step in named or finished:
                return f"part {step} is lost"
            continue
        try:
            check_part(folder)
        except TcmrlError as error:
            return str(error)
    for folder in (out, out / "tasks", *(out / part_folder(TASK, 0)).parents[:2]):
        group = folder / "zarr.json"
        if (group.exists() or finished) and (not group.exists() or group.read_bytes() != GROUP):
            return f"{folder} is no Zarr group"
    return None


def test_a_power_cut_at_any_moment_loses_nothing_that_was_published(
    parts: PreparedParts, tiny: Dataset, memory: Path, log: tuple[Path, list[Operation]], sweep: int
) -> None:
    root, operations = log
    states = 0
    for place, out in states_after_power_cuts(root, operations, memory, sweep):
        finished = f"after operation {len(operations) - 1}," in place
        assert flaw(out, finished=finished, tiny=tiny) is None, place
        out.mkdir(exist_ok=True)
        expect_whole(parts, tiny, out)
        states += 1
    figures(f"{states} states after power cuts, all recovered")


def test_every_sync_is_needed(tiny: Dataset, memory: Path, log: tuple[Path, list[Operation]]) -> None:
    """Without the syncs of any one kind of file or folder, some power cut tears or loses data."""
    root, operations = log

    def kind(operation: Operation) -> str | None:
        name = operation[1].relative_to(root).as_posix()
        return re.sub(r"[0-9a-f]{32}|(?<=step_)\d+", "#", name) if operation[0] == "sync" else None

    kinds = sorted({label for label in map(kind, operations) if label})
    for label in kinds:
        without = [operation for operation in operations if kind(operation) != label]
        last = f"after operation {len(without) - 1},"
        states = states_after_power_cuts(root, without, memory, stride=15)
        flaws = [found for place, out in states if (found := flaw(out, finished=last in place, tiny=tiny))]
        assert flaws, f"syncs of {label} could be left out"
    figures(f"syncs of {len(kinds)} kinds of files and folders left out one by one, every omission found")


def test_a_full_disk_ends_in_a_clear_error_and_a_resumable_dataset(
    parts: PreparedParts, tiny: Dataset, tmp_path: Path
) -> None:
    disk = tmp_path / "small"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=150k", "tmpfs", str(disk)], capture_output=True, check=False
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
    assert not (tmp_path / "data" / "tasks").exists()


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
        assert remove_abandoned(tmp_path) == ["dead.2", "lost.4", "manifest.json.3"]
        assert sorted(path.name for path in staging.iterdir()) == ["live.1", "live.1.lock"]
        holder.kill()
    assert remove_abandoned(tmp_path) == ["live.1"]


def test_two_builders_at_once_one_works_the_other_is_refused(
    parts: PreparedParts, tiny: Dataset, memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = memory / "data"
    out.mkdir()
    for _ in range(20):
        with lock_file(out / LOCK, "dataset"), pytest.raises(LockedError, match=f"process {os.getpid()} on"):
            parts.build(out, monkeypatch)
        expect_whole(parts, tiny, out)
        shutil.rmtree(out / "tasks")
        (out / "manifest.json").unlink()
    assert lock_holder(out / LOCK) is None
