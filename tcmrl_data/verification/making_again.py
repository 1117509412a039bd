"""Damaged parts made again in a folder of their own, with the recipe and the seed of their run."""

from collections.abc import Callable, Sequence
from pathlib import Path

from tcmrl_data.building.build import build_dataset
from tcmrl_data.building.events import BuildEvent
from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.disk import STAGING, make_folders, replace_file
from tcmrl_data.foundation.errors import BuildError, StoreError
from tcmrl_data.foundation.plain_files import read_plain_file
from tcmrl_data.parts.rollouts import EXTEND
from tcmrl_data.parts.worker import DeriveSpec, Job, derive_parts
from tcmrl_data.store.archive import LARGEST_ARCHIVE
from tcmrl_data.store.keys import MAIN_RUN, PartKey, part_file
from tcmrl_data.store.manifest import Run


def lasting_damage(run: Run | None, key: PartKey) -> str | None:
    """Why a part cannot be made again from what the dataset holds; None if it can.

    Args:
        run: its run, None if the manifest has no such run.
        key: of the part.
    """
    if run is None:
        return f"the manifest has no run {key.run}, of which the part of {key} is"
    if run.kind not in ("built", "extended") or run.recipe is None or run.seed is None:
        return f"the part of {key} was not built here, run {run.name} is {run.kind}"
    return None


def made_file(target: Path, run: Run, key: PartKey) -> Path:
    """The file of a part that was made again in the folder `target`."""
    return target / part_file(PartKey(key.task, key.step) if run.kind == "built" else key)


def build_again(
    dataset: Dataset,
    run: Run,
    keys: Sequence[PartKey],
    target: Path,
    workers: int | None,
    progress: Callable[[BuildEvent], None],
) -> tuple[str, ...]:
    """Builds the affected tasks of a run in a folder, where their sound parts lie; their groups train along.

    Args:
        dataset: that holds the damaged parts.
        run: a built run.
        keys: of the run's damaged parts.
        target: folder for the new parts; `made_file` says where.
        workers: units run at the same time.
        progress: called with the events of the build.

    Returns:
        One line per failure.
    """
    assert run.recipe is not None
    assert run.seed is not None
    tasks = {key.task for key in keys}
    group_size = run.recipe.make_source().group_size
    groups = {task // group_size for task in tasks}
    recorded = dataset.recorded_tasks
    others = [
        task.index for task in recorded if task.index // group_size in groups and task.index not in tasks
    ]
    make_folders(target)
    for task in sorted(tasks):
        for key in dataset.recorded_parts.keys_of(task):
            if key.run == run.name and key not in keys:
                copy = target / part_file(PartKey(key.task, key.step))
                data = read_plain_file(dataset.file_of(key), limit=LARGEST_ARCHIVE)
                replace_file(copy, data, staging=target / STAGING)
    report = build_dataset(
        run.recipe,
        target,
        seed=run.seed,
        tasks=sorted(tasks),
        dropped=others,
        workers=workers,
        progress=progress,
    )
    return report.failed


def extend_again(
    dataset: Dataset, run: Run, keys: Sequence[PartKey], target: Path, workers: int | None
) -> tuple[str, ...]:
    """Makes parts of an extended run from the stored policies; arguments and result as of `build_again`."""
    assert run.recipe is not None
    assert run.seed is not None
    origin = run.origin or {}
    settings = {name: origin.get(name) for name in ("first_episode", "noise")}
    of = origin.get("of", MAIN_RUN)
    jobs = tuple(Job(PartKey(run.source_of(key.task), key.step, of), key) for key in keys)
    make_folders(target / STAGING)
    spec = DeriveSpec(
        dataset.folder.resolve(), target.resolve(), EXTEND, settings, run.recipe, run.seed, jobs
    )
    try:
        derive_parts(spec, workers=workers)
    except (BuildError, StoreError) as error:
        return (str(error),)
    return ()
