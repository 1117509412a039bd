"""Stored parts that the simulator can make again, and what has to hold for it."""

from collections.abc import Iterable, Sequence

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.errors import BuildError, NondeterminismError, SelectionError
from tcmrl_data.parts.making import operation_of_run
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.platform import this_platform


def simulated_run(dataset: Dataset, name: str) -> tuple[Run, Recipe, int]:
    """A run whose parts have keyed seeds, its recipe and its root seed.

    Raises:
        SelectionError: the dataset has no such run.
        BuildError: its parts cannot be simulated again.
    """
    known = {run.name: run for run in dataset.manifest.runs}
    if name not in known:
        raise SelectionError(f"{dataset.path} has no run {name!r}; it has {', '.join(sorted(known))}")
    run = known[name]
    if run.recipe is None or run.seed is None or not operation_of_run(run).own_seeds:
        raise BuildError(
            f"{dataset.path}: run {name} is {run.kind}, so the seeds of its episodes are not known; "
            "name one that was built"
        )
    if run.sources:
        raise BuildError(
            f"{dataset.path}: the policies of run {name} are from other tasks; name the run of their own"
        )
    return run, run.recipe, run.seed


def check_parts(
    dataset: Dataset, run: Run, keys: Iterable[PartKey], *, policy: bool, allow_drift: bool = False
) -> None:
    """Refuses parts that cannot be simulated here as they were.

    Args:
        dataset: that holds them.
        run: theirs.
        keys: theirs.
        policy: whether their policies are needed.
        allow_drift: whether another platform will do.

    Raises:
        BuildError: a part without policy, or with another seed than its run.
        NondeterminismError: a part was made on another platform.
    """
    here = this_platform(dataset.environment, dataset.manifest.recipe.behavior.source)
    differences = [here.differences(platform) for platform in dataset.manifest.platforms]
    for key in keys:
        identity = dataset.part(*key).identity
        file = dataset.file_of(key)
        if identity.seed != run.seed or (policy and identity.policy is None):
            raise BuildError(f"{file}: has no policy with the seed of run {key.run}; select other parts")
        found = differences[dataset.entry(key).platform]
        if found and not allow_drift:
            raise NondeterminismError(
                f"{file}: was made on another platform ({'; '.join(found)[:200]}), where the same seeds "
                f"give other episodes; use that platform{', or say --allow-drift' if policy else ''}"
            )


def keys_of_run(dataset: Dataset, run: str, tasks: Sequence[int] | None, snapshots: str) -> list[PartKey]:
    """The parts of a run that a selection leaves, sorted.

    Raises:
        SelectionError: nothing is left.
    """
    chosen = dataset.select(tasks=tasks, snapshots=snapshots)
    keys = sorted(key for keys in chosen.parts.values() for key in keys if key.run == run)
    if not keys:
        raise SelectionError(f"{dataset.path}: the selection holds no part of run {run}; choose others")
    return keys
