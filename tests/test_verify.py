"""Verification names every changed file; repaired parts keep their ids; gc removes only unused files."""

import itertools
import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli.data import data
from tcmrl_cli.frame import run

import tcmrl_data
from tcmrl_data import open_dataset, repair_dataset, verify_dataset
from tcmrl_data.build.events import EVENTS
from tcmrl_data.foundation.disk import CHECKPOINTS, LOCK, STAGING, lock_file
from tcmrl_data.foundation.errors import LockedError, ManifestError, NondeterminismError
from tcmrl_data.store.arrays import array_digests, encode_arrays
from tcmrl_data.store.manifest import MANIFEST, part_folder, read_manifest, read_part_record
from tcmrl_data.verification import repair as repair_module
from tcmrl_data.verification import replay as replay_module
from tcmrl_data.verification.garbage import collect_garbage
from tests.hostile_corpus import PART, STEP, Forge, base

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


def rot_everywhere(folder: Path, rot: Rot, *, rounds: int) -> int:
    """Damages every file in turn; verification must name only that file. Returns the number of cases."""
    chance, cases = random.Random(0), 0
    for file in data_files(folder):
        good = file.read_bytes()
        for _ in range(rounds):
            bad = rot(good, chance)
            file.unlink() if bad is None else file.write_bytes(bad)
            cases += 1
            assert found(folder) == {str(file.relative_to(folder))}
        file.write_bytes(good)
    assert found(folder) == set()
    sys.stdout.write(f"{rot.__name__}: {cases} of {cases} found\n")
    return cases


@pytest.mark.parametrize(("rot", "rounds"), [(flip, 10), (truncate, 4), (delete, 1)])
def test_every_damaged_file_is_found_and_no_other(sound: Path, rot: Rot, rounds: int) -> None:
    assert rot_everywhere(sound, rot, rounds=rounds) == 39 * rounds


@pytest.mark.sweep
def test_one_flipped_bit_is_found_in_any_file_of_many_parts(tiny_copy: Copy) -> None:
    assert rot_everywhere(tiny_copy(), flip, rounds=1) >= 250


def test_every_added_file_is_found(sound: Path) -> None:
    cases = 0
    folders = {file.parent for file in data_files(sound)} | {sound}
    for folder in sorted(folders):
        for name in ("0.bak", "zarr.json~", ".hidden"):
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
        for file, other in ((left, right), (right, left)):
            # a foreign record does not state the digests of its part's files
            is_hidden = other.name == "part.json" and other.parent in file.parents
            assert is_hidden or str(file.relative_to(sound)) in names
        left.write_bytes(first)
        right.write_bytes(second)
    assert found(sound) == set()
    sys.stdout.write(f"swaps: {cases} of {cases} found\n")
    assert cases > 200


def test_work_files_are_no_data(sound: Path) -> None:
    for name in (LOCK, EVENTS):
        (sound / name).write_text("anything")
    (sound / STAGING).mkdir(exist_ok=True)
    (sound / CHECKPOINTS / "task_00003").mkdir(parents=True)
    (sound / CHECKPOINTS / "task_00003" / "x").touch()
    assert found(sound) == set()


def test_levels_look_ever_closer(forge: Forge) -> None:
    """Digests find a flipped bit; only the deep level finds forged values."""
    file = forge.part / "rewards/c/0"
    file.write_bytes(file.read_bytes()[:-1] + bytes([file.read_bytes()[-1] ^ 1]))
    assert verify_dataset(forge.folder, level="quick").findings == ()
    assert [finding.file for finding in verify_dataset(forge.folder).findings] == [f"{PART}/rewards/c/0"]
    forge.write("rewards/c/0", file.read_bytes())
    assert verify_dataset(forge.folder).findings == ()
    (finding,) = verify_dataset(forge.folder, level="deep").findings
    assert finding.file == f"{PART}/rewards/c/0" and "checksum" in finding.problem


def reencoded(forge: Forge, name: str, change: Callable[[np.ndarray], object]) -> None:  # type: ignore[type-arg]
    """Replaces an array's values and updates every digest to match."""
    array = open_dataset(forge.folder).arrays(0, STEP)[name].copy()
    change(array)
    forge.write(f"{name}/c/{'0/0' if array.ndim == 2 else '0'}", first_chunk(name, array))
    forge.record(lambda values: values["identity"]["arrays"].update(array_digests({name: array})))


def first_chunk(name: str, array: np.ndarray) -> bytes:  # type: ignore[type-arg]
    files = encode_arrays({name: array})
    return next(content for file, content in files.items() if "/c/" in file)


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
    reencoded(forge, name, lambda array: array.__setitem__(row, value))
    findings = verify_dataset(forge.folder, level="deep").findings
    assert any(
        problem in finding.problem and (finding.task, finding.step) == (0, STEP) for finding in findings
    ), findings
    assert verify_dataset(forge.folder).findings == ()


def test_a_replay_makes_the_same_bits_and_notices_others(
    forge: Forge, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = verify_dataset(forge.folder, replay=5)
    assert [(replay.task, replay.exact, replay.problems) for replay in report.replays] == [
        (0, True, ()),
        (3, True, ()),
    ]
    reencoded(forge, "actions", lambda array: array.__setitem__((7, 0), array[7, 0] + 1e-6))
    report = verify_dataset(forge.folder, replay=1)
    assert [finding.problem for finding in report.findings] == ["replay: actions differs in 1 of 120 rows"]

    here = replay_module.provenance(open_dataset(forge.folder).environment, {})
    monkeypatch.setattr(replay_module, "provenance", lambda environment, behavior: here | {"cpu": "another"})
    report = verify_dataset(forge.folder, replay=1)
    assert [(replay.exact, replay.problems) for replay in report.replays] == [(False, ())]
    reencoded(forge, "actions", lambda array: array.__setitem__(slice(None), np.clip(array + 0.1, -1, 1)))
    problems = verify_dataset(forge.folder, replay=1).replays[0].problems
    assert "actions differ at step 0" in problems[0]


def test_replays_are_spread_over_the_dataset() -> None:
    keys = [(task, step) for task in range(5) for step in range(3)]
    assert replay_module.spread_parts(keys, 1) == [(0, 0)]
    assert replay_module.spread_parts(keys, 3) == [(0, 0), (2, 1), (4, 2)]
    assert replay_module.spread_parts(keys, 99) == keys
    assert replay_module.spread_parts([], 3) == []


def test_all_damages_are_found_at_once(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    (folder / part_folder(0, 0) / "rewards/c/0").unlink()
    (folder / part_folder(3, 100) / "part.json").write_bytes(b"{")
    shutil.rmtree(folder / part_folder(99, 150))
    shutil.copytree(folder / part_folder(60, 0), folder / part_folder(60, 50))
    (folder / "tasks/00040/zarr.json").write_bytes(b"{}")
    files = found(folder)
    assert files == {
        f"{part_folder(0, 0)}/rewards/c/0",
        f"{part_folder(3, 100)}/part.json",
        part_folder(99, 150),
        part_folder(60, 50),
        "tasks/00040/zarr.json",
    }


def test_a_damaged_manifest_does_not_hide_damaged_parts(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    (folder / MANIFEST).write_bytes(b"{}")
    (folder / part_folder(0, 0) / "rewards/c/0").unlink()
    assert found(folder) == {MANIFEST, f"{part_folder(0, 0)}/rewards/c/0"}
    (folder / MANIFEST).unlink()
    assert found(folder) == {MANIFEST, f"{part_folder(0, 0)}/rewards/c/0"}
    with pytest.raises(ManifestError, match="no dataset"):
        verify_dataset(folder / "tasks/00000/snapshots")


def parts_of(folder: Path) -> dict[tuple[int, int], str]:
    return {(part.task, part.step): part.id for part in read_manifest(folder).parts}


def test_repair_makes_exactly_the_rejected_parts_again(tiny_copy: Copy, tiny_folder: Path) -> None:
    folder = tiny_copy()
    records = {key: (folder / part_folder(*key) / "part.json").read_bytes() for key in parts_of(folder)}
    flipped = folder / part_folder(0, 100) / "observations/c/0/0"
    flipped.write_bytes(bytes([flipped.read_bytes()[0] ^ 1]) + flipped.read_bytes()[1:])
    shutil.rmtree(folder / part_folder(3, 0))
    (folder / "tasks/00060/snapshots/zarr.json").unlink()
    (folder / "tasks/notes.txt").write_text("mine")
    report = repair_dataset(folder, workers=2)
    assert report.repaired == ((0, 100), (3, 0))
    assert report.groups == ("tasks/00060/snapshots/zarr.json",)
    assert [(entry.file, entry.foreign) for entry in report.left] == [("tasks/notes.txt", True)]
    assert parts_of(folder) == parts_of(tiny_folder)
    assert read_manifest(folder).root == read_manifest(tiny_folder).root
    for key, before in records.items():
        if key not in report.repaired:
            assert (folder / part_folder(*key) / "part.json").read_bytes() == before
    assert list((folder / STAGING).iterdir()) == []
    (folder / "tasks/notes.txt").unlink()
    assert verify_dataset(folder, level="deep", replay=2).findings == ()
    assert repair_dataset(folder).repaired == ()


def test_repair_takes_links_away_without_following_them(forge: Forge) -> None:
    shutil.move(forge.folder / "tasks/00000", forge.outside / "moved")
    (forge.folder / "tasks/00000").symlink_to(forge.outside / "moved")
    before = sorted(forge.outside.rglob("*"))
    linked = verify_dataset(forge.folder).findings
    assert "tasks/00000" in {finding.file for finding in linked}
    forge.manifest(lambda values: values["recipe"]["behavior"]["settings"].update(snapshots=[0, 100, 150]))
    report = repair_dataset(forge.folder, workers=1)
    assert report.repaired == ((0, STEP),)
    assert report.left == ()
    assert sorted(forge.outside.rglob("*")) == before


def test_a_part_that_comes_out_differently_replaces_nothing(
    tiny_copy: Copy, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tiny_copy()
    (folder / part_folder(3, 0) / "policy.json").unlink()
    build = repair_module.build_dataset

    def build_with_another_seed(*arguments: object, **options: object) -> object:
        return build(*arguments, **(options | {"seed": 1}))  # type: ignore[arg-type]

    before = {path: path.read_bytes() for path in data_files(folder)}
    monkeypatch.setattr(repair_module, "build_dataset", build_with_another_seed)
    shutil.rmtree(folder / part_folder(3, 100))
    shutil.rmtree(folder / part_folder(3, 150))
    before = {path: path.read_bytes() for path in data_files(folder)}
    with pytest.raises(NondeterminismError, match="task 3 at step 0 came out as"):
        repair_dataset(folder, workers=1)
    assert {path: path.read_bytes() for path in data_files(folder)} == before


def test_a_damaged_manifest_is_recovered_by_building_again(tiny_copy: Copy, tiny_folder: Path) -> None:
    folder = tiny_copy()
    recipe = read_manifest(folder).recipe
    (folder / MANIFEST).write_bytes(b"rot")
    with pytest.raises(ManifestError, match=str(folder / MANIFEST)):
        repair_dataset(folder)
    (folder / MANIFEST).unlink()
    tasks = [task.index for task in read_manifest(tiny_folder).tasks]
    report = tcmrl_data.build_dataset(recipe, folder, tasks=tasks)
    assert (report.built, report.root) == (0, read_manifest(tiny_folder).root)


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
    name = f"{part_folder(3, 0)}/policy.json"
    (folder / name).unlink()
    assert run(data, ["verify", str(folder / MANIFEST), "--quiet"]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines()[0] == f"{name}: is missing"
    assert printed.err.startswith(f"Error: {folder}: 1 finding; ")
    assert run(data, ["verify", str(folder), "--json", "--quick"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["findings"] == [
        {"file": name, "problem": "is missing", "task": 3, "step": 0, "foreign": False}
    ]
    assert run(data, ["repair", str(folder), "--workers", "1", "--quiet"]) == 0
    assert "task 3, step 0: regenerated, same id" in capsys.readouterr().out
    littered(folder)
    assert run(data, ["gc", str(folder), "--dry-run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] == 13
    assert run(data, ["gc", str(folder)]) == 0
    assert "3 items, 13 B removed" in capsys.readouterr().out
    for command in (["verify", "--quick", "--deep"], ["verify"], ["repair"], ["gc"]):
        assert run(data, [command[0], str(folder / "tasks/00000"), *command[1:]]) == 2
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
    part = folder / part_folder(3, 100)
    replay = replay_module.replay_part(
        part, read_part_record(part / "part.json"), manifest.model_copy(update={"recipe": recipe})
    )
    assert replay.problems == ()
