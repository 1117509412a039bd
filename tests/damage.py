"""Damaged and littered datasets."""

from pathlib import Path

from tcmrl_data import open_dataset, verify_dataset
from tcmrl_data.building.work_files import STATUS
from tcmrl_data.foundation.disk import CHECKPOINTS, STAGING
from tcmrl_data.store.tables import PartKey


def rot(file: Path) -> None:
    """Changes a byte in the middle of a file."""
    data = file.read_bytes()
    middle = len(data) // 2
    file.write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])


def ids_of(folder: Path) -> dict[PartKey, str]:
    return {entry.key: entry.id for entry in open_dataset(folder).parts.entries()}


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


def data_files(folder: Path) -> list[Path]:
    return sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and not path.relative_to(folder).parts[0].startswith((".", STATUS))
    )


def found(folder: Path) -> set[str]:
    return {finding.file for finding in verify_dataset(folder, strict=True).findings}
