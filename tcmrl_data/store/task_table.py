"""`tasks.jsonl`: the tasks of a dataset, one JSON object a line."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import FailFast, Field, TypeAdapter, ValidationError

from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.canonical import canonical_json, parse_json
from tcmrl_data.foundation.errors import ManifestError, TaskError
from tcmrl_data.foundation.plain_files import one_line, printable
from tcmrl_data.foundation.records import Record, first_problem, hidden_text
from tcmrl_data.store.limits import MAX_INDEX
from tcmrl_data.store.tables import blocks

TASKS = "tasks.jsonl"


class TaskRecord(Record):
    """A task of the dataset."""

    index: int = Field(ge=0, lt=MAX_INDEX)
    split: Literal["train", "test"]
    parameters: dict[str, Any]


_RECORDS = TypeAdapter(Annotated[list[TaskRecord], FailFast()])


def task_line(task: Task) -> bytes:
    """A task as a line of the table."""
    return canonical_json({"index": task.index, "split": task.split, "parameters": dict(task.parameters)})


def parse_tasks(data: bytes, file: Path) -> tuple[Task, ...]:
    """The tasks of a table's lines, ascending by index.

    Args:
        data: complete lines.
        file: the table, for error messages.

    Raises:
        ManifestError: lines that were not written here, or a task that stands there twice.
    """
    tasks = [
        Task(record.index, record.split, record.parameters)
        for block in blocks(data, file)
        for record in _parse_block(block, file)
    ]
    if not _is_canonical(tasks, data):
        raise ManifestError(f"{file}: its lines are not written as canonical JSON")
    ordered = sorted(tasks, key=lambda task: task.index)
    if len({task.index for task in tasks}) < len(tasks):
        raise ManifestError(f"{file}: a task stands there twice")
    return tuple(ordered)


def _is_canonical(tasks: Iterable[Task], data: bytes) -> bool:
    try:
        return b"".join(map(task_line, tasks)) == data
    except ValueError:  # NaN or infinity in a task's parameters
        return False


def parse_task_file(data: bytes, file: Path) -> list[Task]:
    """The tasks of a JSON list that a user wrote: `[{"index": 0, "split": "train", "parameters": {}}]`.

    Raises:
        TaskError: it is no such list, or a task stands there twice.
    """
    try:
        records = _RECORDS.validate_python(parse_json(data), strict=True)
    except ValidationError as error:
        raise TaskError(f"{file}: {printable(first_problem(error))[:500]}") from None
    except ValueError as error:
        raise TaskError(f"{file}: not JSON ({one_line(error)})") from None
    tasks = [Task(record.index, record.split, record.parameters) for record in records]
    if len({task.index for task in tasks}) < len(tasks):
        raise TaskError(f"{file}: a task stands there twice")
    if hidden := hidden_text([task.parameters for task in tasks]):
        raise TaskError(f"{file}: {printable(hidden)[:200]} holds control characters")
    return tasks


def _parse_block(block: bytes, file: Path) -> Iterable[TaskRecord]:
    try:
        records = _RECORDS.validate_json(block, strict=True)
    except ValidationError as error:
        raise ManifestError(f"{file}: {printable(first_problem(error))[:500]}") from None
    # canonical JSON escapes every character outside printable ASCII, except DEL
    if b"\\" in block or b"\x7f" in block:
        hidden = hidden_text([record.parameters for record in records])
        if hidden:
            place = printable(hidden)[:200]
            raise ManifestError(f"{file}: {place} holds control characters, which a terminal would obey")
    return records
