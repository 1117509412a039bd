"""Verification of a dataset; damage is reported as findings and not raised.

`quick` checks names, sizes and kinds of files; `digests` also hashes every archive and checks its directory
and its record; `deep` also decodes every array and checks its content (`contents.py`); `replay.py` rolls
parts out again. Beside a running build, a verification checks what the manifest named when it began.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.dataset.view import is_view_file
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.canonical import sha256
from tcmrl_data.foundation.disk import LOCK, lock_holder
from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.plain_files import file_problem, folder_problem, words_after
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.keys import PARTS, PartKey, key_of_file, part_file
from tcmrl_data.store.manifest import (
    FOREIGN_KINDS,
    MANIFEST,
    Manifest,
    Run,
    TableSeal,
    dataset_folder,
    read_manifest,
)
from tcmrl_data.store.part_files import check_members, identity_problems
from tcmrl_data.store.part_record import PartRecord, read_part_record
from tcmrl_data.store.part_table import PARTS_TABLE, PartEntry, PartTable, parse_parts
from tcmrl_data.store.sealing import is_complete
from tcmrl_data.store.tables import read_sealed
from tcmrl_data.store.task_table import TASKS, parse_tasks
from tcmrl_data.verification.contents import content_problems, task_problems
from tcmrl_data.verification.derivations import derivation_problems
from tcmrl_data.verification.replay import Replay, replay_part, spread_parts
from tcmrl_data.verification.scan import Scan, scan_dataset

VerifyLevel = Literal["quick", "digests", "deep"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        file: path relative to the dataset; a folder where a whole folder is meant.
        problem: what is wrong with it.
        task: task of the part that it belongs to.
        step: snapshot step of that part.
        run: run of that part.
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
        """The part that a finding is about; None for other files, and for foreign ones."""
        return None if self.foreign else key_of_file(self.file)


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
    sources: Sequence[str | Path | Dataset] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> VerifyReport:
    """Checks every file of a dataset and reports the findings; changes nothing.

    Args:
        path: the dataset's folder or its `manifest.json`.
        level: the checks to make, see the module.
        replay: number of parts to make again from their snapshots and seeds, spread over the dataset.
        sources: datasets that a derived dataset was made of; its derivation is done again and compared.
        progress: called with parts done and parts in all.

    Raises:
        ManifestError: there is no dataset at the path, or it is a view.
        SelectionError: `sources` of a dataset that was not derived, or not all of them.

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
    run = _Verification(folder, level, is_locked=False)
    parts = run.check(progress)
    replays = run.replay(replay)
    run.derive_again(sources)
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


def find_problems(folder: Path, level: VerifyLevel) -> tuple[Finding, ...]:
    """What `verify_dataset` finds; for a caller that holds the dataset's lock."""
    run = _Verification(folder, level, is_locked=True)
    run.check(lambda done, total: None)
    return tuple(sorted(set(run.findings), key=lambda finding: (finding.file, finding.problem)))


@dataclass
class _Verification:
    """One run over a dataset.

    Attributes:
        is_locked: this process holds the dataset's lock.
        is_written: another process writes to the dataset, or has done so meanwhile.
        manifest: None where it cannot be read; tables that cannot be read are empty.
    """

    folder: Path
    level: VerifyLevel
    is_locked: bool
    findings: list[Finding] = field(default_factory=list)

    def __post_init__(self) -> None:
        began_beside_a_build = self._has_writer()
        self.manifest = self._read_manifest()
        self.tasks, self.table = self._read_tables()
        self.scan: Scan = scan_dataset(self.folder)
        self.is_written = began_beside_a_build or self._has_writer() or self._was_written()
        self._tasks_by_index = {task.index: task for task in self.tasks}
        self._runs = {run.name: run for run in self.manifest.runs} if self.manifest else {}
        self._settings = {
            name: run.recipe.unit_settings() for name, run in self._runs.items() if run.recipe is not None
        }

    def check(self, progress: Callable[[int, int], None]) -> int:
        """Checks everything but replays; returns the number of parts checked."""
        entries: dict[str, PartEntry | None] = {part_file(entry.key): entry for entry in self.table.entries()}
        unnamed = [file for file in self.scan.paths() if key_of_file(file) and file not in entries]
        if self.manifest is None or self._is_damaged(PARTS_TABLE):
            entries = dict.fromkeys(unnamed)
        elif not self.is_written:
            for file in unnamed:
                self._add(file, self._unnamed(file), foreign=True)
        with ThreadPoolExecutor(available_cores()) as pool:
            checked = pool.map(self._check_part, entries, entries.values())
            for done, findings in enumerate(checked):
                progress(done, len(entries))
                self.findings += findings
        progress(len(entries), len(entries))
        if self.level == "deep" and self.manifest is not None and self.manifest.is_drawn:
            derivation = self.manifest.derivation
            splits = derivation.split_of_tasks() if derivation else {}
            for problem in task_problems(self.tasks, self.manifest.recipe, splits):
                self._add(TASKS, problem)
        self._check_odd_and_foreign({MANIFEST, TASKS, PARTS_TABLE, *entries, *unnamed})
        return len(entries)

    def replay(self, number: int) -> tuple[Replay, ...]:
        """Makes parts again and compares; parts with findings are left out."""
        bad = {finding.file for finding in self.findings}
        keys = [key for key in self.table if part_file(key) not in bad and self._can_replay(key)]
        replays = []
        for key in spread_parts(keys, number):
            recipe = self._run(key).recipe
            assert recipe is not None
            with Archive(self.folder / part_file(key)) as archive:
                replay = replay_part(archive, read_part_record(archive), key, recipe)
            replays.append(replay)
            for problem in replay.problems:
                self._add(part_file(key), f"replay: {problem}")
        return tuple(replays)

    def derive_again(self, sources: Sequence[str | Path | Dataset]) -> None:
        """Does the derivation again, if sources are given and the tables are sound, and compares."""
        if sources and self.manifest is not None and not self.findings:
            for file, problem in derivation_problems(Dataset(self.folder, self.manifest), sources):
                self._add(file, f"derivation: {problem}")

    def _can_replay(self, key: PartKey) -> bool:
        run = self._run(key)
        return run.recipe is not None and run.kind not in (*FOREIGN_KINDS, "subset")

    def _has_writer(self) -> bool:
        return not self.is_locked and lock_holder(self.folder / LOCK) is not None

    def _was_written(self) -> bool:
        """Whether the manifest is another one than that which was read."""
        try:
            return self.manifest is not None and read_manifest(self.folder).digest != self.manifest.digest
        except ManifestError:
            return False

    def _read_manifest(self) -> Manifest | None:
        try:
            return read_manifest(self.folder)
        except ManifestError as error:
            self._add(MANIFEST, words_after(error, self.folder / MANIFEST))
            return None

    def _read_tables(self) -> tuple[tuple[Task, ...], PartTable]:
        """The tasks and parts that the manifest seals."""
        tasks: tuple[Task, ...] = ()
        table = PartTable.empty()
        if self.manifest is not None:
            seals: Mapping[str, TableSeal] = {TASKS: self.manifest.tasks, PARTS_TABLE: self.manifest.parts}
            for name, seal in seals.items():
                file = self.folder / name
                try:
                    data = read_sealed(file, seal)
                    if name == TASKS:
                        tasks = parse_tasks(data, file)
                    else:
                        table = parse_parts(data, file)
                        self._check_table(table, self.manifest)
                except ManifestError as error:
                    self._add(name, words_after(error, file))
        return tasks, table

    def _check_table(self, table: PartTable, manifest: Manifest) -> None:
        """Compares the manifest's sums with the table."""
        kept = table.without_tasks(manifest.dropped)
        expected = {
            "root": kept.root,
            "totals.parts": len(kept),
            "totals.episodes": kept.total("episodes"),
            "totals.steps": kept.total("steps"),
            "totals.bytes": kept.total("size"),
            "complete": is_complete(kept, manifest.runs, num_tasks=manifest.num_tasks),
        }
        found = manifest.model_dump(include={"root", "totals", "complete"})
        found |= {f"totals.{name}": value for name, value in found["totals"].items()}
        for name, value in expected.items():
            if found[name] != value:
                self._add(MANIFEST, f"{name} does not agree with {PARTS_TABLE}")

    def _unnamed(self, file: str) -> str:
        """What to say of a part that no table names."""
        key = key_of_file(file)
        if self.manifest and key and key.task in self.manifest.dropped:
            return (
                "is a part of a dropped task that the manifest does not name; delete it, or build with "
                f"--tasks {key.task}"
            )
        if key and key.run not in self._runs:
            return "is a part that the manifest does not name; the command that made it takes it in"
        return "is a part that the manifest does not name; `tcmrl-data build` takes it in if it holds"

    def _check_part(self, file: str, entry: PartEntry | None) -> list[Finding]:
        """The findings of one part; `entry` is None where the table cannot tell."""
        problems = list(self._part_problems(file, entry))
        return [_finding(file, problem) for problem in problems]

    def _part_problems(self, file: str, entry: PartEntry | None) -> Iterator[str]:
        status = self.scan.files.get(file)
        if status is None:
            blocked = folder_problem(self.folder, file.rpartition("/")[0])
            yield f"cannot be reached: {blocked[0]} {blocked[1]}" if blocked else "is missing"
            return
        odd = file_problem(status)
        if odd is not None:
            yield odd
        elif entry is not None and status.st_size != entry.size:
            yield f"has {status.st_size} bytes instead of {entry.size}"
        elif self.level != "quick":
            try:
                with Archive(self.folder / file) as archive:
                    yield from self._archive_problems(archive, entry)
            except (StoreError, ManifestError) as error:
                yield words_after(error, self.folder / file)

    def _archive_problems(self, archive: Archive, entry: PartEntry | None) -> Iterator[str]:
        """Problems of an archive whose directory is sound.

        Raises:
            StoreError: its members are not those of its record.
            ManifestError: its record cannot be read.
        """
        if entry is None:
            for name in archive.names:
                archive.read(name)
        elif sha256(archive.content()) != entry.sha256:
            yield "content does not have the recorded sha256"
            return
        record = read_part_record(archive)
        check_members(archive, record)
        if entry is not None:
            yield from self._record_problems(record, entry)
        if self.level == "deep":
            run = self._runs.get(entry.run) if entry else None
            for name, problem in content_problems(archive, record, run.recipe if run else None):
                yield f"{name}: {problem}"

    def _record_problems(self, record: PartRecord, entry: PartEntry) -> Iterator[str]:
        """How a part's record differs from what the dataset says of it."""
        assert self.manifest is not None
        run, task = self._runs.get(entry.run), self._tasks_by_index.get(entry.task)
        if run is None or task is None or entry.platform >= len(self.manifest.platforms):
            yield "is of a task, a run or a platform that the dataset does not have"
            return
        if record.platform != self.manifest.platforms[entry.platform]:
            yield "was made on another platform than the dataset says"
        yield from identity_problems(
            record,
            entry=entry,
            task=task,
            run=run,
            settings=self._settings.get(entry.run),
            data_version=self.manifest.data_version,
        )

    def _check_odd_and_foreign(self, expected: set[str]) -> None:
        """Files of other kinds (links, pipes, devices), and files that belong to nothing."""
        for file, status in self.scan.files.items():
            problem = file_problem(status)
            if file not in expected:
                self._add(file, problem or "belongs to no part", foreign=True)
            elif problem and key_of_file(file) is None:
                self._add(file, problem)
        seals = {TASKS: self.manifest.tasks, PARTS_TABLE: self.manifest.parts} if self.manifest else {}
        for name, seal in seals.items():
            if not self.is_written and name in self.scan.files and self.scan.files[name].st_size > seal.bytes:
                text = "holds lines that the manifest does not seal; `tcmrl-data build` takes them in"
                self._add(name, text, foreign=True)
        folders = {Path(file).parent for file in expected}
        used = {str(parent) for folder in folders for parent in (folder, *folder.parents)}
        for place in self.scan.empty_folders - used:
            if not self.is_written:
                self._add(place, "is a folder that no part has", foreign=True)
        for place, problem in self.scan.problems.items():
            self._add(place, problem, foreign=place not in used)

    def _run(self, key: PartKey) -> Run:
        return self._runs[key.run]

    def _is_damaged(self, name: str) -> bool:
        return any(finding.file == name for finding in self.findings)

    def _add(self, file: str, problem: str, *, foreign: bool = False) -> None:
        self.findings.append(_finding(file, problem, foreign=foreign))


def _finding(file: str, problem: str, *, foreign: bool = False) -> Finding:
    key = key_of_file(file)
    where = {"task": key.task, "step": key.step, "run": key.run} if key else {}
    return Finding(file, problem, **where, foreign=foreign)  # type: ignore[arg-type]
