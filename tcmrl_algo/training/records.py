"""Files that appear whole or not at all, and outlast a power cut; records are pydantic models as JSON."""

import os
import uuid
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from tcmrl_data import CheckpointError, first_problem

Record = TypeVar("Record", bound=BaseModel)


def write_file(file: Path, content: bytes) -> None:
    """Replaces a file by one rename."""
    temporary = file.with_name(f".{file.name}-{uuid.uuid4().hex}")
    with temporary.open("xb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(file)
    sync_folder(file.parent)


def write_record(file: Path, record: BaseModel) -> None:
    """Writes a record as JSON."""
    write_file(file, (record.model_dump_json(indent=1, by_alias=True) + "\n").encode())


def read_record(kind: type[Record], file: Path, *, remedy: str = "") -> Record:
    """Takes back what `write_record` wrote.

    Args:
        kind: what it is a record of.
        file: where.
        remedy: ends the message where the content is no such record.

    Raises:
        CheckpointError: missing, or not such a record.
    """
    try:
        return kind.model_validate_json(file.read_bytes())
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror}") from None
    except ValidationError as error:
        raise CheckpointError(f"{file}: {first_problem(error)}{remedy}") from None


def sync_folder(folder: Path) -> None:
    """Makes renames in a folder last."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
