"""ViewFile files: they name parts of a dataset, and open as a dataset does.

A view holds the path of its source relative to itself, the source's root, and the keys of its parts. It opens
only on a source with that root.
"""

import functools
from collections.abc import Iterable, Iterator
from pathlib import Path

from pydantic import Field, model_validator

from tcmrl_data.foundation.canonical import MAX_JSON_BYTES, parse_json
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.foundation.plain_files import one_line, read_plain_file
from tcmrl_data.foundation.records import Record, count_ranges, parse_record, read_ranges
from tcmrl_data.store.keys import MAX_STEPS, MAX_TASKS, RUN_NAME, SHA256, PartKey
from tcmrl_data.store.manifest import MANIFEST, Derivation, Manifest, Totals

VIEW_SCHEMA = 1


class ViewedParts(Record):
    """Tasks of which a view takes the same snapshots.

    Attributes:
        tasks: their indices, such as `0-9,12`.
        steps: of the snapshots, ascending.
        run: of the parts.
    """

    tasks: str
    steps: tuple[int, ...] = Field(min_length=1, max_length=MAX_STEPS)
    run: str = Field(pattern=rf"^{RUN_NAME}$")

    def __len__(self) -> int:
        return count_ranges(self.tasks, limit=MAX_TASKS) * len(self.steps)

    @property
    def keys(self) -> Iterator[PartKey]:
        """The parts."""
        for task in read_ranges(self.tasks, limit=MAX_TASKS):
            yield from (PartKey(task, step, self.run) for step in self.steps)


class ViewFile(Record):
    """A view file.

    Attributes:
        digest: sha256 of the canonical form of all other fields.
        source: the dataset's folder, relative to the view's.
        source_root: root of that dataset.
        label: the view's own name.
        derivation: how the parts were chosen, and their splits if these are not the source's.
        totals: over the parts.
        root: what the root of a dataset of these parts is.
    """

    schema_version: int
    digest: str = Field(pattern=SHA256)
    source: str = Field(min_length=1, max_length=4096)
    source_root: str = Field(pattern=SHA256)
    label: str | None = Field(max_length=200)
    derivation: Derivation
    totals: Totals
    root: str = Field(pattern=SHA256)
    parts: tuple[ViewedParts, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _is_no_larger_than_a_dataset(self) -> "ViewFile":
        if sum(map(len, self.parts)) != self.totals.parts:
            raise ValueError("totals.parts is not the number of its parts")
        return self

    @functools.cached_property
    def keys(self) -> frozenset[PartKey]:
        """The parts."""
        return frozenset(key for group in self.parts for key in group.keys)

    def manifest_of(self, source: Manifest, tasks: Iterable[int]) -> Manifest:
        """The manifest of a dataset that holds the view's parts alone.

        Args:
            source: manifest of the source.
            tasks: indices of the source's recorded tasks.
        """
        runs = [run.model_copy(update={"steps": None}) for run in source.runs]
        changes = {
            "digest": self.digest,
            "label": self.label,
            "derivation": self.derivation,
            "runs": tuple(runs),
            "dropped": tuple(sorted(set(tasks) - {key.task for key in self.keys})),
            "totals": self.totals,
            "root": self.root,
            "complete": True,
        }
        return source.model_copy(update=changes)


def is_view_file(path: str | Path) -> bool:
    """Whether a path can only be that of a view: its name ends in `.json` and is not the manifest's."""
    path = Path(path)
    return path.suffix == ".json" and path.name != MANIFEST and not path.is_dir()


def read_view(file: Path) -> ViewFile:
    """Reads a view file.

    Raises:
        ManifestError: it is missing, truncated, edited, or of another schema version.
    """
    try:
        data = read_plain_file(file, limit=MAX_JSON_BYTES)
        values = parse_json(data)
    except (FileNotFoundError, NotADirectoryError):
        raise ManifestError(
            f"{file} does not exist; make a view with `tcmrl-data derive --view {file}`"
        ) from None
    except (OSError, ValueError) as error:
        raise ManifestError(f"{file}: not a view ({one_line(error)}); derive it again") from None
    return parse_record(ViewFile, values, file, version=VIEW_SCHEMA, data=data)
