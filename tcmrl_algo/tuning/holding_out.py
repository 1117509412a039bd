"""The tasks that trials are scored on: some training tasks, which trials then do not train on."""

from collections.abc import Sequence
from pathlib import Path

from tcmrl_data import Dataset, SelectionError, derive_dataset, in_order, open_dataset

FEWEST_TASKS = 3
"""Two training tasks, so that tasks can be told apart, and one to score on."""

SHARE = 5
"""One training task in so many is held out."""

VIEW = "held_out.json"


def held_out_tasks(dataset: Dataset) -> tuple[int, ...]:
    """A fifth of the training tasks, evenly spaced along the environment's ordering; indices, ascending.

    Raises:
        SelectionError: too few training tasks.
    """
    ordered = [task.index for task in in_order(dataset.environment, dataset.train_tasks)]
    _check_number(dataset, ordered)
    return tuple(sorted(evenly_spaced(ordered, max(1, len(ordered) // SHARE))))


def evenly_spaced(ordered: Sequence[int], number: int) -> list[int]:
    """The middles of equally long stretches of a sequence, so that they and the others cover the same range.

    Example:
        >>> evenly_spaced(range(10), 2)
        [2, 7]
    """
    return [ordered[(2 * place + 1) * len(ordered) // (2 * number)] for place in range(number)]


def checked_tasks(dataset: Dataset, tasks: Sequence[int]) -> tuple[int, ...]:
    """The tasks, ascending, if they may be held out.

    Raises:
        SelectionError: one is no training task of the dataset, or fewer than two training tasks are left.
    """
    training = {task.index for task in dataset.train_tasks}
    _check_number(dataset, list(training))
    for task in tasks:
        if task not in training:
            raise SelectionError(
                f"task {task} cannot be held out: it is no training task of {dataset.path}; "
                f"those are {sorted(training)}"
            )
    if not tasks or len(training - set(tasks)) < 2:
        raise SelectionError(
            f"{dataset.path}: of {len(training)} training tasks {len(set(tasks))} are to be held out; "
            "hold out one or more, and leave two or more"
        )
    return tuple(sorted(set(tasks)))


def open_view(dataset: Dataset, folder: Path, held_out: Sequence[int]) -> Dataset:
    """A view of the training tasks, in which the held-out ones are the test tasks; made where there is none.

    The dataset's test tasks are not in it, so that nothing which reads the view alone can read them.

    Raises:
        SelectionError: a training task is incomplete.
        ManifestError: the dataset is not the one that the view was made of.
    """
    file = folder / VIEW
    if not file.exists():
        derive_dataset(dataset, view=file, split="train", held_out=held_out)
    return open_dataset(file)


def _check_number(dataset: Dataset, training: Sequence[int]) -> None:
    if len(training) < FEWEST_TASKS:
        raise SelectionError(
            f"{dataset.path} holds {len(training)} training tasks, tuning needs {FEWEST_TASKS} or more; "
            "build more with `tcmrl-data build --tasks`"
        )
