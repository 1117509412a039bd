"""A dataset on this disk that is to be pushed: its files, checked; and what a push reports."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.files import read_plain_file
from tcmrl_data.foundation.records import MAX_JSON_BYTES
from tcmrl_data.recipe.imported import UNKNOWN
from tcmrl_data.store.manifest import MANIFEST, Manifest, read_manifest
from tcmrl_data.store.part_table import PARTS_TABLE, PartEntry, parse_parts, read_part
from tcmrl_data.store.tables import TASKS, part_file, read_sealed

MEMORY = 256 * 10**6
"""Bytes of parts that are under way at the same time, unless one part has more."""


@dataclass(frozen=True)
class PushReport:
    """What a push did.

    Attributes:
        address: what opens the dataset from now on.
        root: of the dataset.
        parts: number of its parts.
        sent_parts: number of parts that the address lacked.
        sent_bytes: their size, with manifest and tables.
        moved_from: root that the tag named before.
        warning: what the server may not like of the dataset.
    """

    address: str
    root: str
    parts: int
    sent_parts: int
    sent_bytes: int
    moved_from: str | None = None
    warning: str | None = None


@dataclass(frozen=True)
class PushPlan:
    """What a push into a bucket would do.

    Attributes:
        address: what would open the dataset.
        root: of the dataset.
        parts: number of its parts.
        missing_parts: number of parts that the address lacks.
        missing_bytes: their size, with manifest and tables.
        requests: that the push would make, if none is made again; the plan's own are among them.
    """

    address: str
    root: str
    parts: int
    missing_parts: int
    missing_bytes: int
    requests: int


@dataclass(frozen=True)
class LocalDataset:
    """A dataset's folder, its manifest, and the bytes of tables and manifest in the order of a push."""

    folder: Path
    manifest: Manifest
    files: dict[str, bytes]
    entries: list[PartEntry]

    def content(self, entry: PartEntry) -> bytes:
        """The bytes of a part.

        Raises:
            StoreError: it is missing or damaged.
        """
        return read_part(self.folder / part_file(entry.key), entry)


def read_local(folder: Path) -> LocalDataset:
    """Reads manifest and tables of a dataset that others may use.

    Raises:
        ManifestError: they are missing, damaged, or name no licence or origin.
    """
    manifest = read_manifest(folder)
    _check_about(folder, manifest)
    files = {
        TASKS: read_sealed(folder / TASKS, manifest.tasks),
        PARTS_TABLE: read_sealed(folder / PARTS_TABLE, manifest.parts),
        MANIFEST: read_plain_file(folder / MANIFEST, limit=MAX_JSON_BYTES),
    }
    table = parse_parts(files[PARTS_TABLE], folder / PARTS_TABLE).without_tasks(manifest.dropped)
    if table.root != manifest.root:
        raise ManifestError(f"{folder}: its parts do not have the manifest's root; run `tcmrl-data verify`")
    return LocalDataset(folder, manifest, files, list(table.entries()))


def _check_about(folder: Path, manifest: Manifest) -> None:
    """Refuses data that others could not use, because nobody says under which licence or whose they are."""
    about, nothing = manifest.recipe.about, ("", UNKNOWN)
    urls = [run.origin.get("url") for run in manifest.runs if run.origin]
    if about.licence.strip() in nothing:
        raise ManifestError(
            f"{folder} names no licence; add it where the data come in: `tcmrl-data import … --licence SPDX`"
        )
    if about.citation.strip() in nothing and not any(urls):
        raise ManifestError(
            f"{folder} says of no work to cite; add where the data come from: `tcmrl-data import … --url URL`"
        )


def batches(entries: list[PartEntry], number: int) -> Iterator[list[PartEntry]]:
    """Parts in groups of at most so many, whose bytes fit in memory together."""
    group: list[PartEntry] = []
    for entry in entries:
        if group and (len(group) == number or sum(one.size for one in group) + entry.size > MEMORY):
            yield group
            group = []
        group.append(entry)
    if group:
        yield group
