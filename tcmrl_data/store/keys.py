"""The keys of parts, the files that follow from them, and how large a dataset may become."""

import re
from typing import NamedTuple

from tcmrl_data.foundation.errors import BuildError

MAIN_RUN = "main"
RUN_NAME = r"[a-z0-9_-]{1,64}"
SHA256 = r"^[0-9a-f]{64}$"
PARTS = "parts"
"""Folder of the parts' archives."""

_PART_FOLDER = re.compile(rf"{PARTS}(?:/{RUN_NAME}(?:/[0-9]{{5,10}})?)?")
_PART_FILE = re.compile(rf"{PARTS}/({RUN_NAME})/([0-9]{{5,10}})/([0-9]{{7,10}})\.zip")


class PartKey(NamedTuple):
    """What a part is called within a dataset; keys are sorted by task, step and run.

    Attributes:
        task: index of the task.
        step: snapshot step.
        run: name of the run that the part belongs to.
    """

    task: int
    step: int
    run: str = MAIN_RUN

    def __str__(self) -> str:
        return f"task {self.task}, step {self.step}, run {self.run}"


def part_file(key: PartKey) -> str:
    """Path of a part's archive, relative to the dataset."""
    return f"{part_folder(key)}/{key.step:07d}.zip"


def part_folder(key: PartKey) -> str:
    """Path of the folder that holds the archives of a task and run, relative to the dataset."""
    return f"{PARTS}/{key.run}/{key.task:05d}"


def is_part_folder(path: str) -> bool:
    """Whether a relative path is that of a folder of parts: of all, of a run or of a task."""
    return _PART_FOLDER.fullmatch(path) is not None


def key_of_file(path: str) -> PartKey | None:
    """The inverse of `part_file`; None for the path of anything else."""
    match = _PART_FILE.fullmatch(path)
    key = PartKey(int(match[2]), int(match[3]), match[1]) if match else None
    return key if key is not None and part_file(key) == path else None


MAX_PARTS = 1_000_000
MAX_TASKS = 100_000
MAX_STEPS = 2**14
"""Snapshot steps of a run; the manifest and every part's record list them."""
MAX_RUNS = 1_000
MAX_PLATFORMS = 1_000

MAX_INDEX = 2**31
"""Task indices and snapshot steps lie below this."""

MAX_COUNT = 2**40
"""Numbers of episodes, steps and bytes lie below this."""

MAX_ARRAYS = 32
MAX_COLUMNS = 2**14
"""Width of observations and actions; a part's record holds two sums per column."""

LINE_BYTES = 2**16
"""A line of a table; the parameters of a task must fit into it."""

PART_RECORD_BYTES = 2**21


def check_plan(*, tasks: int, steps: int, columns: int, largest_task: int) -> None:
    """Checks that a dataset will not become larger than readers allow.

    Args:
        tasks: number of tasks.
        steps: number of snapshot steps of every task.
        columns: width of observations or actions, whichever is larger.
        largest_task: bytes of the longest line of a task.

    Raises:
        BuildError: names the limit and what exceeds it.
    """
    for what, found, limit in (
        ("tasks", tasks, MAX_TASKS),
        ("snapshot steps", steps, MAX_STEPS),
        ("parts", tasks * steps, MAX_PARTS),
        ("columns of observations or actions", columns, MAX_COLUMNS),
        ("bytes for the parameters of one task", largest_task, LINE_BYTES),
    ):
        if found > limit:
            raise BuildError(
                f"the dataset would have {found:,} {what}, more than the {limit:,} that a dataset may have"
            )
