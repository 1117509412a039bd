"""Lists everything in a dataset's folder without opening files."""

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.building.work_files import WORK_FILES, WORK_FOLDERS
from tcmrl_data.foundation.plain_files import one_line, status_of
from tcmrl_data.store.keys import is_part_folder

MAX_DEPTH = 10
"""Parts lie 3 folders deep."""


@dataclass(frozen=True)
class Scan:
    """What lies in a folder, by relative path.

    Attributes:
        files: status of everything that is no folder, such as a link to a folder that parts do not lie in.
        empty_folders: folders that hold nothing.
        problems: folders that could not be listed, or lie too deep, and why.
    """

    files: dict[str, os.stat_result]
    empty_folders: set[str]
    problems: dict[str, str]

    def paths(self) -> Iterator[str]:
        """Every path found, in no order."""
        yield from self.files
        yield from self.empty_folders
        yield from self.problems


def scan_dataset(folder: Path, *, follow: bool = True) -> Scan:
    """Lists a dataset, work files left out where they are of their kind.

    Args:
        folder: the dataset.
        follow: list what links in the places of parts and tables lead to; else the links themselves.
    """
    scan = Scan({}, set(), {})
    waiting = [""]
    while waiting:
        place = waiting.pop()
        try:
            with os.scandir(folder / place) as found:
                entries = list(found)
        except OSError as error:
            scan.problems[place or "."] = f"cannot be listed ({one_line(error)})"
            continue
        if not entries and place:
            scan.empty_folders.add(place)
        for entry in entries:
            path = f"{place}/{entry.name}" if place else entry.name
            try:
                status = status_of(entry) if follow else entry.stat(follow_symlinks=False)
                if stat.S_ISDIR(status.st_mode) and entry.is_symlink() and not is_part_folder(path):
                    status = entry.stat(follow_symlinks=False)  # it may lead to any folder, the root even
            except FileNotFoundError:  # a build has renamed or removed it meanwhile
                continue
            is_folder = stat.S_ISDIR(status.st_mode)
            if is_folder and path.count("/") >= MAX_DEPTH:
                scan.problems[path] = "lies deeper than any folder of a dataset"
            elif is_folder and path not in WORK_FOLDERS:
                waiting.append(path)
            elif not is_folder and not (path in WORK_FILES and stat.S_ISREG(status.st_mode)):
                scan.files[path] = status
    return scan
