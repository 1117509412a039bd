"""Applying an operation of another package to the parts of a dataset."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import validate_table
from tcmrl_data.operations.assembly import derivation_of, open_assembly
from tcmrl_data.operations.derive import check_label
from tcmrl_data.operations.planning import check_parts, keys_of_run, simulated_run
from tcmrl_data.parts.jobs import DeriveSpec, Job, derive_parts
from tcmrl_data.parts.operation import OPERATIONS
from tcmrl_data.parts.own_operations import OWN_OPERATIONS
from tcmrl_data.store.manifest import FOREIGN_KINDS, Derivation, Manifest, Run
from tcmrl_data.store.tables import MAIN_RUN, PartKey


def apply_operation(
    path: str | Path | Dataset,
    out: str | Path,
    operation: str,
    settings: Mapping[str, Any] | None = None,
    *,
    tasks: Sequence[int] | None = None,
    snapshots: str = "all",
    of: str = MAIN_RUN,
    run: str | None = None,
    label: str | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Makes a dataset whose parts an operation makes of the parts of another, each in its own task.

    The same call goes on after a stop. `verify_dataset` and `repair_dataset` make the parts again by the same
    operation, if they have the parts that these were made from: merge the two datasets for it.

    Args:
        path: a dataset or a view.
        out: folder of the new dataset, which holds the new parts alone.
        operation: name of a plug-in of `tcmrl.operations`.
        settings: of the operation.
        tasks: indices of the tasks whose parts are taken; all where None.
        snapshots: rule of `Dataset.select`.
        of: run whose parts are taken.
        run: name of the new run; that of the operation where None.
        label: the new dataset's own name.
        workers: processes at the same time; one per core where None.
        progress: called with parts done and parts in all.

    Raises:
        UnknownNameError: no installed package has the operation.
        SelectionError: settings that the operation does not take, an unknown run, or nothing selected.
        BuildError: an operation that simulates, and parts whose seeds are not known, or a failed worker.
        NondeterminismError: an operation that simulates, and parts of another platform.
        StoreError: `out` holds something else, or a part is damaged.

    Example:
        >>> import tcmrl_data
        >>> tcmrl_data.apply_operation("data/pendulum", "data/half", "every-nth", {"n": 2})  # doctest: +SKIP
    """
    dataset = path if isinstance(path, Dataset) else open_dataset(path)
    if operation in OWN_OPERATIONS:
        raise SelectionError(f"operation {operation} has a function of its own: derive, extend or relabel")
    kind = OPERATIONS.get(operation)
    check_label(label)
    keys = keys_of_run(dataset, of, tasks, snapshots)
    common = dict(settings or {})
    example = kind.settings_for(common, dataset.task(keys[0].task))
    validate_table(kind.Settings, example, place=f"operation {operation}", error=SelectionError)
    source = next(found for found in dataset.manifest.runs if found.name == of)
    recipe = source.recipe or dataset.manifest.recipe
    if kind.simulates:
        source, recipe, _ = simulated_run(dataset, of)
        check_parts(dataset, source, keys, policy=False)
    name = run or operation
    foreign = source.kind in FOREIGN_KINDS
    made = Run(
        name=name,
        kind=source.kind if foreign else "derived",
        seed=source.seed,
        recipe=recipe,
        origin=source.origin if foreign else {"operation": operation, "of": of, "settings": common},
        steps=None,
    )
    jobs = tuple(Job(key, PartKey(key.task, key.step, name)) for key in keys)
    chosen = {key.task for key in keys}
    recorded = {
        "operation": operation,
        "settings": common,
        "tasks": sorted(chosen),
        "snapshots": snapshots,
        "of": of,
        "run": name,
    }
    spec = DeriveSpec(
        dataset.path.resolve(), Path(out).resolve(), operation, common, recipe, source.seed, jobs
    )
    derivation = derivation_of("apply", recorded, [dataset])
    make_of_parts(
        dataset, Path(out), spec, derivation, runs=[made], label=label, workers=workers, progress=progress
    )
    return open_dataset(out)


def make_of_parts(
    dataset: Dataset,
    out: Path,
    spec: DeriveSpec,
    derivation: Derivation,
    *,
    runs: Sequence[Run],
    label: str | None,
    workers: int | None,
    progress: Callable[[int, int], None] | None,
) -> Manifest:
    """Makes a dataset of the parts that an operation makes of another's, and of nothing else.

    Args:
        dataset: whose parts are read.
        out: folder of the new dataset.
        spec: the parts to make.
        derivation: what is made; the same one goes on after a stop.
        runs: of the new parts.
        label: the new dataset's own name.
        workers: processes at the same time; one per core where None.
        progress: called with parts done and parts in all.
    """
    tasks = {job.key.task for job in spec.jobs}
    with open_assembly(out, derivation, [dataset]) as assembly:
        for published in derive_parts(spec, workers=workers, progress=progress):
            assembly.take(published)
        return assembly.finish(
            name=dataset.name,
            data_version=dataset.manifest.data_version,
            runs=runs,
            tasks=[task for task in dataset.tasks if task.index in tasks],
            label=label,
        )
