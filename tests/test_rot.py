"""Random damage to every file of a dataset: verification names it, and repair takes it back."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tcmrl_data import open_dataset, repair_dataset, verify_dataset
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.store.manifest import MANIFEST, restore_manifest
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import PARTS, TASKS
from tcmrl_data.verification import repair as repair_module
from tests.damage import damaged, write
from tests.hostile.datasets import base, copies_of

pytestmark = pytest.mark.usefixtures("module_in_process")

BYTES = {MANIFEST, TASKS, PARTS_TABLE}

Copy = Callable[[], Path]


@pytest.fixture(scope="module")
def sound(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny dataset with its parts in order of their keys, as a repair leaves them."""
    folder = tmp_path_factory.mktemp("rot") / "sound"
    base(tiny_folder, folder, keys=open_dataset(tiny_folder).parts)
    restore_manifest(folder)  # writes the copy of it
    return folder


def content(folder: Path) -> dict[str, bytes]:
    paths = [*(folder / name for name in sorted(BYTES)), *sorted((folder / PARTS).rglob("*.zip"))]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def found(folder: Path) -> set[str]:
    return {finding.file for finding in verify_dataset(folder).findings}


@pytest.mark.check
@pytest.mark.parametrize(
    "rounds",
    [9, pytest.param(89, marks=pytest.mark.exhaustive)],
)
def test_rot_is_named_and_repaired(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rounds: int
) -> None:
    """One damage at a time is named; tables are repaired one by one, parts of a round together."""
    monkeypatch.setattr(repair_module, "build_dataset", copies_of(sound))
    folder = tmp_path / "copy"
    shutil.copytree(sound, folder)
    good, chance, cases = content(folder), random.Random(rounds), 0
    for _ in range(rounds):
        bad = {name: damaged(data, chance) for name, data in good.items()}
        for name, data in bad.items():
            write(folder / name, data)
            cases += 1
            assert found(folder) == {name}
            if name in (MANIFEST, TASKS, PARTS_TABLE):
                assert repair_dataset(folder).tables == (name,)
            else:
                write(folder / name, good[name])
            assert content(folder) == good
        parts = {name: data for name, data in bad.items() if name not in BYTES}
        for name, data in {**parts, TASKS: bad[TASKS]}.items():
            write(folder / name, data)
        report = repair_dataset(folder)
        assert (len(report.repaired), report.tables, report.left) == (len(parts), (TASKS,), ())
        assert content(folder) == good
    assert found(folder) == set()
    assert cases == rounds * 18


@pytest.mark.check
def test_a_dataset_all_of_whose_parts_rotted_is_made_again(sound: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(sound, folder)
    good, chance = content(folder), random.Random(0)
    for name, data in good.items():
        if name not in (MANIFEST, PARTS_TABLE):
            write(folder / name, damaged(data, chance))
    report = repair_dataset(folder, workers=2)
    assert (len(report.repaired), report.tables, report.left) == (15, (TASKS,), ())
    assert content(folder) == good


def test_a_rotten_manifest_and_a_rotten_part_are_repaired_together(sound: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(sound, folder)
    good, chance = content(folder), random.Random(0)
    parts = [name for name in good if name.endswith(".zip")]
    for name in (MANIFEST, TASKS, parts[0]):
        write(folder / name, damaged(good[name], chance))
    report = repair_dataset(folder, workers=2)
    assert (len(report.repaired), report.tables, report.left) == (1, (MANIFEST, TASKS), ())
    assert content(folder) == good


@pytest.mark.check
@pytest.mark.parametrize("name", [MANIFEST, TASKS, PARTS_TABLE])
def test_every_flipped_byte_of_a_table_or_manifest_is_named(
    sound: Path, tmp_path: Path, name: str, sweep: int
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(sound, folder)
    good = (folder / name).read_bytes()
    for place in range(0, len(good), max(1, sweep // 4)):
        bad = good[:place] + bytes([good[place] ^ 1 << place % 8]) + good[place + 1 :]
        (folder / name).write_bytes(bad)
        findings = verify_dataset(folder, level="quick").findings
        assert {finding.file for finding in findings} == {name}
        dataset_is_refused(folder, name)


def dataset_is_refused(folder: Path, name: str) -> None:
    with pytest.raises(ManifestError, match=name):
        [open_dataset(folder).parts, open_dataset(folder).tasks]
