"""Deletion of datasets."""

import io
import shutil
from pathlib import Path

import pytest
from tcmrl_cli.data import data

from tcmrl_data import delete_dataset, derive_dataset
from tcmrl_data.foundation.disk import LOCK, lock_file
from tcmrl_data.foundation.errors import BuildError, LockedError, ManifestError, StoreError
from tcmrl_data.store.manifest import MANIFEST
from tests.commands import assert_refused, in_process
from tests.graded import graded_dataset


def test_a_dataset_goes_and_foreign_files_stay(tmp_path: Path) -> None:
    folder = graded_dataset(tmp_path / "data", tasks=[0]).folder
    report = delete_dataset(folder, dry_run=True)
    assert (report.files, report.kept, len(list(folder.rglob("*.zip")))) == (8, (), 5)
    (folder / "notes.txt").touch()
    (folder / "parts" / "mine").mkdir()
    (folder / "parts" / "mine" / "x.zip").touch()
    (folder / "parts" / "main" / "00007").mkdir()
    outside = tmp_path / "outside.zip"
    outside.touch()
    (folder / "parts" / "main" / "00007" / "0000000.zip").symlink_to(outside)
    (folder / "more").symlink_to(tmp_path)
    report = delete_dataset(folder)
    assert report.kept == ("more", "notes.txt", "parts/mine/x.zip")
    left = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_symlink() or not path.is_dir()
    )
    assert left == list(report.kept)
    assert outside.exists()


def test_nothing_else_is_deleted(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "tasks.jsonl").touch()
    folder = graded_dataset(tmp_path / "data", tasks=[0]).folder
    (tmp_path / "link").symlink_to(folder)
    derive_dataset(folder, view=tmp_path / "view.json")
    for name, expected in (
        ("other", "holds no dataset"),
        ("none", "is not there"),
        ("link", "is a link"),
        ("view.json", "is a file"),
    ):
        with pytest.raises(StoreError, match=expected):
            delete_dataset(tmp_path / name)
    with lock_file(folder / LOCK, "dataset"), pytest.raises(LockedError, match="is being written by process"):
        delete_dataset(folder)
    shutil.rmtree(folder / ".staging")
    (folder / ".staging").symlink_to(tmp_path / "other")
    with pytest.raises(BuildError, match="staging"):
        delete_dataset(folder)
    (folder / ".staging").unlink()
    (folder / MANIFEST).write_bytes(b"{}")
    with pytest.raises(ManifestError):
        delete_dataset(folder)
    assert len(list(folder.rglob("*.zip"))) == 5


def test_an_interrupted_deletion_goes_on(tmp_path: Path) -> None:
    folder = graded_dataset(tmp_path / "data", tasks=[0]).folder
    (folder / MANIFEST).unlink()
    delete_dataset(folder)
    assert not folder.exists()


def test_the_command_line_asks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    call = in_process(data, capsys)
    folder = graded_dataset(tmp_path / "data", tasks=[0]).folder
    code, output, _ = call("delete", folder, "--dry-run")
    assert (code, "8 files" in output, folder.exists()) == (0, True, True)
    monkeypatch.setattr("sys.stdin", io.StringIO("n\n"))
    code, _, errors = call("delete", folder)
    assert (code, "8 files" in errors, folder.exists()) == (1, True, True)
    code, output, _ = call("delete", folder, "--yes")
    assert (code, "deleted" in output, folder.exists()) == (0, True, False)
    assert_refused(call("delete", folder, "--yes"), "is not there")
