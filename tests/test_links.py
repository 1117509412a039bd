"""Copies by links, as people keep them, are datasets as good as any; writing to one changes no other."""

import hashlib
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tcmrl_algo import train_run
from tcmrl_data import (
    Dataset,
    Recipe,
    collect_garbage,
    delete_dataset,
    open_dataset,
    rename_dataset,
    repair_dataset,
    verify_dataset,
)
from tcmrl_data.building.work_files import STATUS, BuildEvent
from tcmrl_data.foundation.disk import LOCK, lock_file, lock_holder, make_own, replace_file
from tcmrl_data.foundation.errors import LockedError
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import PARTS, TASKS, PartKey, part_file
from tests.damage import ids_of, rot
from tests.disks import read_only, run_mounted
from tests.simulated_disk import PreparedParts
from tests.small_training import config_of

Link = Callable[[Path, Path, Path], object]


def run(*command: object) -> None:
    subprocess.run([str(word) for word in command], check=True)


def hard_links(folder: Path, copy: Path, store: Path) -> None:
    run("cp", "-al", folder, copy)


def symbolic_links(folder: Path, copy: Path, store: Path) -> None:
    run("cp", "-rs", folder, copy)


def links_into_blobs(folder: Path, copy: Path, store: Path) -> None:
    """As the Hub's cache and DVC keep files: under their digests, read-only, with links that name them."""
    for file in [path for path in folder.rglob("*") if path.is_file()]:
        data = file.read_bytes()
        blob = store / "blobs" / hashlib.sha256(data).hexdigest()
        blob.parent.mkdir(exist_ok=True)
        if not blob.exists():
            blob.write_bytes(data)
            blob.chmod(0o444)
        link = copy / file.relative_to(folder)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(os.path.relpath(blob, link.parent))


def parts_on_another_disk(folder: Path, copy: Path, store: Path) -> None:
    run("cp", "-a", folder, copy)
    run("cp", "-a", folder / PARTS, store / PARTS)
    run("rm", "-r", copy / PARTS)
    (copy / PARTS).symlink_to(store / PARTS)
    assert store.stat().st_dev != copy.stat().st_dev or not os.access("/dev/shm", os.W_OK)


def tasks_elsewhere(folder: Path, copy: Path, store: Path) -> None:
    run("cp", "-a", folder, copy)
    for task in list((copy / PARTS / "main").iterdir()):
        run("mv", task, store / task.name)
        task.symlink_to(store / task.name)


def other_times_and_modes(folder: Path, copy: Path, store: Path) -> None:
    run("cp", "-r", folder, copy)
    for path in [copy, *copy.rglob("*")]:
        os.utime(path, (0, 0))
        path.chmod(0o500 if path.is_dir() else 0o400)
    copy.chmod(0o700)
    (copy / ".staging").chmod(0o700)
    for place in (copy / PARTS).glob("*"):
        place.chmod(0o700)


LINKS: dict[str, Link] = {
    "hard links": hard_links,
    "symbolic links": symbolic_links,
    "links into blobs": links_into_blobs,
    "parts on another disk": parts_on_another_disk,
    "tasks elsewhere": tasks_elsewhere,
    "other times and modes": other_times_and_modes,
}


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder, but for those that are new in it or name the holder of a lock."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


@pytest.fixture
def parts(tiny: Dataset, tiny_recipe: Recipe) -> PreparedParts:
    return PreparedParts(tiny, tiny_recipe, [0, 3, 40, 60])


@pytest.fixture
def original(parts: PreparedParts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset of three of four tasks."""
    parts.build(tmp_path / "original", monkeypatch, tasks=[0, 3, 40])
    return tmp_path / "original"


def digest_after_training(folder: Path, run: Path) -> str:
    dataset = open_dataset(folder)
    return train_run(dataset, run, config=config_of(dataset), profile="quick", steps=2).digest


@pytest.mark.parametrize("kind", LINKS)
def test_a_copy_by_links_opens_verifies_trains_and_is_built_on(
    original: Path,
    parts: PreparedParts,
    tiny_folder: Path,
    tmp_path: Path,
    memory: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
) -> None:
    copy = tmp_path / "copy"
    before = contents(original)
    LINKS[kind](original, copy, memory)
    for folder in (original, copy):
        assert verify_dataset(folder, level="deep").findings == ()
    trained = [
        digest_after_training(folder, tmp_path / f"run of {folder.name}") for folder in (original, copy)
    ]
    assert trained[0] == trained[1]
    blobs = contents(memory)
    assert parts.build(copy, monkeypatch).failed == ()
    assert contents(original) == before
    assert blobs.items() <= contents(memory).items()
    for folder, tasks in ((original, {0, 3, 40}), (copy, {0, 3, 40, 60})):
        assert verify_dataset(folder, level="deep").findings == ()
        assert ids_of(folder) == {key: id for key, id in ids_of(tiny_folder).items() if key.task in tasks}


@pytest.mark.parametrize("kind", LINKS)
def test_what_changes_a_copy_by_links_leaves_the_original_as_it_is(
    original: Path, tmp_path: Path, memory: Path, kind: str
) -> None:
    copy, lost = tmp_path / "copy", part_file(PartKey(0, 100))
    LINKS[kind](original, copy, memory)
    before, elsewhere = contents(original), contents(memory)
    rename_dataset(copy, "another name")
    for name in (TASKS, PARTS_TABLE):
        data = (copy / name).read_bytes()
        replace_file(copy / name, data[:50] + b"x" + data[51:], staging=copy / ".staging")
    report = repair_dataset(copy)
    assert (report.tables, report.left) == ((PARTS_TABLE, TASKS), ())
    collect_garbage(copy)
    assert verify_dataset(copy, level="deep").findings == ()
    delete_dataset(copy)
    assert not (copy / lost).exists()
    assert (contents(original), contents(memory)) == (before, elsewhere)


def test_a_damaged_part_that_is_a_link_is_replaced_and_the_file_behind_it_stays(
    tiny_folder: Path, tmp_path: Path, memory: Path, in_process: None
) -> None:
    copy, damaged = tmp_path / "copy", part_file(PartKey(0, 100))
    links_into_blobs(tiny_folder, copy, memory)
    blob = (copy / damaged).resolve()
    blob.chmod(0o600)
    rot(blob)
    found = blob.read_bytes()
    assert [finding.file for finding in verify_dataset(copy).findings] == [damaged]
    assert repair_dataset(copy, workers=1).repaired == (PartKey(0, 100),)
    assert (copy / damaged).read_bytes() == (tiny_folder / damaged).read_bytes()
    assert blob.read_bytes() == found
    assert verify_dataset(copy).findings == ()


def test_a_snapshot_of_hard_links_in_the_middle_of_a_build_harms_neither(
    parts: PreparedParts, tiny_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, snapshots = tmp_path / "data", []

    def take(event: BuildEvent) -> None:
        if event.kind == "part" or event.kind == "unit_done":
            snapshots.append(tmp_path / f"snapshot {len(snapshots)}")
            run("cp", "-al", out, snapshots[-1])

    assert parts.build(out, monkeypatch, progress=take).failed == ()
    ids = {key: id for key, id in ids_of(tiny_folder).items() if key.task in parts.tasks}
    assert len(snapshots) > 2
    assert (ids_of(out), verify_dataset(out, level="deep").findings) == (ids, ())
    for snapshot in snapshots:
        held = ids_of(snapshot)
        assert held.items() <= ids.items()
        assert [finding for finding in verify_dataset(snapshot).findings if not finding.foreign] == []
        before = contents(out)
        assert parts.build(snapshot, monkeypatch).failed == ()
        assert (ids_of(snapshot), verify_dataset(snapshot).findings) == (ids, ())
        assert contents(out) == before


def test_a_read_only_mount_opens_verifies_and_is_listed(tiny_folder: Path) -> None:
    for command in (
        ["verify", tiny_folder, "--deep"],
        ["inspect", "returns", tiny_folder],
        ["list", tiny_folder],
    ):
        result = run_mounted(read_only(tiny_folder), *command)
        assert (result.returncode, "Error" in result.stderr) == (0, False), result.stderr


def test_two_folders_that_share_a_lock_file_have_two_locks(tmp_path: Path) -> None:
    """While the file is free; a lock that is held somewhere is taken for held in both."""
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    first, second = tmp_path / "first" / LOCK, tmp_path / "second" / LOCK
    first.touch()
    second.hardlink_to(first)
    with lock_file(first, "the first"), lock_file(second, "the second"):
        assert lock_holder(first)
        assert lock_holder(second)
        with pytest.raises(LockedError), lock_file(first, "the first"):
            pass
    second.unlink()
    second.hardlink_to(first)
    with first.open("a") as held:
        import fcntl
        import struct

        fcntl.fcntl(held, fcntl.F_OFD_SETLK, struct.pack("hhqqi4x", fcntl.F_WRLCK, 0, 0, 0, 0))
        with pytest.raises(LockedError), lock_file(second, "the second"):
            pass


def test_a_file_is_made_ones_own_before_it_is_written_into(tmp_path: Path) -> None:
    theirs, staging = tmp_path / "theirs", tmp_path / "staging"
    theirs.write_bytes(b"0123456789")
    for name, link in (("hard", Path.hardlink_to), ("symbolic", Path.symlink_to)):
        link(tmp_path / name, theirs)
        make_own(tmp_path / name, num_bytes=4, staging=staging)
        assert (tmp_path / name).read_bytes() == b"0123"
        assert (tmp_path / name).lstat().st_nlink == 1
        assert not (tmp_path / name).is_symlink()
    (tmp_path / "none").symlink_to(tmp_path / "nothing")
    make_own(tmp_path / "none", num_bytes=4, staging=staging)
    assert not (tmp_path / "none").is_symlink()
    assert theirs.read_bytes() == b"0123456789"
    assert {STATUS, MANIFEST}.isdisjoint(path.name for path in tmp_path.iterdir())
