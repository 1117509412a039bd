"""Behavior training in this process, which may be stopped, for the tests of sources and of checkpoints."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tcmrl_data import Recipe
from tcmrl_data.behavior.base import BehaviorContext, CheckpointFolder
from tcmrl_data.recipe.recipe import choose_tasks

Digests = dict[tuple[int, int], str]
"""Digests of snapshots by task and step."""


class Interrupted(Exception):
    """Ends a training in the middle, like a kill."""


def context_of(
    recipe: Recipe,
    tasks: Sequence[int],
    folder: Path,
    *,
    seconds: float = np.inf,
    stop_at: float = np.inf,
) -> BehaviorContext:
    """The tasks as one unit, interrupted after `stop_at` steps of each; by default without checkpoints."""
    steps = 0

    def counted(count: int) -> None:
        nonlocal steps
        steps += count
        if steps >= stop_at * len(tasks):
            raise Interrupted

    return BehaviorContext(
        environment=recipe.make_environment(),
        tasks=choose_tasks(recipe, tasks),
        seed=0,
        observation=recipe.behavior.observation,
        reward=recipe.behavior.reward,
        report=counted,
        checkpoints=lambda _: CheckpointFolder(folder, "unit", key="k", missing={}, seconds=seconds),
    )


def digests(recipe: Recipe, context: BehaviorContext) -> Digests:
    snapshots = recipe.make_source().snapshots(context)
    return {(task.index, snapshot.step): snapshot.digest() for task, snapshot in snapshots}


def assert_resumes(recipe: Recipe, tasks: Sequence[int], folder: Path, *, stop_at: int) -> None:
    """A training with frequent checkpoints continues from the last one, and ends in the same bits."""
    straight = digests(recipe, context_of(recipe, tasks, folder / "straight"))
    resumed: Digests = {}
    stopped = context_of(recipe, tasks, folder, seconds=0.0, stop_at=stop_at)
    pairs = recipe.make_source().snapshots(stopped)
    with pytest.raises(Interrupted):
        resumed.update(((task.index, snapshot.step), snapshot.digest()) for task, snapshot in pairs)
    context = context_of(recipe, tasks, folder)
    state = context.checkpoints(context.tasks).load()
    assert state is not None
    done = state.values["steps"]
    assert 0 < done < stop_at
    later = digests(recipe, context)
    assert set(later) == {key for key in straight if key[1] > done}
    assert resumed | later == straight
