"""What a dataset holds while it is built: its tables and its manifest, written by the driver alone."""

import os
import time
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.foundation.disk import named_errors
from tcmrl_data.foundation.errors import (
    BuildError,
    ManifestError,
    StorageError,
    StoreError,
    UnreadableError,
)
from tcmrl_data.foundation.files import file_problem, folder_problem, status_of, wait_until_visible
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.parts.making import Published, read_published
from tcmrl_data.recipe.recipe import same_settings
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.manifest import MANIFEST, Run, manifest_bytes, read_manifest, write_manifest
from tcmrl_data.store.part import DATA_VERSION
from tcmrl_data.store.part_table import (
    HEADER,
    PARTS_TABLE,
    PartEntry,
    PartTable,
    parse_entries,
    parse_parts,
    part_line,
)
from tcmrl_data.store.tables import (
    MAIN_RUN,
    MAX_PLATFORMS,
    TASKS,
    PartKey,
    TableWriter,
    key_of_file,
    parse_tasks,
    part_file,
    part_folder,
    read_log,
    read_sealed,
    task_line,
)

SEAL_SECONDS = 1.0
SEAL_SHARE = 0.05
"""While parts arrive, the manifest is written every second at most, and in this share of the time at most."""


class Ledger:
    """The tables and the manifest of a dataset that is being built.

    Args:
        plan: what to build; tasks that the dataset has already are taken from there.
        out: the dataset's folder. Nothing is written before `begin`.
        taken_up: indices of tasks that belong to the dataset even if it has dropped them.

    Attributes:
        plan: with the tasks of the dataset.
        num_parts: parts that are there, of those that the plan calls for.
        damaged: files of parts that nothing had recorded when they were damaged; `begin` deletes them.

    Raises:
        StoreError: a recorded part is missing or of another size, or a part is not of the plan.
    """

    def __init__(self, plan: BuildPlan, out: Path, *, taken_up: Collection[int] = ()) -> None:
        self._out = out
        self._earlier = read_manifest(out) if (out / MANIFEST).is_file() else None
        tasks, parts, log = b"", b"", b""
        if self._earlier is not None:
            tasks = read_sealed(out / TASKS, self._earlier.tasks)
            parts = read_sealed(out / PARTS_TABLE, self._earlier.parts)
            log = read_log(out / PARTS_TABLE, self._earlier.parts)
        self.platforms = list(self._earlier.platforms) if self._earlier else []
        recorded = parse_tasks(tasks, out / TASKS)
        dropped = {*self._earlier.dropped} if self._earlier else set()
        self.plan = plan.with_recorded(recorded, dropped=dropped - {*taken_up})
        known = {task.index for task in recorded}
        self._new_tasks = [task for task in self.plan.tasks if task.index not in known]
        self._task_writer = TableWriter(out / TASKS, tasks)
        self._part_writer = TableWriter(out / PARTS_TABLE, parts)
        self._table = parse_parts(parts or HEADER, out / PARTS_TABLE)
        self._new: list[PartEntry] = []
        self._found: list[Published] = []
        self.damaged: list[Path] = []
        self._steps = {task.index: set[int]() for task in self.plan.wanted}
        self.num_parts = 0
        self._sealed, self._seal_seconds = time.monotonic(), 0.0
        self._find_parts(log)

    @property
    def root(self) -> str:
        """Root of the parts that are there."""
        return self._kept_parts().root

    @property
    def num_missing(self) -> int:
        """Parts that are still to be made."""
        return len(self._steps) * len(self.plan.source.steps) - self.num_parts

    def missing(self, task: int) -> list[PartKey]:
        """The parts of a task that are still to be made; none of a dropped task."""
        steps = self._steps.get(task)
        return [] if steps is None else [PartKey(task, s) for s in self.plan.source.steps if s not in steps]

    def begin(self) -> None:
        """Writes down what was found, deletes damaged parts that nothing recorded, and seals the manifest.

        Raises:
            ReadOnlyError: the folder cannot be written.
        """
        for file in self.damaged:
            with named_errors(file):
                file.unlink()
        self._task_writer.append(b"".join(map(task_line, self._new_tasks)))
        self._new_tasks = []
        if not self._part_writer.seal.lines:
            self._part_writer.append(HEADER)
        found, self._found = self._found, []
        for published in found:
            self._record(published)
        self.seal()

    def take_in(self, published: Published, *, deadline: float = 0.0) -> bool:
        """Adds a part that a worker has published; returns False if it is there already.

        Its content is not read again: the worker hashed what it wrote. The file has to be there, of the size
        that the worker wrote, with a valid directory.

        Args:
            deadline: seconds to wait at most for a file that another machine has published.
        """
        key = published.entry.key
        if key.step in self._steps[key.task]:
            return False
        wait_until_visible(self._out / part_file(key), deadline=deadline)
        with Archive(self._out / part_file(key)) as archive:
            if archive.size != published.entry.size:
                raise StoreError(
                    f"{archive.path} has {archive.size} bytes, its worker wrote {published.entry.size}"
                )
        # Counted before its line is written: if Ctrl-C comes in between, `seal` writes the line, and the part
        # is not found again as missing and recorded twice.
        self._add(key)
        self._record(published)
        wait = max(SEAL_SECONDS, self._seal_seconds / SEAL_SHARE)
        if time.monotonic() - self._sealed > wait:
            self.seal()
        return True

    def take_in_unreported(self, task: int, *, deadline: float = 0.0) -> list[PartKey]:
        """Adds the parts of a task whose reports were lost; returns those that are missing or damaged."""
        missing = []
        for key in self.missing(task):
            visible = wait_until_visible(self._out / part_file(key), deadline=deadline)
            published = self._read(key) if visible else None
            if published is None:
                missing.append(key)
            else:
                self._add(key)
                self._record(published)
        return missing

    def is_sealed(self) -> bool:
        """Whether the manifest on disk says all that is known here."""
        nothing_new = not (self._new_tasks or self._new or self._found or self.damaged)
        return nothing_new and self._is_written(self._manifest()) and not self._has_more()

    def seal(self) -> None:
        """Writes the manifest and cuts off what stands behind the tables, unless this is so already."""
        began = time.monotonic()
        unwritten = 1 + len(self._table) + len(self._new) - self._part_writer.seal.lines
        if unwritten:  # after Ctrl-C between the entry of a part and its line
            self._part_writer.append(b"".join(map(part_line, self._new[-unwritten:])))
        self._table, self._new = self._table.with_entries(self._new), []
        data = self._manifest()
        if not self._is_written(data) or self._has_more():
            self._task_writer.sync()
            self._part_writer.sync()
            write_manifest(self._out, data)
        self._sealed = time.monotonic()
        self._seal_seconds = self._sealed - began

    def _is_written(self, data: bytes) -> bool:
        file = self._out / MANIFEST
        return file.is_file() and file.read_bytes() == data

    def _has_more(self) -> bool:
        return self._task_writer.has_more or self._part_writer.has_more

    def _kept_parts(self) -> PartTable:
        found = [published.entry for published in self._found]
        return self._table.with_entries([*self._new, *found]).without_tasks(self.plan.dropped)

    def _manifest(self) -> bytes:
        plan, earlier = self.plan, self._earlier
        main = Run(
            name=MAIN_RUN,
            kind="built",
            seed=plan.seed,
            recipe=plan.recipe,
            origin=earlier.runs[0].origin if earlier else None,
            steps=plan.source.steps,
        )
        runs = [main, *(earlier.runs[1:] if earlier else ())]
        return manifest_bytes(
            label=earlier.label if earlier else None,
            data_version=DATA_VERSION,
            runs=runs,
            derivation=None,
            platforms=self.platforms,
            tasks=self._task_writer.seal,
            parts=self._part_writer.seal,
            dropped=plan.dropped,
            kept=self._kept_parts(),
        )

    def _record(self, published: Published) -> None:
        digest = published.platform.digest()
        digests = [platform.digest() for platform in self.platforms]
        if digest not in digests:
            if len(self.platforms) >= MAX_PLATFORMS:
                raise BuildError(
                    f"{self._out}: was built on {MAX_PLATFORMS} platforms, and no more are allowed"
                )
            self.platforms.append(published.platform)
            digests.append(digest)
            self.seal()  # lines behind the seal name platforms by their position in the manifest
        entry = published.entry._replace(platform=digests.index(digest))
        self._new.append(entry)
        try:
            self._part_writer.append(part_line(entry))
        except StorageError:
            self._new.pop()
            raise

    def _add(self, key: PartKey) -> None:
        self._steps[key.task].add(key.step)
        self.num_parts += 1

    def _find_parts(self, log: bytes) -> None:
        """Compares the tables with the files, and finds the parts that the tables do not name."""
        sizes = dict(self._scan())
        wanted = {PartKey(task, step) for task in self._steps for step in self.plan.source.steps}
        for key, size in zip(self._table, self._table.columns["size"].tolist(), strict=True):
            if key in wanted:
                self._check_size(key, sizes.pop(key, None), size)
                self._add(key)
        for entry in parse_entries(log):
            known = entry.platform < len(self.platforms) and sizes.get(entry.key) == entry.size
            if known and entry.key in wanted:
                del sizes[entry.key]
                self._found.append(Published(entry, self.platforms[entry.platform]))
        with ThreadPoolExecutor(available_cores()) as pool:
            unnamed = pool.map(self._read, sorted(wanted & sizes.keys()))
            self._found += [published for published in unnamed if published is not None]
        for published in self._found:
            self._add(published.entry.key)

    def _scan(self) -> Iterator[tuple[PartKey, int]]:
        """The keys and sizes of all archives in the folders of the wanted tasks."""
        for task in self._steps:
            place = part_folder(PartKey(task, 0))
            blocked = folder_problem(self._out, place)
            if blocked and not os.path.lexists(self._out / blocked[0]):
                continue
            if blocked:
                raise StoreError(f"{self._out / blocked[0]} {blocked[1]}; delete it")
            with os.scandir(self._out / place) as entries:
                for entry in entries:
                    key = key_of_file(f"{place}/{entry.name}")
                    if key is not None:
                        status = status_of(entry)
                        problem = file_problem(status)
                        if problem:
                            raise StoreError(f"{self._out / place / entry.name} {problem}; delete it")
                        yield key, status.st_size

    def _check_size(self, key: PartKey, found: int | None, recorded: int) -> None:
        if found != recorded:
            problem = "is missing" if found is None else f"has {found} bytes instead of {recorded}"
            raise StoreError(
                f"{self._out / part_file(key)} {problem}; run `tcmrl-data verify {self._out} --repair`"
            )

    def _read(self, key: PartKey) -> Published | None:
        """A part that the tables do not name; None if it is damaged."""
        file = self._out / part_file(key)
        try:
            published, record = read_published(file, key.run)
        except UnreadableError as error:
            raise UnreadableError(f"{error}; try again, or delete it") from None
        except StoreError:
            self.damaged.append(file)
            return None
        except ManifestError:
            raise StoreError(f"{file}: its record is not of this version; delete it") from None
        identity = record.identity
        if (identity.task, identity.step, identity.seed) != (key.task, key.step, self.plan.seed):
            raise StoreError(f"{file}: holds another part; delete it")
        if identity.data_version != DATA_VERSION or not same_settings(
            identity.settings, self.plan.recipe.unit_settings()
        ):
            raise StoreError(f"{file}: was built with other settings; delete it")
        return published
