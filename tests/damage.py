"""Damaged and littered datasets."""

import random
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


def damaged(data: bytes, chance: random.Random) -> bytes | None:
    """Data with a bit, a run of bytes or the length changed, or no file."""
    place = chance.randrange(len(data))
    match chance.randrange(6):
        case 0:
            return data[:place]
        case 1:
            return data[:place] + bytes(min(512, len(data) - place)) + data[place + 512 :] + b"\1"
        case 2:
            return data[:place] + chance.randbytes(1) + data[place:]
        case 3:
            return None
        case _:
            return data[:place] + bytes([data[place] ^ 1 << chance.randrange(8)]) + data[place + 1 :]


def write(file: Path, data: bytes | None) -> None:
    if data is None:
        file.unlink(missing_ok=True)
    else:
        file.write_bytes(data)


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
