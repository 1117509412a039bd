"""Further episodes from the policies that a dataset stores, without training."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.building.work_files import check_work_files
from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.foundation.disk import LOCK, lock_file, remove_abandoned
from tcmrl_data.foundation.errors import BuildError, StoreError
from tcmrl_data.operations.apply import (
    check_parts,
    keys_of_run,
    nearest_pairs,
    runs_of_pairs,
    simulated_run,
)
from tcmrl_data.operations.assembly import Plan, PlannedPart, Progress, carry_out, derivation_of
from tcmrl_data.parts.jobs import DeriveSpec, Job, derive_parts
from tcmrl_data.parts.making import numbered
from tcmrl_data.parts.own_operations import EXTEND, MAX_NOISE
from tcmrl_data.recipe.recipe import Rollouts
from tcmrl_data.store.manifest import Manifest, Run, manifest_bytes, read_manifest, write_manifest
from tcmrl_data.store.part_table import PARTS_TABLE, part_line
from tcmrl_data.store.tables import (
    MAIN_RUN,
    MAX_PARTS,
    MAX_PLATFORMS,
    MAX_RUNS,
    TableWriter,
    read_sealed,
)


@dataclass(frozen=True)
class ExtendReport:
    """What an extension did, or would do.

    Attributes:
        made: number of new parts; of parts that would be new after `dry_run`.
        present: parts that the dataset had already.
    """

    dataset: Path
    runs: tuple[str, ...]
    made: int
    present: int
    episodes: int
    root: str | None


def extend_dataset(
    path: str | Path,
    *,
    episodes: int,
    out: Path | None = None,
    run: str = "extended",
    of: str = MAIN_RUN,
    tasks: Sequence[int] | None = None,
    snapshots: str = "last",
    first_episode: int | None = None,
    noise: float = 0.0,
    cross: int = 0,
    allow_drift: bool = False,
    workers: int | None = None,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> ExtendReport:
    """Lets the policies of stored parts act again, with the next of their keyed seeds.

    Episode n of a policy depends on its seed, task and snapshot step and on n alone: with `first_episode=0`
    the stored episodes come back bit for bit, and later ones are new and equal whenever they are made. The
    new parts are a run of their own. What is there already is kept, so the same call goes on after a stop.

    Args:
        episodes: of every new part; a multiple of the recipe's lanes.
        out: folder of a new dataset with all old and the new parts; None adds the parts to the dataset.
        run: name of the new run. With `cross`, further runs `<run>-2`, … hold what else comes to a task.
        of: run whose policies act.
        tasks: indices of the tasks whose policies act; all where None.
        first_episode: number of the first episode, a multiple of the lanes; that after the run's last one
            where None.
        noise: standard deviation of normal noise that is added to actions, before they are clipped.
        cross: number of nearest tasks of the same split, by parameters, in which a policy acts instead of its
            own; 0 for its own task.
        allow_drift: also on another platform than that of the stored parts, where episodes are not those that
            their platform would give.
        workers: processes at the same time; one per core where None.

    Raises:
        SelectionError: an unknown run, nothing selected, or no tasks nearby.
        BuildError: numbers out of range, parts without a policy or seed, a run of the same name with other
            settings, or a worker that failed; what was published is kept.
        NondeterminismError: the parts were made on another platform.
        StoreError: `out` holds something else, or a part is damaged.
        LockedError: another process writes to the dataset.

    Example:
        >>> extend_dataset("data/point-robot", episodes=50, snapshots="last").made  # doctest: +SKIP
        100
    """
    dataset = open_dataset(path)
    source, recipe, seed = simulated_run(dataset, of)
    first = recipe.rollouts.episodes if first_episode is None else first_episode
    _check_numbers(dataset, recipe.rollouts.lanes, episodes, first, noise, cross)
    recipe = recipe.model_copy(update={"rollouts": Rollouts(episodes=episodes, lanes=recipe.rollouts.lanes)})
    keys = keys_of_run(dataset, of, tasks, snapshots)
    acting = sorted({key.task for key in keys})
    pairs = [(task, task) for task in acting]
    if cross:
        pairs = nearest_pairs(dataset.tasks, [task for task in dataset.tasks if task.index in acting], cross)
    common = {"first_episode": first, "noise": float(noise)}
    origin = {"operation": EXTEND, "of": of, **common, "cross": cross}
    template = Run(name=run, kind="extended", seed=seed, recipe=recipe, origin=origin, steps=None)
    extended, jobs = runs_of_pairs(pairs, keys, template)
    check_parts(dataset, source, sorted({job.source for job in jobs}), policy=True, allow_drift=allow_drift)
    runs = _with_runs(dataset, extended, jobs)
    new = tuple(job for job in jobs if job.key not in dataset.parts)
    target = dataset.path_on_disk if out is None else out
    counts = (tuple(sorted(run.name for run in extended)), len(new), len(jobs) - len(new), episodes)
    if dry_run or (out is None and not new):
        return ExtendReport(target, *counts, None if dry_run else dataset.manifest.root)
    spec = DeriveSpec(dataset.path_on_disk, target, EXTEND, common, recipe, seed, new)
    if out is None:
        manifest = _add_parts(dataset, spec, runs=runs, workers=workers, progress=progress)
    else:
        recorded = {
            **origin,
            "run": run,
            "snapshots": snapshots,
            "tasks": tasks if tasks is None else sorted(set(tasks)),
        }
        derivation = derivation_of(EXTEND, recorded, [dataset])
        old = [PlannedPart(key, dataset, key) for key in dataset.parts]
        plan = Plan(runs, dataset.tasks, old, derivation, [dataset], spec=spec)
        manifest = carry_out(plan, out, progress, workers=workers)
    return ExtendReport(target, *counts, manifest.root)


def _check_numbers(dataset: Dataset, lanes: int, episodes: int, first: int, noise: float, cross: int) -> None:
    for name, value, least in (("--episodes", episodes, 1), ("--first-episode", first, 0)):
        if value < least or value % lanes:
            raise BuildError(
                f"{name} {value} is no multiple of the {lanes} lanes that the policies of "
                f"{dataset.folder} act in together; choose one"
            )
    if not (math.isfinite(noise) and 0 <= noise <= MAX_NOISE):
        raise BuildError(f"--noise {noise} is not in [0, {MAX_NOISE:g}]")
    if cross < 0:
        raise BuildError(f"--cross {cross} is negative; choose a number of tasks")


def _with_runs(dataset: Dataset, extended: Sequence[Run], jobs: Sequence[Job]) -> list[Run]:
    runs = {run.name: run for run in dataset.manifest.runs}
    for new in extended:
        old = runs.get(new.name)
        made = {job.key.task: job.source.task for job in jobs if job.key.run == new.name}
        held = {key.task for key in dataset.parts if key.run == new.name}
        known = dict(old.sources if old else ())
        merged = new.model_copy(update={"sources": tuple(sorted((known | dict(new.sources)).items()))})
        if old is not None and (
            old.model_copy(update={"sources": merged.sources}) != merged
            or any(old.source_of(to) != made[to] for to in made.keys() & held)
        ):
            raise BuildError(
                f"{dataset.folder} has a run {new.name} that was made with other settings; "
                "choose another --as"
            )
        runs[new.name] = merged
    return list(runs.values())


def _add_parts(
    dataset: Dataset,
    spec: DeriveSpec,
    *,
    runs: Sequence[Run],
    workers: int | None,
    progress: Progress | None,
) -> Manifest:
    """Makes parts in the dataset's own folder; they belong to it as soon as the new manifest is there.

    The lines of the parts are forced to disk before the manifest that seals them. A crash leaves the dataset
    as it was, with files of parts that the same command finds again.
    """
    folder, manifest = dataset.folder, dataset.manifest
    if dataset.path != folder:
        raise StoreError(
            f"{dataset.path} is a view, to which no parts can be added; name a new dataset by --out"
        )
    check_work_files(folder)
    with lock_file(folder / LOCK, f"dataset {folder}"):
        remove_abandoned(folder)
        if read_manifest(folder).digest != manifest.digest:
            raise StoreError(f"{folder} has changed meanwhile; run the same command again")
        platforms = list(manifest.platforms)
        made = derive_parts(spec, workers=workers, progress=progress)
        entries = sorted(numbered(made, platforms), key=lambda entry: entry.key)
        recorded = dataset.recorded_parts.with_entries(entries)
        for what, found, limit in (
            ("parts", len(recorded), MAX_PARTS),
            ("runs", len(runs), MAX_RUNS),
            ("platforms", len(platforms), MAX_PLATFORMS),
        ):
            if found > limit:
                raise BuildError(
                    f"{folder} would have {found} {what}, more than the {limit} that are allowed"
                )
        table = TableWriter(folder / PARTS_TABLE, read_sealed(folder / PARTS_TABLE, manifest.parts))
        table.append(b"".join(map(part_line, entries)))
        table.sync()
        data = manifest_bytes(
            label=manifest.label,
            data_version=manifest.data_version,
            runs=runs,
            derivation=manifest.derivation,
            platforms=platforms,
            tasks=manifest.tasks,
            parts=table.seal,
            dropped=manifest.dropped,
            kept=recorded.without_tasks(manifest.dropped),
        )
        write_manifest(folder, data)
        return read_manifest(folder)
