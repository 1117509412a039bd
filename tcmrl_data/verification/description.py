"""The manifest and the tables of a dataset, read as far as they can be and compared with each other."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.plain_files import words_after
from tcmrl_data.store.manifest import MANIFEST, Manifest, TableSeal, read_manifest
from tcmrl_data.store.part_table import PARTS_TABLE, PartTable, parse_parts
from tcmrl_data.store.sealing import is_complete
from tcmrl_data.store.tables import read_sealed
from tcmrl_data.store.task_table import TASKS, parse_tasks
from tcmrl_data.verification.findings import Finding, finding


@dataclass
class Description:
    """What a dataset says of itself.

    Attributes:
        manifest: None where it cannot be read.
        tasks: of the table; none where it cannot be read.
        table: the parts; empty where it cannot be read.
        unreadable: tables that cannot be read.
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
        """Compares the manifest and those tables that can be read with each other."""
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

    def _add(self, file: str, problem: str) -> None:
        self.findings.append(finding(file, problem))
