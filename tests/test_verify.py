"""Verification names every changed file; repaired parts keep their ids; gc removes only unused files."""

import contextlib
import itertools
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from tcmrl_cli.data import data
from tcmrl_cli.frame import run

import tcmrl_data
from tcmrl_data import open_dataset, repair_dataset, verify_dataset
from tcmrl_data.build.events import EVENTS
from tcmrl_data.foundation.disk import CHECKPOINTS, LOCK, STAGING, lock_file, replace_file
from tcmrl_data.foundation.errors import (
    BuildError,
    LockedError,
    ManifestError,
    NondeterminismError,
)
from tcmrl_data.store import sealing
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.keys import PARTS, PartKey, part_file, part_folder
from tcmrl_data.store.manifest import MANIFEST, read_manifest
from tcmrl_data.store.part_record import read_part_record
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import read_lines
from tcmrl_data.store.task_table import TASKS
from tcmrl_data.verification import repair as repair_module
from tcmrl_data.verification import replay as replay_module
from tcmrl_data.verification.garbage import collect_garbage
from tests.forged_datasets import PART, STEP, Forge, base

Copy = Callable[[], Path]


@pytest.fixture(scope="module")
def sound(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two parts of the tiny dataset; every test restores them after damaging them."""
    return base(tiny_folder, tmp_path_factory.mktemp("rot") / "dataset")


@pytest.fixture
def forge(tiny_folder: Path, tmp_path: Path) -> Forge:
    (tmp_path / "outside").mkdir()
    return Forge(base(tiny_folder, tmp_path / "data"), tmp_path / "outside")


def data_files(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and not path.relative_to(folder).parts[0].startswith((".", EVENTS))
    )


def found(folder: Path) -> set[str]:
    return {finding.file for finding in verify_dataset(folder).findings}


def flip(data: bytes, chance: random.Random) -> bytes:
    bad = bytearray(data)
    bad[chance.randrange(len(bad))] ^= 1 << chance.randrange(8)
    return bytes(bad)


def truncate(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data))]


def delete(data: bytes, chance: random.Random) -> None:
    return None


Rot = Callable[[bytes, random.Random], bytes | None]


def rot_everywhere(folder: Path, damage: Rot, *, rounds: int) -> int:
    """Damages every file in turn; verification must name only that file. Returns the number of cases."""
    chance, cases = random.Random(0), 0
    for file in data_files(folder):
        good = file.read_bytes()
        for _ in range(rounds):
            bad = damage(good, chance)
            file.unlink() if bad is None else file.write_bytes(bad)
            cases += 1
            assert found(folder) == {str(file.relative_to(folder))}
        file.write_bytes(good)
    assert found(folder) == set()
    sys.stdout.write(f"{damage.__name__}: {cases} of {cases} found\n")
    return cases


@pytest.mark.parametrize(("damage", "rounds"), [(flip, 40), (truncate, 10), (delete, 1)])
def test_every_damaged_file_is_found_and_no_other(sound: Path, damage: Rot, rounds: int) -> None:
    assert rot_everywhere(sound, damage, rounds=rounds) == 5 * rounds


def test_every_added_file_is_found(sound: Path) -> None:
    cases = 0
    folders = {file.parent for file in data_files(sound)} | {sound}
    for folder in sorted(folders):
        for name in ("0.bak", "0000150.zip~", ".hidden"):
            (folder / name).write_bytes(b"x")
            cases += 1
            assert found(sound) == {str((folder / name).relative_to(sound))}
            (folder / name).unlink()
        (folder / "empty").mkdir()
        cases += 1
        assert found(sound) == {str((folder / "empty").relative_to(sound))}
        (folder / "empty").rmdir()
    assert found(sound) == set()
    sys.stdout.write(f"additions: {cases} of {cases} found\n")


def test_every_swap_of_two_files_that_differ_is_found(sound: Path) -> None:
    files, cases = data_files(sound), 0
    for left, right in itertools.combinations(files, 2):
        first, second = left.read_bytes(), right.read_bytes()
        if first == second:
            continue
        left.write_bytes(second)
        right.write_bytes(first)
        cases += 1
        names = found(sound)
        # without a manifest nothing is known of the tables
        known = {MANIFEST} if MANIFEST in (left.name, right.name) else {left.name, right.name}
        parts = {str(file.relative_to(sound)) for file in (left, right) if file.suffix == ".zip"}
        assert names == parts | (known & {MANIFEST, TASKS, PARTS_TABLE})
        left.write_bytes(first)
        right.write_bytes(second)
    assert found(sound) == set()
    sys.stdout.write(f"swaps: {cases} of {cases} found\n")
    assert cases == 10


def test_work_files_are_no_data(sound: Path) -> None:
    for name in (LOCK, EVENTS):
        (sound / name).write_text("anything")
    (sound / STAGING).mkdir(exist_ok=True)
    (sound / CHECKPOINTS / "task_00003").mkdir(parents=True)
    (sound / CHECKPOINTS / "task_00003" / "x").touch()
    assert found(sound) == set()


def test_levels_look_ever_closer(forge: Forge) -> None:
    """Digests find a flipped bit; only the deep level finds forged values."""
    content = forge.read("rewards/c/0")
    flipped = content[:-1] + bytes([content[-1] ^ 1])
    archive = forge.part.read_bytes()
    forge.part.write_bytes(archive.replace(content, flipped))
    assert verify_dataset(forge.folder, level="quick").findings == ()
    assert found(forge.folder) == {PART}
    forge.part.write_bytes(archive)
    forge.write("rewards/c/0", flipped)
    assert verify_dataset(forge.folder).findings == ()
    (finding,) = verify_dataset(forge.folder, level="deep").findings
    assert finding.file == PART
    assert "arrays/rewards/c/0" in finding.problem and "checksum" in finding.problem


@pytest.mark.parametrize(
    ("name", "row", "value", "problem"),
    [
        ("observations", 5, np.inf, "not finite, first in row 5"),
        ("actions", 5, 1.5, r"reach 1.5, outside [-1, 1]"),
        ("rewards", 5, 100.0, "statistics.mean"),
        ("terminated", 5, True, "before the last step of episode 0"),
        ("truncated", 19, False, "at the end of episode 0"),
        ("observations", 5, 100.0, "statistics.moments"),
    ],
)
def test_a_deep_look_finds_values_that_cannot_be(
    forge: Forge, name: str, row: int, value: float, problem: str
) -> None:
    forge.values(name, lambda array: array.__setitem__(row, value))
    findings = verify_dataset(forge.folder, level="deep").findings
    assert any(
        problem in finding.problem and (finding.task, finding.step) == (0, STEP) for finding in findings
    ), findings
    assert verify_dataset(forge.folder).findings == ()


def test_a_replay_makes_the_same_bits_and_notices_others(
    forge: Forge,
) -> None:
    report = verify_dataset(forge.folder, replay=5)
    assert [(replay.task, replay.exact, replay.problems) for replay in report.replays] == [
        (0, True, ()),
        (3, True, ()),
    ]
    forge.values("actions", lambda array: array.__setitem__((7, 0), array[7, 0] + 1e-6))
    report = verify_dataset(forge.folder, replay=1)
    assert [finding.problem for finding in report.findings] == ["replay: actions differs in 1 of 120 rows"]

    forge.record(lambda values: values["platform"].update(cpu="another"))
    forge.manifest(lambda values: values["platforms"][0].update(cpu="another"))
    report = verify_dataset(forge.folder, replay=1)
    assert [(replay.exact, replay.problems) for replay in report.replays] == [(False, ())]
    forge.values("actions", lambda array: array.__setitem__(slice(None), np.clip(array + 0.1, -1, 1)))
    problems = verify_dataset(forge.folder, replay=1).replays[0].problems
    assert "actions differ at step 0" in problems[0]


def test_replays_are_spread_over_the_dataset() -> None:
    keys = [PartKey(task, step) for task in range(5) for step in range(3)]
    assert replay_module.spread_parts(keys, 1) == [PartKey(0, 0)]
    assert replay_module.spread_parts(keys, 3) == [PartKey(0, 0), PartKey(2, 1), PartKey(4, 2)]
    assert replay_module.spread_parts(keys, 99) == keys
    assert replay_module.spread_parts([], 3) == []


def test_all_damages_are_found_at_once(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    shutil.rmtree(folder / part_folder(PartKey(0, 0)))
    (folder / part_file(PartKey(3, 100))).write_bytes(b"{")
    (folder / part_file(PartKey(99, 150))).unlink()
    shutil.copy(folder / part_file(PartKey(60, 0)), folder / part_file(PartKey(60, 50)))
    rot(folder / TASKS)
    assert found(folder) == {
        *(part_file(PartKey(0, step)) for step in (0, 100, 150)),
        part_file(PartKey(3, 100)),
        part_file(PartKey(99, 150)),
        part_file(PartKey(60, 50)),
        TASKS,
    }


@pytest.mark.parametrize("name", [MANIFEST, TASKS, PARTS_TABLE])
def test_a_damaged_table_or_manifest_does_not_hide_damaged_parts(tiny_copy: Copy, name: str) -> None:
    folder, part = tiny_copy(), part_file(PartKey(0, 0))
    rot(folder / part)
    rot(folder / name)
    assert found(folder) == {name, part}
    (folder / name).unlink()
    assert found(folder) == {name, part}
    with pytest.raises(ManifestError, match="no dataset"):
        verify_dataset(folder / "parts/main")


def rot(file: Path) -> None:
    """Changes a byte in the middle of a file."""
    data = file.read_bytes()
    middle = len(data) // 2
    file.write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])


def ids_of(folder: Path) -> dict[PartKey, str]:
    return {entry.key: entry.id for entry in open_dataset(folder).parts.entries()}


def test_repair_makes_exactly_the_rejected_parts_again(tiny_copy: Copy, tiny_folder: Path) -> None:
    folder = tiny_copy()
    rot(folder / part_file(PartKey(0, 100)))
    (folder / part_file(PartKey(3, 0))).unlink()
    (folder / "parts/notes.txt").write_text("mine")
    rot(folder / TASKS)
    report = repair_dataset(folder, workers=2)
    assert report.repaired == (PartKey(0, 100), PartKey(3, 0))
    assert (report.tables, report.failed) == ((TASKS,), ())
    assert [(entry.file, entry.foreign) for entry in report.left] == [("parts/notes.txt", True)]
    assert ids_of(folder) == ids_of(tiny_folder)
    assert read_manifest(folder).root == read_manifest(tiny_folder).root
    for file in (folder / PARTS).rglob("*.zip"):
        assert file.read_bytes() == (tiny_folder / file.relative_to(folder)).read_bytes()
    assert list((folder / STAGING).iterdir()) == []
    (folder / "parts/notes.txt").unlink()
    assert verify_dataset(folder, level="deep", replay=2).findings == ()
    assert repair_dataset(folder).repaired == ()


def test_repair_takes_links_and_pipes_away_without_following_them(tiny_copy: Copy, tmp_path: Path) -> None:
    """A part linked to a device or a pipe would fill memory or disk, or wait for ever, if it were opened."""
    folder, outside = tiny_copy(), tmp_path / "outside"
    outside.mkdir()
    shutil.move(folder / "parts/main/00000", outside / "moved")
    (folder / "parts/main/00000").symlink_to(outside / "moved")
    zero, pipe, linked = (part_file(PartKey(3, step)) for step in (0, 100, 150))
    for name in (zero, pipe):
        (folder / name).unlink()
    (folder / zero).symlink_to("/dev/zero")
    os.mkfifo(folder / pipe)
    os.link(folder / linked, outside / "same")
    (folder / TASKS).unlink()
    os.mkfifo(folder / TASKS)
    (folder / PARTS_TABLE).rename(outside / PARTS_TABLE)
    (folder / PARTS_TABLE).symlink_to(outside / PARTS_TABLE)
    (folder / "parts/other").symlink_to("/dev/zero")
    before = {path: path.lstat() for path in outside.rglob("*")}
    with (
        limits(seconds=240, file_bytes=2**24),
        pytest.raises(BuildError, match="does not have the manifest's root"),
    ):
        repair_dataset(folder, workers=1)  # table and parts are gone at once
    (folder / PARTS_TABLE).unlink()
    shutil.copy(outside / PARTS_TABLE, folder / PARTS_TABLE)
    with limits(seconds=240, file_bytes=2**24):
        report = repair_dataset(folder, workers=2)
    assert report.repaired == (
        *(PartKey(0, step) for step in (0, 100, 150)),
        *(PartKey(3, s) for s in (0, 100, 150)),
    )
    assert report.tables == (TASKS,)
    assert [entry.file for entry in report.left] == ["parts/other"]
    assert {path: path.lstat().st_mtime_ns for path in outside.rglob("*")} == {
        path: status.st_mtime_ns for path, status in before.items()
    }
    (folder / "parts/other").unlink()
    assert found(folder) == set()


def test_a_part_and_its_table_damaged_together_are_repaired(tiny_copy: Copy, tiny_folder: Path) -> None:
    """The damaged part is known by its line alone, the line that is lost by its part."""
    folder = tiny_copy()
    rot(folder / part_file(PartKey(3, 100)))
    lines = (folder / PARTS_TABLE).read_bytes().splitlines(keepends=True)
    lost = next(i for i, line in enumerate(lines) if line.startswith(b"[40,0,"))
    (folder / PARTS_TABLE).write_bytes(b"".join([*lines[:lost], b"x" + lines[lost][1:], *lines[lost + 1 :]]))
    report = repair_dataset(folder, workers=1)
    assert (report.repaired, report.tables, report.left) == ((PartKey(3, 100),), (PARTS_TABLE,), ())
    assert ids_of(folder) == ids_of(tiny_folder)


def test_a_table_of_holes_takes_no_memory(tmp_path: Path) -> None:
    with (tmp_path / PARTS_TABLE).open("wb") as file:
        file.write(b"[]\n")
        file.truncate(2**36)
    tracemalloc.start()
    assert read_lines(tmp_path / PARTS_TABLE, 2**36) == b"[]\n"
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**24


@contextlib.contextmanager
def limits(*, seconds: int, file_bytes: int) -> Iterator[None]:
    """Fails what writes a larger file, here or in a worker, or takes longer."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"blocked for {seconds} s")

    old = signal.signal(signal.SIGALRM, ring)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, before[1]))
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("num_files", [1, 2])
def test_a_repair_killed_between_tables_and_manifest_is_finished_by_the_next(
    tiny_copy: Copy, tiny_folder: Path, monkeypatch: pytest.MonkeyPatch, num_files: int
) -> None:
    """The published order of the tiny dataset's parts is not that of their keys, so both tables change."""
    folder, replaced = tiny_copy(), []

    def replace_some(path: Path, data: bytes, *, staging: Path) -> None:
        if len(replaced) == num_files:
            raise KeyboardInterrupt
        replaced.append(path.name)
        replace_file(path, data, staging=staging)

    rot(folder / PARTS_TABLE)
    with monkeypatch.context() as patch:
        patch.setattr(sealing, "replace_file", replace_some)
        with pytest.raises(KeyboardInterrupt):
            repair_dataset(folder)
    assert replaced == [TASKS, PARTS_TABLE][:num_files]
    assert found(folder) == {PARTS_TABLE}
    report = repair_dataset(folder)
    assert (report.repaired, report.tables, report.left) == ((), (PARTS_TABLE,), ())
    assert ids_of(folder) == ids_of(tiny_folder)
    assert read_manifest(folder).root == read_manifest(tiny_folder).root
    assert found(folder) == set()


def test_a_part_that_comes_out_differently_replaces_nothing(
    tiny_copy: Copy, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tiny_copy()
    for step in (0, 100, 150):
        (folder / part_file(PartKey(3, step))).unlink()
    build = repair_module.build_dataset

    def build_with_another_seed(*arguments: object, **options: object) -> object:
        return build(*arguments, **(options | {"seed": 1}))  # type: ignore[arg-type]

    monkeypatch.setattr(repair_module, "build_dataset", build_with_another_seed)
    before = {path: path.read_bytes() for path in data_files(folder)}
    with pytest.raises(NondeterminismError, match="task 3, step 0, run main came out as"):
        repair_dataset(folder, workers=1)
    assert {path: path.read_bytes() for path in data_files(folder)} == before


def test_a_damaged_manifest_is_recovered_by_building_again(tiny_copy: Copy, tiny_folder: Path) -> None:
    folder = tiny_copy()
    recipe = read_manifest(folder).recipe
    (folder / MANIFEST).write_bytes(b"rot")
    with pytest.raises(ManifestError, match=str(folder / MANIFEST)):
        repair_dataset(folder)
    (folder / MANIFEST).unlink()
    tasks = [task.index for task in open_dataset(tiny_folder).tasks]
    report = tcmrl_data.build_dataset(recipe, folder, tasks=tasks)
    assert (report.built, report.root) == (0, read_manifest(tiny_folder).root)
    assert found(folder) == set()


def littered(folder: Path) -> set[str]:
    """Creates the files that killed builds leave behind; returns those that gc must remove."""
    staging = folder / STAGING
    (staging / "task_00003.dead").mkdir(parents=True)
    (staging / "task_00003.dead/x").write_bytes(b"12345")
    (staging / "task_00003.dead.lock").touch()
    (staging / "manifest.json.0123").write_bytes(b"1")
    for name in ("task_00003", "task_00007"):
        (folder / CHECKPOINTS / name).mkdir(parents=True)
        (folder / CHECKPOINTS / name / "state").write_bytes(b"1234567")
    return {f"{STAGING}/task_00003.dead", f"{STAGING}/manifest.json.0123", f"{CHECKPOINTS}/task_00003"}


def test_gc_takes_what_is_dead_and_a_dry_run_only_says_so(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    expected = littered(folder)
    before = {path: path.lstat().st_mtime_ns for path in folder.rglob("*")}
    dry = collect_garbage(folder, dry_run=True)
    assert {path: path.lstat().st_mtime_ns for path in folder.rglob("*")} == before
    assert {removed.path: removed.bytes for removed in dry} == dict(
        zip(sorted(expected), (7, 1, 5), strict=True)
    )
    assert collect_garbage(folder) == dry
    assert list((folder / STAGING).iterdir()) == []
    assert [path.name for path in (folder / CHECKPOINTS).iterdir()] == ["task_00007"]
    assert collect_garbage(folder) == ()
    assert verify_dataset(folder).findings == ()


def test_gc_spares_a_live_attempt_and_is_refused_during_a_build(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    littered(folder)
    attempt = folder / STAGING / "task_00003.dead"
    holder = "import sys; from tcmrl_data.foundation.disk import lock_file; from pathlib import Path\n"
    holder += "with lock_file(Path(sys.argv[1]), 'x'):\n    print('held', flush=True)\n    sys.stdin.read()"
    for lock, is_refused in ((attempt.with_name("task_00003.dead.lock"), False), (folder / LOCK, True)):
        command = [sys.executable, "-c", holder, str(lock)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"held\n"
            if is_refused:
                for dry_run in (True, False):
                    with pytest.raises(LockedError, match=f"process {process.pid}"):
                        collect_garbage(folder, dry_run=dry_run)
            else:
                assert f"{STAGING}/{attempt.name}" not in {
                    removed.path for removed in collect_garbage(folder)
                }
                assert (attempt / "x").exists()
            process.communicate(b"")


def test_the_commands_say_what_they_found_and_did(
    tiny_copy: Copy, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tiny_copy()
    assert run(data, ["verify", str(folder), "--deep", "--replay", "1"]) == 0
    assert "15 parts" in capsys.readouterr().out
    name = part_file(PartKey(3, 0))
    (folder / name).unlink()
    assert run(data, ["verify", str(folder / MANIFEST), "--quiet"]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines()[0] == f"{name}: is missing"
    assert printed.err.startswith(f"Error: {folder}: 1 finding; ")
    assert run(data, ["verify", str(folder), "--json", "--quick"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["findings"] == [
        {"file": name, "problem": "is missing", "task": 3, "step": 0, "run": "main", "foreign": False}
    ]
    assert run(data, ["repair", str(folder), "--workers", "1", "--quiet"]) == 0
    assert "task 3, step 0, run main: regenerated, same id" in capsys.readouterr().out
    littered(folder)
    assert run(data, ["gc", str(folder), "--dry-run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] == 13
    assert run(data, ["gc", str(folder)]) == 0
    assert "3 items, 13 B removed" in capsys.readouterr().out
    for command in (["verify", "--quick", "--deep"], ["verify"], ["repair"], ["gc"]):
        assert run(data, [command[0], str(folder / "parts/main"), *command[1:]]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_dataset_in_use_cannot_be_repaired(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    with lock_file(folder / LOCK, "the dataset"), pytest.raises(LockedError, match=f"process {os.getpid()}"):
        repair_dataset(folder)


def test_a_replay_needs_no_behavior_source(tiny_copy: Copy) -> None:
    """A part contains its policy, so the package that trained it need not be installed."""
    folder = tiny_copy()
    manifest = read_manifest(folder)
    behavior = manifest.recipe.behavior.model_copy(update={"source": "not-installed"})
    recipe = manifest.recipe.model_copy(update={"behavior": behavior})
    key = PartKey(3, 100)
    with Archive(folder / part_file(key)) as archive:
        replay = replay_module.replay_part(archive, read_part_record(archive), key, recipe)
    assert replay.problems == ()
