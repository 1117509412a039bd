"""The keys of parts and the files that follow from them."""

import re
from typing import NamedTuple

MAIN_RUN = "main"
RUN_NAME = r"[a-z0-9_-]{1,64}"
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
