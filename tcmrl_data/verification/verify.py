"""Verification of a dataset, file by file; damage is reported as findings and not raised.

`quick` checks names, sizes, links and the allow-list; `digests` also hashes every file; `deep` also decodes
every array and checks its content (`contents.py`); `replay.py` rolls parts out again.
"""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tcmrl_data.foundation.canonical import sha256
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.plain_files import (
    file_problem,
    folder_problem,
    one_line,
    read_plain_file,
    words_after,
)
from tcmrl_data.store.layout import GROUP
from tcmrl_data.store.manifest import (
    MANIFEST,
    Manifest,
    PartEntry,
    PartRecord,
    TaskRecord,
    dataset_folder,
    part_folder,
    read_manifest,
    read_sealed_part,
)
from tcmrl_data.store.part_files import identity_problems, layout_problems
from tcmrl_data.verification.contents import content_problems, task_problems
from tcmrl_data.verification.replay import Replay, replay_part, spread_parts
from tcmrl_data.verification.scan import Scan, scan_dataset

VerifyLevel = Literal["quick", "digests", "deep"]
Key = tuple[int, int]
PART = re.compile(r"tasks/([0-9]{5,10})/snapshots/step_([0-9]{7,10})(?:/|$)")


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        file: path relative to the dataset; a folder where a whole folder is meant.
        problem: what is wrong with it.
        task: task of the part that it belongs to.
        step: snapshot step of that part.
        foreign: it belongs to no part that the manifest names; repair leaves it alone.
    """

    file: str
    problem: str
    task: int | None = None
    step: int | None = None
    foreign: bool = False


@dataclass(frozen=True)
class VerifyReport:
    """Result of a verification.

    Attributes:
        parts: number of parts checked.
        files: number of files found, without work files.
        bytes: their total size.
        findings: everything that is wrong, ordered by file.
    """

    dataset: Path
    level: VerifyLevel
    parts: int
    files: int
    bytes: int
    replays: tuple[Replay, ...]
    findings: tuple[Finding, ...]
    seconds: float


def verify_dataset(
    path: str | Path,
    *,
    level: VerifyLevel = "digests",
    replay: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> VerifyReport:
    """Checks every file of a dataset and reports the findings; changes nothing.

    Args:
        path: the dataset's folder or its `manifest.json`.
        level: the checks to make, see the module.
        replay: number of parts to make again from their snapshots and seeds, spread over the dataset.
        progress: called with parts done and parts in all.

    Raises:
        ManifestError: there is no dataset at the path.

    Example:
        >>> verify_dataset("data/point-robot", level="deep").findings  # doctest: +SKIP
        ()
    """
    started = time.monotonic()
    folder = dataset_folder(path)
    if not folder.is_dir() or not any((folder / name).exists() for name in (MANIFEST, "tasks")):
        raise ManifestError(f"{folder} holds no dataset; build one with `tcmrl-data build ENV`")
    run = _Verification(folder, level, scan_dataset(folder))
    parts = run.check(progress)
    replays = run.replay(replay)
    sizes = [status.st_size for status in run.scan.files.values()]
    return VerifyReport(
        folder,
        level,
        parts,
        len(sizes),
        sum(sizes),
        replays,
        tuple(sorted(set(run.findings), key=lambda finding: (finding.file, finding.problem))),
        time.monotonic() - started,
    )


@dataclass
class _Verification:
    """One run over a dataset.

    Attributes:
        expected: files that belong to the dataset.
        opaque: folders of parts whose record cannot be trusted, so that their files are unknown.
    """

    folder: Path
    level: VerifyLevel
    scan: Scan
    findings: list[Finding] = field(default_factory=list)
    expected: set[str] = field(default_factory=lambda: {MANIFEST})
    opaque: set[str] = field(default_factory=set)
    manifest: Manifest | None = None
    entries: dict[Key, PartEntry] = field(default_factory=dict)
    tasks: dict[int, TaskRecord] = field(default_factory=dict)
    records: dict[Key, PartRecord] = field(default_factory=dict)

    def check(self, progress: Callable[[int, int], None]) -> int:
        """Checks everything but replays; returns the number of parts checked."""
        try:
            self.manifest = read_manifest(self.folder)
        except ManifestError as error:
            self._add(MANIFEST, words_after(error, self.folder / MANIFEST))
        on_disk = {
            key: match for match in map(PART.match, self.scan.paths()) if match for key in [_key(match)]
        }
        keys: set[Key] = set(on_disk)
        if self.manifest is not None:
            self.entries = {(entry.task, entry.step): entry for entry in self.manifest.parts}
            self.tasks = {task.index: task for task in self.manifest.tasks}
            keys = set(self.entries)
            for key in sorted(set(on_disk) - keys):
                self._unnamed_part(on_disk[key].group().rstrip("/"))
        self._check_groups({task for task, _ in keys})
        for done, key in enumerate(sorted(keys)):
            progress(done, len(keys))
            before = len(self.findings)
            self._check_part(key)
            if self.level == "deep" and len(self.findings) == before:
                self._check_contents(key)
        progress(len(keys), len(keys))
        self._check_manifest_values()
        self._check_odd_and_foreign()
        return len(keys)

    def replay(self, number: int) -> tuple[Replay, ...]:
        """Makes parts again and compares; parts with findings are left out."""
        if self.manifest is None or number <= 0:
            return ()
        bad = {(finding.task, finding.step) for finding in self.findings}
        replays = []
        for key in spread_parts([key for key in sorted(self.records) if key not in bad], number):
            replay = replay_part(self.folder / part_folder(*key), self.records[key], self.manifest)
            replays.append(replay)
            for problem in replay.problems:
                self._add(part_folder(*key), f"replay: {problem}")
        return tuple(replays)

    def _add(self, file: str, problem: str, *, foreign: bool = False) -> None:
        match = PART.match(file)
        task, step = _key(match) if match else (None, None)
        self.findings.append(Finding(file, problem, task, step, foreign))

    def _unnamed_part(self, place: str) -> None:
        self.opaque.add(f"{place}/")
        text = "is a part that the manifest does not name; `tcmrl-data build` takes it in if it holds"
        self._add(place, text, foreign=True)

    def _check_groups(self, tasks: set[int]) -> None:
        """The `zarr.json` files above the parts; those of tasks not begun may be missing."""
        for place, is_needed in {"": True, "tasks/": bool(tasks)}.items():
            self._check_group(f"{place}zarr.json", is_needed)
        for task in sorted({*self.tasks, *tasks}):
            snapshots = Path(part_folder(task, 0)).parent
            for folder in (snapshots.parent, snapshots):
                self._check_group(f"{folder}/zarr.json", task in tasks)

    def _check_group(self, file: str, is_needed: bool) -> None:
        self.expected.add(file)
        if file not in self.scan.files:
            if is_needed:
                self._add(file, "is missing")
        elif file_problem(self.scan.files[file]) is None and self._read(file, len(GROUP)) not in (
            GROUP,
            None,
        ):
            self._add(file, "is not the group record that was written here")

    def _check_part(self, key: Key) -> None:
        place = part_folder(*key)
        file = f"{place}/part.json"
        self.expected.add(file)
        blocked = folder_problem(self.folder, place)
        if blocked:
            self._add(place, f"cannot be reached: {blocked[0]} {blocked[1]}")
            return
        try:
            record, sealed = read_sealed_part(self.folder / file)
        except ManifestError as error:
            self.opaque.add(f"{place}/")
            self._add(file, words_after(error, self.folder / file))
            return
        if self.manifest is not None:
            entry, task = self.entries[key], self.tasks[key[0]]
            for problem in identity_problems(record, sealed, entry=entry, task=task, manifest=self.manifest):
                self._add(file, problem)
            if sealed != entry.sha256:
                self.opaque.add(f"{place}/")  # what the record says of other files may be the damage
                return
        self.records[key] = record
        for name, recorded in record.files.items():
            self._check_file(f"{place}/{name}", recorded.size, recorded.sha256)
        for name, problem in layout_problems(self.folder / place, record):
            self._add(f"{place}/{name}".rstrip("/"), problem)

    def _check_file(self, file: str, size: int, digest: str) -> None:
        self.expected.add(file)
        status = self.scan.files.get(file)
        if status is None:
            blocked = folder_problem(self.folder, str(Path(file).parent))
            self._add(file, f"cannot be reached: {blocked[0]} {blocked[1]}" if blocked else "is missing")
        elif file_problem(status):
            return  # reported with everything else that is odd
        elif status.st_size != size:
            self._add(file, f"has {status.st_size} bytes instead of {size}")
        elif self.level != "quick":
            data = self._read(file, size)
            if data is not None and sha256(data) != digest:
                self._add(file, "content does not have the recorded sha256")

    def _check_contents(self, key: Key) -> None:
        place = part_folder(*key)
        for file, problem in content_problems(self.folder / place, self.records[key], self.manifest):
            self._add(f"{place}/{file}", problem)

    def _check_manifest_values(self) -> None:
        """Reference scores against the parts, and with `deep` the tasks against the recipe."""
        if self.manifest is None:
            return
        for task, recorded in self.manifest.references.items():
            parts = [record for (index, _), record in sorted(self.records.items()) if str(index) == task]
            if len(parts) < len(self.manifest.steps):
                continue
            own = parts[0].references.model_dump()
            own |= {"behavior": max(part.statistics.mean for part in parts)}
            if own != recorded.model_dump():
                self._add(MANIFEST, f"references of task {task} are not those of its parts")
        if self.level == "deep":
            for problem in task_problems(self.manifest):
                self._add(MANIFEST, problem)

    def _check_odd_and_foreign(self) -> None:
        """Files of other kinds (links, pipes, devices), and files that belong to no part."""
        for file, status in self.scan.files.items():
            problem = file_problem(status)
            is_foreign = file not in self.expected
            if problem:
                self._add(file, problem, foreign=is_foreign)
            elif is_foreign and not any(file.startswith(place) for place in self.opaque):
                self._add(file, "belongs to no part", foreign=True)
        used = {str(parent) for file in self.expected for parent in Path(file).parents}
        for place in self.scan.empty_folders:
            if place not in used and not any(f"{place}/".startswith(part) for part in self.opaque):
                self._add(place, "is a folder that no part has", foreign=True)
        for place, problem in self.scan.problems.items():
            self._add(place, problem, foreign=place not in used)

    def _read(self, file: str, size: int) -> bytes | None:
        try:
            return read_plain_file(self.folder / file, limit=max(size, 2**20))
        except (OSError, ValueError) as error:
            self._add(file, one_line(error))
            return None


def _key(match: re.Match[str]) -> Key:
    return int(match[1]), int(match[2])
