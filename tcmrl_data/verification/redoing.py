"""Extended and relabelled parts made again on an equal platform, which finds forged ones."""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.operations.relabelling import RELABEL
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.keys import PartKey, part_file
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part_files import DERIVED_KINDS
from tcmrl_data.store.part_record import PartRecord, read_part_record
from tcmrl_data.store.part_table import PartTable
from tcmrl_data.verification.replay import replay_part

SAME_ARRAYS = ("observations", "actions", "episode_offsets")
"""What a relabelled part has in common with its source."""


def derived_problems(
    folder: Path, table: PartTable, runs: Mapping[str, Run], *, bad: Collection[str]
) -> Iterator[tuple[str, str]]:
    """Yields files of parts that do not come out again as they are stored, and why.

    Parts of another platform are left out, since they come out with other bits here.

    Args:
        folder: the dataset.
        table: its parts.
        runs: its runs by name.
        bad: files of parts that are known not to hold.
    """
    chosen = {name for name, run in runs.items() if run.kind in DERIVED_KINDS and run.recipe is not None}
    entries = [entry for entry in table.entries() if entry.run in chosen] if chosen else []
    keys = {entry.id: entry.key for entry in table.entries()} if entries else {}
    for entry in entries:
        file = part_file(entry.key)
        recipe = runs[entry.run].recipe
        if file in bad or recipe is None:
            continue
        with Archive(folder / file) as archive:
            record = read_part_record(archive)
            replay = replay_part(archive, record, entry.key, recipe)
        for problem in replay.problems if replay.exact else ():
            yield file, f"made again: {problem}"
        yield from ((file, problem) for problem in _source_problems(folder, record, keys, bad))


def _source_problems(
    folder: Path, record: PartRecord, keys: Mapping[str, PartKey], bad: Collection[str]
) -> Iterator[str]:
    """How a part contradicts the part that it names as its source, if the dataset holds that one."""
    derived = record.identity.derived or {}
    named = derived.get("from")
    for name in named if isinstance(named, list) else ():
        key = keys.get(name) if isinstance(name, str) else None
        if key is None or part_file(key) in bad:
            continue
        try:
            with Archive(folder / part_file(key)) as archive:
                source = read_part_record(archive).identity
        except (StoreError, ManifestError):
            continue  # a finding of its own
        if record.identity.policy != source.policy:
            yield f"its policy is not that of the part of {key}, which it names as its source"
        if derived.get("operation") == RELABEL and any(
            record.identity.arrays[array] != source.arrays[array] for array in SAME_ARRAYS
        ):
            yield f"its episodes are not those of the part of {key}, which it names as its source"
