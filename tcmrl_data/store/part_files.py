"""Whether a part's archive holds the files that its record calls for, in their allowed form."""

from collections.abc import Iterator, Mapping, Sequence
from math import prod
from typing import Any

from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.recipe.recipe import same_settings
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.layout import ARRAYS, ArrayLayout, check_expansion, check_layout
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part_record import RECORD, PartRecord
from tcmrl_data.store.part_table import REFERENCES, STATISTICS, PartEntry

DERIVED_KINDS = ("extended", "relabelled")
"""Kinds of runs whose parts name the task that their policy or their episodes come from."""

POLICY = ("policy.json", "policy.safetensors")
"""The snapshot; the second file is missing where the policy has no weights."""


def check_members(archive: Archive, record: PartRecord) -> list[ArrayLayout]:
    """Checks that an archive holds the files of its record's arrays and policy and no others.

    Returns:
        The layouts of the arrays.

    Raises:
        StoreError: names the file.
    """
    layouts = check_layout(
        archive, {name: array.model_dump() for name, array in record.identity.arrays.items()}
    )
    odd = _odd_member(archive, layouts, has_policy=record.identity.policy is not None)
    if odd:
        raise StoreError(f"{archive.place(odd)} does not agree with the arrays; run `tcmrl-data repair`")
    check_expansion(layouts, archive.size, archive.path)
    return layouts


def _odd_member(archive: Archive, layouts: Sequence[ArrayLayout], *, has_policy: bool) -> str | None:
    """A file that the part's record calls for and its archive lacks, or the other way round."""
    found = set(archive.names)
    for layout in layouts:
        if prod(layout.grid) > len(found):
            return f"{ARRAYS}/{layout.name}/c"
    needed = {f"{ARRAYS}/zarr.json", RECORD}.union(*(layout.files() for layout in layouts))
    needed |= {POLICY[0]} if has_policy else set()
    return min((needed ^ found) - ({POLICY[1]} if has_policy else set()), default=None)


def identity_problems(
    record: PartRecord,
    *,
    entry: PartEntry,
    task: Task,
    run: Run,
    settings: Mapping[str, Any] | None,
    data_version: int,
) -> Iterator[str]:
    """How a part's record differs from what the dataset says of it.

    Args:
        record: the part's record.
        entry: the part in the table.
        task: its task.
        run: its run.
        settings: of the run's recipe; None where the run was not built.
        data_version: of the dataset.
    """
    identity = record.identity
    for name, found, wanted in (
        ("id", record.id, entry.id),
        ("identity.task", identity.task, entry.task),
        ("identity.step", identity.step, entry.step),
        ("identity.data_version", identity.data_version, data_version),
        ("identity.parameters", identity.parameters, task.parameters),
        ("identity.seed", identity.seed, identity.seed if run.seed is None else run.seed),
    ):
        if found != wanted:
            yield f"{name} is not the manifest's"
    if settings is not None and not same_settings(identity.settings, settings):
        yield "identity.settings is not the manifest's"
    made = (identity.derived or {}).get("settings")
    if run.kind in DERIVED_KINDS and (
        not isinstance(made, dict) or made.get("task") != run.source_of(task.index)
    ):
        yield "identity.derived.settings.task is not the manifest's"
    for name in STATISTICS:
        if getattr(record.statistics, name) != getattr(entry, name):
            yield f"statistics.{name} is not that of parts.jsonl"
    for name in REFERENCES:
        if getattr(record.references, name) != getattr(entry, name):
            yield f"references.{name} is not that of parts.jsonl"
