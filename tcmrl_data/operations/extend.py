"""Further episodes from the policies that a dataset stores, without training."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_data.building.work_files import check_work_files
from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.foundation.disk import LOCK, lock_file, remove_abandoned
from tcmrl_data.foundation.errors import BuildError, StoreError
from tcmrl_data.operations.assembly import Copied, append_parts, derivation_of, open_assembly
from tcmrl_data.operations.planning import (
    check_parts,
    jobs_of_pairs,
    keys_of_run,
    nearest_pairs,
    runs_of_pairs,
    simulated_run,
)
from tcmrl_data.parts.jobs import DeriveSpec, Job, derive_parts
from tcmrl_data.parts.making import Published
from tcmrl_data.parts.own_operations import EXTEND, MAX_NOISE
from tcmrl_data.recipe.recipe import Rollouts
from tcmrl_data.store.manifest import Run, read_manifest
from tcmrl_data.store.tables import MAIN_RUN, PartKey


@dataclass(frozen=True)
class ExtendReport:
    """What an extension did, or would do.

    Attributes:
        dataset: where the new parts are.
        runs: the runs that hold them.
        made: number of new parts; of parts that would be new after `dry_run`.
        present: parts that the dataset had already.
        episodes: of every part.
        root: of the dataset; None after `dry_run`.
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
    progress: Callable[[int, int], None] | None = None,
) -> ExtendReport:
    """Lets the policies of stored parts act again, with the next of their keyed seeds.

    Episode n of a policy depends on its seed, task and snapshot step and on n alone: with `first_episode=0`
    the stored episodes come back bit for bit, and later ones are new and equal whenever they are made. The
    new parts are a run of their own. What is there already is kept, so the same call goes on after a stop.

    Args:
        path: the dataset's folder or its `manifest.json`.
        episodes: of every new part; a multiple of the recipe's lanes.
        out: folder of a new dataset with all old and the new parts; None adds the parts to the dataset.
        run: name of the new run. With `cross`, further runs `<run>-2`, … hold what else comes to a task.
        of: run whose policies act.
        tasks: indices of the tasks whose policies act; all where None.
        snapshots: rule of `Dataset.select`.
        first_episode: number of the first episode, a multiple of the lanes; that after the run's last one
            where None.
        noise: standard deviation of normal noise that is added to actions, before they are clipped.
        cross: number of nearest tasks of the same split, by parameters, in which a policy acts instead of its
            own; 0 for its own task.
        allow_drift: also on another platform than that of the stored parts, where episodes are not those that
            their platform would give.
        workers: processes at the same time; one per core where None.
        dry_run: only check and count; write nothing.
        progress: called with parts done and parts in all.

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
    extension = _Extension(dataset, of, episodes, first_episode, noise, cross)
    jobs = extension.jobs(keys_of_run(dataset, of, tasks, snapshots), run)
    sources = sorted({job.source for job in jobs})
    check_parts(dataset, extension.run, sources, policy=True, allow_drift=allow_drift)
    runs = extension.runs(jobs)
    new = [job for job in jobs if job.key not in dataset.parts]
    names = tuple(sorted({job.key.run for job in jobs}))
    target = dataset.path if out is None else out
    counts = (names, len(new), len(jobs) - len(new), episodes)
    if dry_run or (out is None and not new):
        return ExtendReport(target, *counts, None if dry_run else dataset.manifest.root)
    spec = extension.spec(target, new)

    def remake() -> list[Published]:
        return derive_parts(spec, workers=workers, progress=progress)

    if out is None:
        root = _in_place(dataset, runs, remake)
    else:
        settings = {
            **extension.settings,
            "run": run,
            "snapshots": snapshots,
            "tasks": tasks if tasks is None else sorted(set(tasks)),
        }
        root = _elsewhere(dataset, out, settings, runs, remake)
    return ExtendReport(target, *counts, root)


class _Extension:
    """The settings of an extension, checked against its dataset."""

    def __init__(
        self, dataset: Dataset, of: str, episodes: int, first_episode: int | None, noise: float, cross: int
    ) -> None:
        run, recipe, seed = simulated_run(dataset, of)
        lanes = recipe.rollouts.lanes
        first = recipe.rollouts.episodes if first_episode is None else first_episode
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
        self._dataset, self.run, self._seed = dataset, run, seed
        self._recipe = recipe.model_copy(update={"rollouts": Rollouts(episodes=episodes, lanes=lanes)})
        self.settings: Mapping[str, Any] = {
            "operation": EXTEND,
            "of": of,
            "first_episode": first,
            "noise": float(noise),
            "cross": cross,
        }

    def jobs(self, keys: Sequence[PartKey], name: str) -> list[Job]:
        """The parts to make of policies."""
        sources = sorted({key.task for key in keys})
        cross = self.settings["cross"]
        pairs = [(task, task) for task in sources]
        if cross:
            tasks = self._dataset.tasks
            pairs = nearest_pairs(tasks, [task for task in tasks if task.index in {*sources}], cross)
        return jobs_of_pairs(runs_of_pairs(pairs, name), keys)

    def runs(self, jobs: Sequence[Job]) -> list[Run]:
        """The runs of the dataset with the new ones.

        Raises:
            BuildError: a run of the same name was made in another way.
        """
        runs = {run.name: run for run in self._dataset.manifest.runs}
        for name in sorted({job.key.run for job in jobs}):
            made = {job.key.task: job.source.task for job in jobs if job.key.run == name}
            old = runs.get(name)
            held = {key.task for key in self._dataset.parts if key.run == name}
            sources = dict(old.sources if old else ()) | {
                task: source for task, source in made.items() if task != source
            }
            new = Run(
                name=name,
                kind="extended",
                seed=self._seed,
                recipe=self._recipe,
                origin=dict(self.settings),
                steps=None,
                sources=tuple(sorted(sources.items())),
            )
            if old is not None and (
                old.model_copy(update={"sources": new.sources}) != new
                or any(old.source_of(task) != source for task, source in made.items() if task in held)
            ):
                raise BuildError(
                    f"{self._dataset.folder} has a run {name} that was made with other settings; "
                    "choose another --as"
                )
            runs[name] = new
        return list(runs.values())

    def spec(self, out: Path, jobs: Sequence[Job]) -> DeriveSpec:
        """What the workers are told."""
        settings = {name: self.settings[name] for name in ("first_episode", "noise")}
        source = self._dataset.path.resolve()
        return DeriveSpec(source, out.resolve(), EXTEND, settings, self._recipe, self._seed, tuple(jobs))


def _in_place(dataset: Dataset, runs: Sequence[Run], remake: Callable[[], list[Published]]) -> str:
    """Adds new parts to the dataset; returns its root."""
    folder = dataset.folder
    if dataset.path != folder:
        raise StoreError(
            f"{dataset.path} is a view, to which no parts can be added; name a new dataset by --out"
        )
    check_work_files(folder)
    with lock_file(folder / LOCK, f"dataset {folder}"):
        remove_abandoned(folder)
        if read_manifest(folder).digest != dataset.manifest.digest:
            raise StoreError(f"{folder} has changed meanwhile; run the same command again")
        return append_parts(dataset, runs=runs, parts=remake()).root


def _elsewhere(
    dataset: Dataset,
    out: Path,
    settings: Mapping[str, Any],
    runs: Sequence[Run],
    remake: Callable[[], list[Published]],
) -> str:
    """Makes a new dataset of the old and the new parts; returns its root."""
    manifest = dataset.manifest
    with open_assembly(out, derivation_of(EXTEND, settings, [dataset]), [dataset]) as assembly:
        assembly.copy([Copied(key, dataset, key) for key in dataset.parts])
        for published in remake():
            assembly.take(published)
        return assembly.finish(
            name=manifest.name, data_version=manifest.data_version, runs=runs, tasks=dataset.tasks
        ).root
