"""A published part, as a worker reports it to the driver or as it is found on disk."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.foundation.canonical import canonical_json
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.part_files import check_members
from tcmrl_data.store.part_record import PartRecord, read_part_record
from tcmrl_data.store.part_table import PartEntry, part_entry
from tcmrl_data.store.platform import Platform


@dataclass(frozen=True)
class Published:
    """A published part.

    Attributes:
        entry: its line of the table, but for `platform`, which only the driver knows.
        platform: on which it was made.
    """

    entry: PartEntry
    platform: Platform

    @classmethod
    def of_record(cls, record: PartRecord, *, run: str, archive: bytes) -> "Published":
        """The part with a record, published as `archive` in a run."""
        return cls(part_entry(record, run=run, platform=0, archive=archive), record.platform)

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> "Published":
        """The inverse of `to_message`."""
        platform = Platform.model_validate_json(canonical_json(message["platform"]))
        return cls(PartEntry(*message["entry"]), platform)

    def to_message(self) -> dict[str, Any]:
        """What a worker tells its driver."""
        platform = self.platform.model_dump(mode="json")
        return {"kind": "part", "entry": list(self.entry), "platform": platform}


def read_published(file: Path, run: str) -> tuple[Published, PartRecord]:
    """Reads a whole part that nobody has described yet, and its record.

    Raises:
        StoreError: it is damaged.
        ManifestError: its record is.
    """
    with Archive(file) as archive:
        record = read_part_record(archive)
        check_members(archive, record)
        for name in archive.names:
            archive.read(name)  # compares its checksum
        return Published.of_record(record, run=run, archive=archive.content()), record


def numbered(parts: Iterable[Published], platforms: list[Platform]) -> list[PartEntry]:
    """The parts' lines with the positions of their platforms; adds new platforms to the list."""
    positions = {platform.digest(): position for position, platform in enumerate(platforms)}
    entries = []
    for part in parts:
        position = positions.setdefault(part.platform.digest(), len(platforms))
        if position == len(platforms):
            platforms.append(part.platform)
        entries.append(part.entry._replace(platform=position))
    return entries
