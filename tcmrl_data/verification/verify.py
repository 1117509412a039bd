"""Verification of a dataset; damage is reported as findings and not raised.

`quick` checks names, sizes and kinds of files; `digests` also hashes every archive and checks its directory
and its record; `deep` also decodes every array, checks its content (`contents.py`), and makes extended and
other derived parts again on an equal platform; `replay.py` makes any part again. Beside a
running build, a verification checks what the manifest named when it began.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.building.work_files import DESCRIPTIONS, is_viewer_file
from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.dataset.selection import is_view_file
from tcmrl_data.foundation.disk import LOCK, lock_holder
from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.foundation.files import file_problem, words_after
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.seeding import evenly_spread
from tcmrl_data.parts.operation import can_be_made_again
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.manifest import (
    MANIFEST,
    MANIFEST_COPY,
    Manifest,
    copy_problem,
    dataset_folder,
    read_manifest,
)
from tcmrl_data.store.part import read_part_record
from tcmrl_data.store.part_table import PARTS_TABLE, PartEntry
from tcmrl_data.store.tables import PARTS, TASKS, key_of_file, part_file
from tcmrl_data.verification.contents import PartChecks, task_problems
from tcmrl_data.verification.description import (
    NO_PART,
    NO_PARTS_FOLDER,
    Description,
    Finding,
    VerifyLevel,
    finding,
    scan_dataset,
)
from tcmrl_data.verification.replay import (
    Replay,
    derived_problems,
    replay_part,
)


@dataclass(frozen=True)
class VerifyReport:
    """Result of a verification.

    Attributes:
        files: number of files found, without work files.
        notes: files of others beside the data; findings with `strict`.
    """

    dataset: Path
    level: VerifyLevel
    parts: int
    files: int
    bytes: int
    replays: tuple[Replay, ...]
    findings: tuple[Finding, ...]
    seconds: float
    notes: tuple[Finding, ...] = ()


def verify_dataset(
    path: str | Path,
    *,
    level: VerifyLevel = "digests",
    replay: int = 0,
    sample: int | None = None,
    strict: bool = False,
    sources: Sequence[str | Path | Dataset] = (),
    progress: Callable[[int, int], None] | None = None,
) -> VerifyReport:
    """Checks every file of a dataset and reports the findings; changes nothing.

    Args:
        replay: number of parts to make again from their snapshots and seeds, spread over the dataset.
        sample: number of parts, spread over the dataset, of which more than name and size is checked; all
            where None.
        strict: files of others beside the data are findings.
        sources: datasets with parts that parts of this one were made from, to make these again.

    Raises:
        ManifestError: there is no dataset at the path, or it is a view.

    Example:
        >>> verify_dataset("data/point-robot", level="deep").findings  # doctest: +SKIP
        ()
    """
    started = time.monotonic()
    if is_view_file(path):
        source = open_dataset(path).folder
        raise ManifestError(f"{path} is a sound view of {source}; verify that dataset, which holds the parts")
    folder = dataset_folder(path)
    if not folder.is_dir() or not any((folder / name).exists() for name in (MANIFEST, PARTS)):
        raise ManifestError(f"{folder} holds no dataset; build one with `tcmrl-data build ENV`")
    opened = [source if isinstance(source, Dataset) else open_dataset(source) for source in sources]
    run = _Verification(folder, level, is_locked=False, sample=sample, sources=opened)
    parts = run.check(progress)
    replays = run.replay(replay)
    sizes = [status.st_size for status in run.scan.files.values()]
    seconds = time.monotonic() - started
    found = run.sorted_findings()
    notes = () if strict else tuple(finding for finding in found if finding.note)
    found = tuple(finding for finding in found if strict or not finding.note)
    return VerifyReport(folder, level, parts, len(sizes), sum(sizes), replays, found, seconds, notes)


def find_problems(folder: Path, level: VerifyLevel) -> tuple[Finding, ...]:
    """What `verify_dataset` finds; for a caller that holds the dataset's lock."""
    run = _Verification(folder, level, is_locked=True)
    run.check()
    return run.sorted_findings()


class _Verification:
    """One run over a dataset; arguments as of `verify_dataset`."""

    def __init__(
        self,
        folder: Path,
        level: VerifyLevel,
        *,
        is_locked: bool,
        sample: int | None = None,
        sources: Sequence[Dataset] = (),
    ) -> None:
        self._folder, self._level, self._is_locked = folder, level, is_locked
        self._sample, self._sources = sample, sources
        began_beside_a_build = self._has_writer()
        self._description = Description.of(folder)
        self.findings = [*self._description.findings]
        self.scan = scan_dataset(folder)
        # another process writes to the dataset, or has done so meanwhile
        self._is_written = began_beside_a_build or self._has_writer() or self._was_written()

    def sorted_findings(self) -> tuple[Finding, ...]:
        """What was found, each once, ordered by file."""
        return tuple(sorted(set(self.findings), key=lambda found: (found.file, found.problem)))

    def check(self, progress: Callable[[int, int], None] | None = None) -> int:
        """Checks everything but replays; returns the number of parts checked."""
        manifest = self._description.manifest
        entries: dict[str, PartEntry | None] = {
            part_file(entry.key): entry for entry in self._description.table.entries()
        }
        unnamed = [file for file in self.scan.paths() if key_of_file(file) and file not in entries]
        if manifest is None or PARTS_TABLE in self._description.unreadable:
            entries = dict.fromkeys(unnamed)
        elif not self._is_written:
            for file in unnamed:
                self._add(file, _unnamed(file, manifest), foreign=True)
        checks = PartChecks(self._folder, self._level, self._description)
        opened = set(evenly_spread([*entries], len(entries) if self._sample is None else self._sample))

        def check(file: str, entry: PartEntry | None) -> list[str]:
            return list(checks.problems(file, self.scan.files.get(file), entry, opened=file in opened))

        with ThreadPoolExecutor(available_cores()) as pool:
            checked = zip(entries, pool.map(check, entries, entries.values()), strict=True)
            for done, (file, problems) in enumerate(checked):
                if progress is not None:
                    progress(done, len(entries))
                self.findings += [finding(file, problem) for problem in problems]
        if progress is not None:
            progress(len(entries), len(entries))
        if self._level == "deep" and manifest is not None and manifest.is_drawn:
            splits = manifest.derivation.split_of_tasks() if manifest.derivation else {}
            for problem in task_problems(self._description.tasks, manifest.recipe, splits):
                self._add(TASKS, problem)
        if self._level == "deep" and manifest is not None:
            table, runs = self._description.table, {run.name: run for run in manifest.runs}
            files = self._files_of_parts()
            only = opened - {found.file for found in self.findings}
            for file, problem in derived_problems(self._folder, table, runs, files, only=only):
                self._add(file, problem)
        of_copy = copy_problem(self._folder)
        if of_copy and not self._is_written:
            self._add(MANIFEST_COPY, of_copy)
        viewer = filter(is_viewer_file, self.scan.files)
        described = {MANIFEST, TASKS, PARTS_TABLE, *DESCRIPTIONS, *viewer}
        self._check_odd_and_foreign(described | {*entries, *unnamed})
        return len(entries)

    def replay(self, number: int) -> tuple[Replay, ...]:
        """Makes parts again and compares; parts with findings are left out."""
        runs = self._description.manifest.runs if self._description.manifest else ()
        bad = {found.file for found in self.findings}
        recipes = {run.name: run.recipe for run in runs if run.recipe and can_be_made_again(run)}
        keys = [key for key in self._description.table if part_file(key) not in bad and key.run in recipes]
        files = self._files_of_parts() if number else {}
        replays = []
        for key in evenly_spread(keys, number):
            file = self._folder / part_file(key)
            try:
                with Archive(file) as archive:
                    record = read_part_record(archive)
                    replay = replay_part(archive, record, key, recipes[key.run], files)
            except (StoreError, ManifestError) as error:  # the quick level has not opened it
                self._add(part_file(key), words_after(error, file))
                continue
            if replay is not None:
                replays.append(replay)
                for problem in replay.problems:
                    self._add(part_file(key), f"replay: {problem}")
        return tuple(replays)

    def _files_of_parts(self) -> dict[str, Path]:
        """The files of the sound parts of the dataset and its sources, by their ids."""
        bad = {found.file for found in self.findings}
        files = {
            entry.id: source.file_of(entry.key)
            for source in self._sources
            for entry in source.parts.entries()
        }
        return files | {
            entry.id: self._folder / part_file(entry.key)
            for entry in self._description.table.entries()
            if part_file(entry.key) not in bad
        }

    def _has_writer(self) -> bool:
        return not self._is_locked and lock_holder(self._folder / LOCK) is not None

    def _was_written(self) -> bool:
        """Whether the manifest is another one than that which was read."""
        manifest = self._description.manifest
        try:
            return manifest is not None and read_manifest(self._folder).digest != manifest.digest
        except ManifestError:
            return False

    def _check_odd_and_foreign(self, expected: set[str]) -> None:
        for file, status in self.scan.files.items():
            problem = file_problem(status)
            if file not in expected:
                self._add(file, problem or NO_PART, foreign=True)
            elif problem and key_of_file(file) is None:
                self._add(file, problem)
        for name, seal in self._description.seals.items():
            found = self.scan.files.get(name)
            if not self._is_written and found is not None and found.st_size > seal.bytes:
                text = "holds lines that the manifest does not seal; `tcmrl-data build` takes them in"
                self._add(name, text, foreign=True)
        folders = {Path(file).parent for file in expected}
        used = {str(parent) for folder in folders for parent in (folder, *folder.parents)}
        for place in self.scan.empty_folders - used:
            if not self._is_written:
                self._add(place, NO_PARTS_FOLDER, foreign=True)
        for place in self.scan.hidden:
            self._add(place, NO_PART, foreign=True)
        for place, problem in self.scan.problems.items():
            self._add(place, problem, foreign=place not in used)

    def _add(self, file: str, problem: str, *, foreign: bool = False) -> None:
        self.findings.append(finding(file, problem, foreign=foreign))


def _unnamed(file: str, manifest: Manifest) -> str:
    key = key_of_file(file)
    if key and key.task in manifest.dropped:
        return (
            "is a part of a dropped task that the manifest does not name; delete it, or build with "
            f"--tasks {key.task}"
        )
    if key and key.run not in {run.name for run in manifest.runs}:
        return "is a part that the manifest does not name; the command that made it takes it in"
    return "is a part that the manifest does not name; `tcmrl-data build` takes it in if it holds"
