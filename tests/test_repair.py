"""Repaired parts keep their ids, and what a repair cannot make again stays as it was."""

import contextlib
import json
import os
import resource
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import derive_dataset, open_dataset, repair_dataset, verify_dataset
from tcmrl_data.foundation.disk import LOCK, STAGING, lock_file, replace_file
from tcmrl_data.foundation.errors import (
    BuildError,
    LockedError,
    ManifestError,
    NondeterminismError,
)
from tcmrl_data.foundation.records import sealed
from tcmrl_data.parts import own_operations
from tcmrl_data.store import manifest as manifest_module
from tcmrl_data.store import part
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_COPY, read_manifest
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import PARTS, TASKS, PartKey, part_file, seal_of
from tcmrl_data.verification import repair
from tests.commands import in_process
from tests.damage import data_files, found, ids_of, rot
from tests.hostile.bounds import ringing

pytestmark = pytest.mark.usefixtures("module_in_process")

Copy = Callable[[], Path]


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


def test_repair_takes_pipes_and_links_to_nothing_away(tiny_copy: Copy, tmp_path: Path) -> None:
    """A part linked to a device or a pipe would fill memory or disk, or wait for ever, if it were read."""
    folder, outside = tiny_copy(), tmp_path / "outside"
    outside.mkdir()
    shutil.rmtree(folder / "parts/main/00000")
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
    (folder / PARTS_TABLE).symlink_to("/dev/zero")
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
        *(PartKey(3, step) for step in (0, 100)),
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


@contextlib.contextmanager
def limits(*, seconds: int, file_bytes: int) -> Iterator[None]:
    """Fails what writes a larger file, here or in a worker, or takes longer."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, before[1]))
    try:
        with ringing(seconds):
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def publish_in_reverse(folder: Path) -> None:
    """Seals the parts in the order against their keys, as a build may do and a repair does not."""
    header, *lines = (folder / PARTS_TABLE).read_bytes().splitlines(keepends=True)
    table = b"".join([header, *reversed(lines)])
    (folder / PARTS_TABLE).write_bytes(table)
    fields = json.loads((folder / MANIFEST).read_bytes())
    del fields["digest"]
    fields["parts"] |= seal_of(table).model_dump(mode="json")
    (folder / MANIFEST).write_bytes(sealed(fields))
    assert found(folder) == set()


@pytest.mark.parametrize("num_files", [1, 2])
def test_a_repair_killed_between_tables_and_manifest_is_finished_by_the_next(
    tiny_copy: Copy, tiny_folder: Path, monkeypatch: pytest.MonkeyPatch, num_files: int
) -> None:
    folder, replaced = tiny_copy(), []
    publish_in_reverse(folder)
    manifest_module.restore_manifest(folder)  # writes the copy, which that did not

    def replace_some(path: Path, data: bytes, *, staging: Path) -> None:
        if len(replaced) == num_files:
            raise KeyboardInterrupt
        replaced.append(path.name)
        replace_file(path, data, staging=staging)

    rot(folder / PARTS_TABLE)
    with monkeypatch.context() as patch:
        patch.setattr(manifest_module, "replace_file", replace_some)
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
    build = repair.build_dataset

    def build_with_another_seed(*arguments: object, **options: object) -> object:
        return build(*arguments, **(options | {"seed": 1}))  # type: ignore[arg-type]

    monkeypatch.setattr(repair, "build_dataset", build_with_another_seed)
    before = {path: path.read_bytes() for path in data_files(folder)}
    with pytest.raises(NondeterminismError, match="task 3, step 0, run main came out as"):
        repair_dataset(folder, workers=1)
    assert {path: path.read_bytes() for path in data_files(folder)} == before


@pytest.fixture
def another_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """This machine has another processor than the one that made the parts."""
    here = part._machine()
    monkeypatch.setattr(part, "_machine", lambda: here | {"cpu": "another one"})


@pytest.mark.usefixtures("another_processor")
def test_on_another_platform_nothing_is_begun(tiny_copy: Copy, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tiny_copy()
    (folder / part_file(PartKey(3, 0))).unlink()
    monkeypatch.setattr(repair, "build_dataset", refuse_to_build)
    text = "made on another platform .cpu .* another one here.*--from COPY.*--accept"
    with pytest.raises(NondeterminismError, match=text):
        repair_dataset(folder)
    assert list((folder / STAGING).glob("*")) == []


def test_parts_are_taken_from_a_copy_by_their_digests(
    tiny_copy: Copy, tiny_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is made again, so that no platform matters; what is damaged in the copy too stays."""
    folder, copy = tiny_copy(), tiny_copy()
    for key in (PartKey(0, 100), PartKey(3, 0)):
        (folder / part_file(key)).unlink()
    rot(copy / part_file(PartKey(3, 0)))
    monkeypatch.setattr(repair, "build_dataset", refuse_to_build)
    with pytest.raises(AssertionError, match="a build"):
        repair_dataset(folder, copy=copy)
    assert found(folder) == {part_file(PartKey(3, 0))}
    report = repair_dataset(folder, copy=tiny_folder)
    assert (report.copied, report.repaired, report.left) == ((PartKey(3, 0),), (), ())
    assert report.root == read_manifest(tiny_folder).root
    assert verify_dataset(folder, level="deep").findings == ()


@pytest.mark.usefixtures("another_processor")
def test_parts_that_come_out_otherwise_are_taken_and_the_manifest_says_so(
    tiny_copy: Copy, tiny_folder: Path, tiny_recipe: tcmrl_data.Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, key = tiny_copy(), PartKey(3, 0)
    (folder / part_file(key)).unlink()
    drawn = own_operations.keyed_generator
    monkeypatch.setattr(own_operations, "keyed_generator", lambda *words: drawn(*words[:-1], words[-1] + 100))
    report = repair_dataset(folder, accept=True)
    assert (report.accepted, report.repaired, report.left) == ((key,), (), ())
    assert report.root == read_manifest(folder).root != read_manifest(tiny_folder).root
    assert read_manifest(folder).runs[0].origin == {"replaced": [str(key)]}
    assert verify_dataset(folder, level="deep").findings == ()
    tasks = [task.index for task in open_dataset(folder).tasks]
    assert tcmrl_data.build_dataset(tiny_recipe, folder, tasks=tasks).built == 0
    assert read_manifest(folder).runs[0].origin == {"replaced": [str(key)]}


@pytest.mark.usefixtures("another_processor")
def test_the_command_offers_a_copy_and_takes_it(
    tiny_copy: Copy, tiny_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, run = tiny_copy(), in_process(data, capsys)
    (folder / part_file(PartKey(3, 0))).unlink()
    code, _, error = run("verify", folder, "--repair", "--quiet")
    assert code != 0 and "--from COPY" in error and "--accept" in error
    code, printed, _ = run("verify", folder, "--repair", "--from", tiny_folder, "--quiet")
    assert code == 0 and f"taken from {tiny_folder}, same digest" in printed
    assert "0 parts regenerated, 1 copied, 0 tables rewritten, 0 findings left" in printed


def refuse_to_build(*arguments: object, **options: object) -> None:
    raise AssertionError("a build")


@pytest.mark.parametrize("damage", [None, b"rot", b"{}\n"])
def test_a_lost_or_damaged_manifest_is_restored_from_its_copy(
    tiny_folder: Path, tmp_path: Path, damage: bytes | None
) -> None:
    """With what no build makes again: the derivation, the label, and further runs."""
    folder = derive_dataset(tiny_folder, tmp_path / "derived", tasks=[0, 3], label="mine").out
    good = (folder / MANIFEST).read_bytes()
    assert (folder / MANIFEST_COPY).read_bytes() == good
    if damage is None:
        (folder / MANIFEST).unlink()
    else:
        (folder / MANIFEST).write_bytes(damage)
    with pytest.raises(ManifestError, match=f"`tcmrl-data verify {folder} --repair` restores it"):
        open_dataset(folder)
    rot(folder / TASKS)
    assert MANIFEST in found(folder)
    report = repair_dataset(folder)
    assert (report.tables, report.left, found(folder)) == ((MANIFEST, TASKS), (), set())
    assert (folder / MANIFEST).read_bytes() == good
    assert repair_dataset(folder).tables == ()


def test_a_damaged_copy_of_the_manifest_is_found_and_written_again(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    rot(folder / MANIFEST_COPY)
    assert found(folder) == {MANIFEST_COPY}
    assert (repair_dataset(folder).tables, found(folder)) == ((), set())
    (folder / MANIFEST_COPY).unlink()  # as in a dataset of an earlier version
    assert found(folder) == set()
    repair_dataset(folder)
    assert (folder / MANIFEST_COPY).read_bytes() == (folder / MANIFEST).read_bytes()


def test_a_flipped_bit_of_a_manifest_is_told_from_an_unknown_field(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    data = (folder / MANIFEST).read_bytes()
    (folder / MANIFEST).write_bytes(data.replace(b'"label"', b'"lcbel"', 1))
    with pytest.raises(ManifestError, match="digest does not match its contents"):
        open_dataset(folder)


def test_a_build_does_not_take_a_dataset_without_its_manifest_for_a_new_one(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    recipe = read_manifest(folder).recipe
    (folder / MANIFEST).unlink()
    with pytest.raises(
        BuildError, match=f"has lost its manifest.json; `tcmrl-data verify {folder} --repair`"
    ):
        tcmrl_data.build_dataset(recipe, folder)


def test_a_manifest_without_a_copy_is_recovered_by_building_again(tiny_copy: Copy, tiny_folder: Path) -> None:
    folder = tiny_copy()
    recipe = read_manifest(folder).recipe
    for name in (MANIFEST, MANIFEST_COPY):
        (folder / name).write_bytes(b"rot")
    with pytest.raises(ManifestError, match=str(folder / MANIFEST)):
        repair_dataset(folder)
    for name in (MANIFEST, MANIFEST_COPY):
        (folder / name).unlink()
    tasks = [task.index for task in open_dataset(tiny_folder).tasks]
    report = tcmrl_data.build_dataset(recipe, folder, tasks=tasks)
    assert (report.built, report.root) == (0, read_manifest(tiny_folder).root)
    assert found(folder) == set()


def test_a_dataset_in_use_cannot_be_repaired(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    with lock_file(folder / LOCK, "the dataset"), pytest.raises(LockedError, match=f"process {os.getpid()}"):
        repair_dataset(folder)
