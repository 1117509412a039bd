"""Verification names every changed file and no other."""

import itertools
import random
import shutil
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli import keeping
from tcmrl_cli.data import data

from tcmrl_data import verify_dataset
from tcmrl_data.building.work_files import STATUS
from tcmrl_data.foundation.disk import CHECKPOINTS, LOCK, STAGING
from tcmrl_data.foundation.errors import (
    ManifestError,
)
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.manifest import MANIFEST, read_manifest
from tcmrl_data.store.part import read_part_record
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import TASKS, PartKey, part_file, part_folder, read_lines
from tcmrl_data.verification import replay as replay_module
from tests.commands import in_process
from tests.damage import damaged, data_files, found, rot, write
from tests.hostile.datasets import PART, STEP, Forge, base

Copy = Callable[[], Path]


@pytest.fixture(scope="module")
def sound(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two parts of the tiny dataset; every test restores them after damaging them."""
    return base(tiny_folder, tmp_path_factory.mktemp("rot") / "dataset")


@pytest.fixture
def forge(tiny_folder: Path, tmp_path: Path) -> Forge:
    (tmp_path / "outside").mkdir()
    return Forge(base(tiny_folder, tmp_path / "data"), tmp_path / "outside")


def test_every_damaged_file_is_found_and_no_other(sound: Path) -> None:
    chance = random.Random(0)
    for file in data_files(sound):
        good = file.read_bytes()
        for _ in range(50):
            write(file, damaged(good, chance))
            assert found(sound) == {str(file.relative_to(sound))}
        file.write_bytes(good)
    assert found(sound) == set()


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
    for name in (LOCK, STATUS):
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


def test_a_table_of_holes_takes_no_memory(tmp_path: Path) -> None:
    with (tmp_path / PARTS_TABLE).open("wb") as file:
        file.write(b"[]\n")
        file.truncate(2**36)
    tracemalloc.start()
    assert read_lines(tmp_path / PARTS_TABLE, 2**36) == b"[]\n"
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**24


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


BESIDE = (
    "NOTES.md",
    ".DS_Store",
    "parts/._x.zip",
    ".git/objects/pack",
    ".nfs0001",
    "data.dvc",
    "parts/Thumbs.db",
)


def test_files_of_others_beside_the_data_are_notes(
    tiny_copy: Copy, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tiny_copy()
    for name in BESIDE:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("mine")
    report = verify_dataset(folder, level="deep")
    expected = {".git" if name.startswith(".git") else name for name in BESIDE}
    assert (report.findings, {note.file for note in report.notes}) == ((), expected)
    strict = verify_dataset(folder, strict=True)
    assert ({finding.file for finding in strict.findings}, strict.notes) == (expected, ())
    run = in_process(data, capsys)
    code, printed, _ = run("verify", folder)
    assert code == 0 and "note: .DS_Store: belongs to no part" in printed
    assert run("verify", folder, "--strict")[0] == 1
    odd = f"{part_folder(PartKey(0, 0))}/150.zip"
    (folder / odd).write_text("mine")
    assert [found.file for found in verify_dataset(folder).findings] == [odd]


def test_a_disk_that_is_not_mounted_is_one_line(tiny_copy: Copy, capsys: pytest.CaptureFixture[str]) -> None:
    folder, run = tiny_copy(), in_process(data, capsys)
    shutil.rmtree(folder / "parts")
    code, printed, _ = run("verify", folder)
    first, summary = printed.splitlines()
    assert (code, first) == (1, "all 15 parts are missing: is the disk mounted?")
    assert summary.endswith("15 findings")


def test_many_findings_are_told_by_their_kinds(
    tiny_copy: Copy, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, run = tiny_copy(), in_process(data, capsys)
    monkeypatch.setattr(keeping, "MOST_LINES", 3)
    first, *others = sorted((folder / "parts").rglob("*.zip"))
    first.write_bytes(first.read_bytes()[:-1])
    for file in others[:9]:
        file.unlink()
    lines = run("verify", folder)[1].splitlines()
    assert len(lines) == 3
    assert lines[0].endswith("is missing; and 8 more of the kind")
    assert " bytes instead of " in lines[1]


def test_a_sample_opens_some_parts_and_looks_for_all(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    files = sorted((folder / "parts").rglob("*.zip"))
    for file in (files[0], files[1]):
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
    files[2].unlink()
    found = {folder / finding.file for finding in verify_dataset(folder, sample=2).findings}
    assert found == {files[0], files[2]}
    assert {folder / finding.file for finding in verify_dataset(folder).findings} == set(files[:3])
