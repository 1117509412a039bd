"""What a dataset says of itself, what lies in its folder, and what is found to be wrong with the two."""

import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tcmrl_data.building.work_files import WORK_FILES, WORK_FOLDERS
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.files import one_line, status_of, words_after
from tcmrl_data.foundation.records import differences
from tcmrl_data.store.manifest import MANIFEST, Manifest, is_complete, read_manifest, totals_of
from tcmrl_data.store.part_table import PARTS_TABLE, PartTable, parse_parts
from tcmrl_data.store.tables import (
    PARTS,
    TASKS,
    PartKey,
    TableSeal,
    is_part_folder,
    key_of_file,
    parse_tasks,
    read_sealed,
)

VerifyLevel = Literal["quick", "digests", "deep"]

NO_PART = "belongs to no part"
NO_PARTS_FOLDER = "is a folder that no part has"
NO_SOURCE = "was not made again: the part that it was made from is not here; name its dataset by --source"

LEFT_EVERYWHERE = {"Thumbs.db", "desktop.ini"}
"""Files that a system leaves in any folder, beside those whose names begin with a dot."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        file: path relative to the dataset; a folder where a whole folder is meant.
        foreign: it belongs to nothing that the manifest names; repair leaves it alone.
    """

    file: str
    problem: str
    task: int | None = None
    step: int | None = None
    run: str | None = None
    foreign: bool = False

    @property
    def key(self) -> PartKey | None:
        """The part that a finding says is damaged; None for other files, and for foreign ones."""
        return None if self.foreign or self.note else key_of_file(self.file)

    @property
    def note(self) -> bool:
        """Whether nothing is damaged: a part that could not be made again, or files of others."""
        if self.problem == NO_SOURCE:
            return True
        name = self.file.rpartition("/")[2]
        is_beside = not self.file.startswith(f"{PARTS}/") or name.startswith(".") or name in LEFT_EVERYWHERE
        return self.foreign and self.problem in (NO_PART, NO_PARTS_FOLDER) and is_beside


def finding(file: str, problem: str, *, foreign: bool = False) -> Finding:
    """A finding about a file, which may be a part's."""
    key = key_of_file(file)
    if key is None:
        return Finding(file, problem, foreign=foreign)
    return Finding(file, problem, key.task, key.step, key.run, foreign)


@dataclass(frozen=True)
class Scan:
    """What lies in a folder, by relative path.

    Attributes:
        files: status of everything that is no folder, such as a link to a folder that parts do not lie in.
        problems: folders that could not be listed, and why.
        hidden: folders of others, such as `.git`, which are left alone.
    """

    files: dict[str, os.stat_result]
    empty_folders: set[str]
    problems: dict[str, str]
    hidden: set[str]

    def paths(self) -> Iterator[str]:
        """Every path found, in no order."""
        yield from self.files
        yield from self.empty_folders
        yield from self.problems


def scan_dataset(folder: Path, *, follow: bool = True) -> Scan:
    """Lists a dataset, work files left out where they are of their kind.

    Args:
        follow: list what links in the places of parts and tables lead to; else the links themselves.
    """
    scan = Scan({}, set(), {}, set())
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
            if is_folder and entry.name.startswith(".") and path not in WORK_FOLDERS:
                scan.hidden.add(path)
            elif is_folder and path not in WORK_FOLDERS:
                waiting.append(path)
            elif not is_folder and not (path in WORK_FILES and stat.S_ISREG(status.st_mode)):
                scan.files[path] = status
    return scan


@dataclass
class Description:
    """What a dataset says of itself.

    Attributes:
        manifest: None where it cannot be read.
        tasks: of the table; none where it cannot be read.
        table: the parts; empty where it cannot be read.
        findings: what is wrong with manifest and tables.
    """

    folder: Path
    manifest: Manifest | None = None
    tasks: tuple[Task, ...] = ()
    table: PartTable = field(default_factory=PartTable.empty)
    unreadable: set[str] = field(default_factory=set)
    findings: list[Finding] = field(default_factory=list)

    @classmethod
    def of(cls, folder: Path) -> "Description":
        """Reads and compares what a folder holds."""
        found = cls(folder)
        try:
            found.manifest = read_manifest(folder)
        except ManifestError as error:
            found._add(MANIFEST, words_after(error, folder / MANIFEST))
        else:
            found._read_tables()
            found._check_tables(found.manifest)
        return found

    @property
    def seals(self) -> Mapping[str, TableSeal]:
        """The seals of the tables by their files."""
        if self.manifest is None:
            return {}
        return {TASKS: self.manifest.tasks, PARTS_TABLE: self.manifest.parts}

    def _read_tables(self) -> None:
        for name, seal in self.seals.items():
            file = self.folder / name
            try:
                data = read_sealed(file, seal)
                if name == TASKS:
                    self.tasks = parse_tasks(data, file)
                else:
                    self.table = parse_parts(data, file)
            except ManifestError as error:
                self.unreadable.add(name)
                self._add(name, words_after(error, file))

    def _check_tables(self, manifest: Manifest) -> None:
        table = self.table
        indices = {task.index for task in self.tasks}
        if TASKS not in self.unreadable:
            if not indices.issuperset(manifest.dropped):
                self._add(MANIFEST, f"dropped names a task that {TASKS} does not have")
            if not indices.issuperset(table.columns["task"].tolist()):
                self._add(PARTS_TABLE, f"names a task that {TASKS} does not have")
        if not {run.name for run in manifest.runs}.issuperset(table.runs):
            self._add(PARTS_TABLE, "names a run that the manifest does not have")
        if table.columns["platform"].max(initial=-1) >= len(manifest.platforms):
            self._add(PARTS_TABLE, "names a platform that the manifest does not have")
        if PARTS_TABLE not in self.unreadable:
            self._check_sums(manifest, table)

    def _check_sums(self, manifest: Manifest, table: PartTable) -> None:
        kept = table.without_tasks(manifest.dropped)
        expected = {
            "root": kept.root,
            "totals": totals_of(kept).model_dump(),
            "complete": is_complete(kept, manifest.runs, num_tasks=manifest.num_tasks),
        }
        for name, _, _ in differences(expected, manifest.model_dump(include={*expected})):
            self._add(MANIFEST, f"{name} does not agree with {PARTS_TABLE}")

    def _add(self, file: str, problem: str) -> None:
        self.findings.append(finding(file, problem))
