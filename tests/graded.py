"""Small datasets of made-up episodes whose scores are known, made in milliseconds."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import tcmrl_data
from tcmrl_data import Dataset, Recipe, Trajectory, open_dataset
from tcmrl_data.behavior.base import Snapshot
from tcmrl_data.envs.base import DENSE_REWARDS, Task, draw_tasks
from tcmrl_data.foundation.disk import STAGING, make_folders, replace_file
from tcmrl_data.parts.making import make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.store.manifest import Run, write_dataset
from tcmrl_data.store.part import DATA_VERSION, UNKNOWN, References
from tcmrl_data.store.part_table import PartTable, part_entry
from tcmrl_data.store.tables import MAIN_RUN, PartKey, part_file

EPISODES, HORIZON = 4, 5
SCORES: Mapping[int, float] = {0: 0.0, 100: 20.0, 200: 40.0, 300: 90.0, 400: 80.0}
"""Step to score; returns are scores / 10, as uniform actions get 0 and the oracle gets 10."""


def graded_recipe(*changes: str) -> Recipe:
    """A recipe of point-robot whose parts have few episodes."""
    settings = (f"rollouts.episodes={EPISODES}", "rollouts.lanes=1", *changes)
    return tcmrl_data.load_recipe("point-robot", profile="quick", overrides=settings)


def graded_dataset(
    folder: Path,
    *,
    tasks: Sequence[int] = (0, 1, 2, 3),
    scores: Mapping[int, float] = SCORES,
    seed: int = 0,
    references: References = References(uniform=0.0, oracle=10.0, scripted=None),  # noqa: B008
    recipe: Recipe | None = None,
    episodes: Mapping[int, int] | None = None,
    moved: bool = False,
    dense: bool = False,
) -> Dataset:
    """Writes a dataset whose parts have given scores; episode e returns its part's mean + e - 1.5.

    Args:
        folder: the dataset, new.
        tasks: their indices; task 3 is a test task.
        scores: step to score of every task.
        seed: of the build; also changes the observations.
        references: of every part.
        recipe: what it was built from.
        episodes: step to number of episodes, where it is not 4.
        moved: the tasks' goals are others than the recipe draws.
        dense: parts hold dense rewards too, -1, -2, … in the steps of every episode.
    """
    recipe = recipe or graded_recipe()
    drawn = draw_tasks(recipe.make_environment())
    if moved:
        drawn = tuple(replace(task, parameters={"goal": [9.0, 9.0]}) for task in drawn)
    parts = {
        PartKey(task, step): [
            _episode(score / 10 + e - (number - 1) / 2, (seed, task, step, e), dense=dense)
            for e in range(number)
        ]
        for task in tasks
        for step, score in scores.items()
        for number in ((episodes or {}).get(step, EPISODES),)
    }
    return made_dataset(folder, parts, recipe=recipe, drawn=drawn, seed=seed, references=references)


def made_dataset(
    folder: Path,
    parts: Mapping[PartKey, Sequence[Trajectory]],
    *,
    recipe: Recipe | None = None,
    drawn: Sequence[Task] | None = None,
    seed: int = 0,
    references: References = References(uniform=0.0, oracle=10.0, scripted=None),  # noqa: B008
    snapshots: Mapping[PartKey, Snapshot] | None = None,
) -> Dataset:
    """Writes a dataset of given episodes.

    Args:
        folder: the dataset, new.
        parts: key to episodes; every task has the same steps.
        recipe: what it was built from.
        drawn: all tasks of the recipe.
        seed: of the build.
        references: of every part.
        snapshots: policies of the parts, where there are any.
    """
    recipe = recipe or graded_recipe()
    drawn = drawn or draw_tasks(recipe.make_environment())
    make_folders(folder)
    entries = []
    for key, trajectories in parts.items():
        record, data = make_part(
            WantedPart(
                settings=recipe.unit_settings(),
                task=drawn[key.task],
                step=key.step,
                seed=seed,
                snapshot=(snapshots or {}).get(key),
            ),
            trajectories,
            references=references,
        )
        replace_file(folder / part_file(key), data, staging=folder / STAGING)
        entries.append(part_entry(record, run=MAIN_RUN, platform=0, archive=data))
    steps = tuple(sorted({key.step for key in parts}))
    run = Run(name=MAIN_RUN, kind="built", seed=seed, recipe=recipe, steps=steps)
    write_dataset(
        folder,
        label=None,
        data_version=DATA_VERSION,
        runs=[run],
        derivation=None,
        platforms=[UNKNOWN],
        tasks=[drawn[task] for task in sorted({key.task for key in parts})],
        table=PartTable.empty().with_entries(entries),
    )
    return open_dataset(folder)


def _episode(total: float, key: tuple[int, ...], *, dense: bool) -> Trajectory:
    generator = np.random.default_rng(key)
    ended = np.arange(HORIZON) == HORIZON - 1
    extras = {DENSE_REWARDS: -np.arange(1, HORIZON + 1, dtype=np.float32)} if dense else {}
    return Trajectory(
        generator.normal(size=(HORIZON + 1, 2)).astype(np.float32),
        generator.uniform(-1, 1, (HORIZON, 2)).astype(np.float32),
        np.full(HORIZON, total / HORIZON, dtype=np.float32),
        np.zeros(HORIZON, dtype=bool),
        ended,
        extras,
    )
