"""`split_dataset`: folds over the tasks of a dataset, or disjoint episodes of all its parts."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.envs.base import Split, in_order
from tcmrl_data.foundation.errors import ManifestError, SelectionError
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator
from tcmrl_data.operations.assembly import (
    Plan,
    PlannedPart,
    Progress,
    carry_out,
    check_out,
    derivation_of,
    settle_runs,
    shifted,
)
from tcmrl_data.operations.derive import Derived, summary, write_view
from tcmrl_data.parts.own_operations import Cut
from tcmrl_data.store.manifest import EPISODES, FOLD, read_manifest


def split_dataset(
    source: str | Path | Dataset,
    out: str | Path,
    *,
    folds: int | None = None,
    seed: int = 0,
    episodes: Sequence[int] | None = None,
    names: Sequence[str] | None = None,
    views: bool = False,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> list[Derived]:
    """Makes several datasets of one: task folds, or disjoint episodes of every part.

    Every task is a test task in one of the folds; all folds hold all parts, which keep ids and bytes. If the
    recipe splits tasks along their ordering, the folds do too: each tests tasks that spread over all of it.
    Of `episodes=(45, 5)` the first dataset has the first 45 episodes of every part and the second the next 5.

    Args:
        episodes: numbers of episodes, one per dataset, instead of folds.
        names: of the datasets, for their folders; 0, 1, … without names.
        views: make a view file per fold, `out/0.json`, instead of copying all parts.
        progress: called with parts done and parts in all, over all datasets.

    Raises:
        SelectionError: numbers that are not possible, or not both or none of folds and episodes.
        StoreError: a dataset of that name exists, a part is damaged, or the source has changed meanwhile.
        StorageError: the operating system refuses an operation.

    Example:
        >>> split_dataset("data/point-robot", "data/folds", folds=5, views=True)  # doctest: +SKIP
    """
    opened = source if isinstance(source, Dataset) else open_dataset(source)
    if (folds is None) == (episodes is None):
        raise SelectionError(
            "a split is into folds (--folds) or by episodes (--episodes); name one of the two"
        )
    if views and folds is None:
        raise SelectionError("--view: a view names whole parts; episodes can only be split into datasets")
    if folds is not None:
        plans = [plan_fold(opened, folds=folds, seed=seed, fold=fold) for fold in range(folds)]
    else:
        plans = list(plan_episodes(opened, episodes or ()))
    chosen = [str(number) for number in range(len(plans))] if names is None else list(names)
    if len(set(chosen)) != len(plans) or any(
        name in ("", ".", "..") or Path(name).name != name for name in chosen
    ):
        raise SelectionError(f"--names {','.join(chosen)}: expected {len(plans)} different names of folders")
    targets = [Path(out) / (f"{name}.json" if views else name) for name in chosen]
    waiting = [pair for pair in zip(plans, targets, strict=True) if not _is_made(*pair)]
    for plan, target in waiting if not views else ():
        check_out(target, plan.derivation)
    total = sum(len(plan.parts) for plan, _ in waiting)
    before = 0
    for plan, target in waiting if not dry_run else ():
        if views:
            write_view(plan, target)
        else:
            carry_out(plan, target, shifted(progress, before, total))
        before += len(plan.parts)
    roots = [None if dry_run else open_dataset(target).manifest.root for target in targets]
    made = zip(plans, targets, roots, strict=True)
    return [summary(plan, target, root=root) for plan, target, root in made]


def plan_fold(source: Dataset, *, folds: int, seed: int, fold: int) -> Plan:
    """The dataset in which one fold of the tasks is the test split, and all others the training split."""
    tasks = source.tasks
    if not 2 <= folds <= len(tasks) or len(tasks) - -(-len(tasks) // folds) < 2:
        raise SelectionError(
            f"{source.path}: {len(tasks)} tasks do not make {folds} folds; every fold needs a test task and "
            "two training tasks"
        )
    tested = _tested(source, folds=folds, seed=seed, fold=fold)
    splits: dict[int, Split] = {task.index: "test" if task.index in tested else "train" for task in tasks}
    settings = {"folds": folds, "seed": seed, "fold": fold}
    keys = tuple(source.parts)
    changed = tuple(replace(task, split=splits[task.index]) for task in tasks)
    return Plan(
        runs=settle_runs(source.manifest.runs, keys, tasks),
        tasks=changed,
        parts=tuple(PlannedPart(key, source, key) for key in keys),
        derivation=derivation_of(FOLD, settings, [source], splits=splits),
        sources=(source,),
    )


def _tested(source: Dataset, *, folds: int, seed: int, fold: int) -> set[int]:
    """Indices of the test tasks of a fold: folds are drawn as the recipe draws test tasks.

    By strata and by interpolation, every `folds` neighbors along the environment's ordering go to different
    folds.
    """
    generator = keyed_generator(seed, source.name, NO_TASK, Purpose.FOLDS)
    if source.manifest.recipe.environment.split != "permutation":
        order = [task.index for task in in_order(source.environment, source.tasks)]
        strata = [order[start : start + folds] for start in range(0, len(order), folds)]
        drawn = [(stratum, generator.permutation(folds).tolist()) for stratum in strata]
        return {stratum[places[fold]] for stratum, places in drawn if places[fold] < len(stratum)}
    permutation = generator.permutation(len(source.tasks))
    return {source.tasks[position].index for position in permutation[fold::folds]}


def plan_episodes(source: Dataset, numbers: Sequence[int]) -> Iterator[Plan]:
    """Datasets of consecutive episodes of every part, as many as each number says."""
    if len(numbers) < 2 or min(numbers) < 1:
        raise SelectionError(
            f"--episodes {tuple(numbers)}: expected two numbers or more, each at least 1, as 45,5"
        )
    for place, number in enumerate(numbers):
        first, parts = sum(numbers[:place]), list[PlannedPart]()
        for entry in source.parts.entries():
            if first + number > entry.episodes:
                raise SelectionError(
                    f"{source.path}: {entry.key} has {entry.episodes} episodes, not {first + number}"
                )
            cut = None if number == entry.episodes else Cut.of(range(first, first + number))
            parts.append(PlannedPart(entry.key, source, entry.key, cut))
        keys, cut_runs = [part.key for part in parts], {part.key.run for part in parts if part.operation}
        yield Plan(
            runs=settle_runs(source.manifest.runs, keys, source.tasks, cut=cut_runs),
            tasks=source.tasks,
            parts=parts,
            derivation=derivation_of(EPISODES, {"first": first, "number": number}, [source]),
            sources=[source],
        )


def _is_made(plan: Plan, target: Path) -> bool:
    """Whether a dataset was made by the same command, which was stopped later."""
    try:
        found = read_manifest(target) if target.is_dir() else open_dataset(target).manifest
    except ManifestError:
        return False
    return found.derivation == plan.derivation
