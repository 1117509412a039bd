"""The tasks that a recipe chooses, and their groups."""

from collections.abc import Iterable, Sequence
from itertools import groupby

import numpy as np

from tcmrl_data.envs.base import Environment
from tcmrl_data.envs.tasks import Task, draw_tasks, in_order
from tcmrl_data.foundation.errors import TaskError
from tcmrl_data.recipe.recipe import Recipe


def spread(tasks: Sequence[Task], *, num_train: int, num_test: int, is_circular: bool = False) -> list[int]:
    """Indices, ascending, of `num_train` training and `num_test` test tasks, evenly spaced in their split.

    Tasks are given in the order in which they are spaced. A selection contains the first and the last task of
    a split, so that it covers the same range; on a circle, where these are neighbors, only the first.

    Raises:
        TaskError: a split has fewer tasks.
    """
    chosen: list[int] = []
    for split, number in (("train", num_train), ("test", num_test)):
        members = [task.index for task in tasks if task.split == split]
        if number > len(members):
            raise TaskError(f"{number} {split} tasks asked for, the task set has {len(members)}")
        last = len(members) if is_circular else len(members) - 1
        positions = np.linspace(0, last, number, endpoint=not is_circular).round().astype(int)
        chosen.extend(members[position] for position in positions)
    return sorted(chosen)


def choose_tasks(
    recipe: Recipe, indices: Sequence[int] | None = None, *, environment: Environment | None = None
) -> list[Task]:
    """The tasks with the given indices, or else those of the recipe's profile, ascending.

    A profile's tasks are evenly spaced along the environment's ordering, or by index if it has none.

    Args:
        recipe: the recipe.
        indices: of the tasks; None for the profile's choice.
        environment: the recipe's, if it was made before.

    Raises:
        TaskError: an index does not exist, or the profile has more tasks than the task set.
    """
    environment = environment or recipe.make_environment()
    tasks = draw_tasks(environment)
    if indices is None:
        num_train, num_test = (
            sum(task.split == split for task in tasks) if wanted is None else wanted
            for split, wanted in (("train", recipe.build.train_tasks), ("test", recipe.build.test_tasks))
        )
        indices = spread(
            in_order(environment, tasks),
            num_train=num_train,
            num_test=num_test,
            is_circular=environment.is_circular,
        )
    for index in indices:
        if not 0 <= index < len(tasks):
            raise TaskError(f"task index {index} does not exist, the tasks are 0-{len(tasks) - 1}")
    return [tasks[index] for index in sorted(set(indices))]


def group_tasks(tasks: Iterable[Task], group_size: int) -> list[tuple[Task, ...]]:
    """Groups of the tasks with equal index // group_size, ascending; the machine does not affect them."""
    ordered = sorted(tasks, key=lambda task: task.index)
    return [tuple(group) for _, group in groupby(ordered, key=lambda task: task.index // group_size)]


def parse_indices(text: str, num_tasks: int, *, option: str = "--tasks") -> list[int]:
    """The sorted indices in a text such as `0-9,12`.

    Raises:
        TaskError: the text is not a list of indices and ranges, or an index does not exist; the message
            names the option.
    """
    indices: set[int] = set()
    for item in text.split(","):
        first, dash, last = item.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise TaskError(f"{option} {text!r}: {item!r} is neither an index nor a range such as 0-9")
        start, stop = int(first), int(last or first)
        if stop < start:
            raise TaskError(f"{option} {text!r}: the range {item!r} runs backwards")
        if stop >= num_tasks:
            raise TaskError(f"{option} {text!r}: {stop} is too large, 0-{num_tasks - 1} are possible")
        indices.update(range(start, stop + 1))
    return sorted(indices)
