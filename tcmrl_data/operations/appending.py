"""Further parts for a dataset in its place."""

from collections.abc import Sequence

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.disk import STAGING, replace_file
from tcmrl_data.foundation.errors import BuildError, StoreError
from tcmrl_data.parts.making import Published, numbered
from tcmrl_data.store.limits import MAX_PARTS, MAX_PLATFORMS, MAX_RUNS
from tcmrl_data.store.manifest import MANIFEST, Manifest, Run, read_manifest, seal
from tcmrl_data.store.part_table import PARTS_TABLE, part_line
from tcmrl_data.store.sealing import is_complete, totals_of
from tcmrl_data.store.tables import TableWriter, read_sealed


def append_parts(dataset: Dataset, *, runs: Sequence[Run], parts: Sequence[Published]) -> Manifest:
    """Adds published parts to a dataset; they belong to it as soon as the new manifest is there.

    The lines of the parts are forced to disk before the manifest that seals them. A crash leaves the dataset
    as it was, with files of parts that the same command finds again. The caller holds the dataset's lock.

    Args:
        dataset: as it stands on disk.
        runs: all runs of the dataset from now on.
        parts: the new parts, whose files are in their places.

    Raises:
        StoreError: the dataset has changed since it was opened.
        BuildError: more parts, runs or platforms than a dataset may have.
        StorageError: the operating system refuses an operation.
    """
    manifest, folder = dataset.manifest, dataset.folder
    if read_manifest(folder).digest != manifest.digest:
        raise StoreError(f"{folder} has changed meanwhile; run the same command again")
    platforms = list(manifest.platforms)
    entries = sorted(numbered(parts, platforms), key=lambda entry: entry.key)
    recorded = dataset.recorded_parts.with_entries(entries)
    for what, found, limit in (
        ("parts", len(recorded), MAX_PARTS),
        ("runs", len(runs), MAX_RUNS),
        ("platforms", len(platforms), MAX_PLATFORMS),
    ):
        if found > limit:
            raise BuildError(f"{folder} would have {found} {what}, more than the {limit} that are allowed")
    table = TableWriter(folder / PARTS_TABLE, read_sealed(folder / PARTS_TABLE, manifest.parts))
    table.append(b"".join(map(part_line, entries)))
    table.sync()
    kept = recorded.without_tasks(manifest.dropped)
    fields = manifest.model_dump(mode="json", exclude={"digest"}) | {
        "runs": [run.model_dump(mode="json") for run in runs],
        "platforms": [platform.model_dump(mode="json") for platform in platforms],
        "parts": table.seal.model_dump(),
        "totals": totals_of(kept).model_dump(),
        "root": kept.root,
        "complete": is_complete(kept, runs, num_tasks=manifest.num_tasks),
    }
    replace_file(folder / MANIFEST, seal(fields), staging=folder / STAGING)
    return read_manifest(folder)
