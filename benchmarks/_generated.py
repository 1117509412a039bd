"""Writes datasets of random numbers in any size with the code that publishes real ones, for benchmarks."""

from pathlib import Path

import numpy as np

import tcmrl_data
from tcmrl_data.behavior.snapshot import ScriptedDescription, Snapshot
from tcmrl_data.build.ledger import Ledger
from tcmrl_data.build.part import seal_part
from tcmrl_data.build.plan import BuildPlan
from tcmrl_data.build.published import Published
from tcmrl_data.envs.base import Environment
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.disk import STAGING, make_folders, replace_file
from tcmrl_data.recipe.tasks import choose_tasks
from tcmrl_data.store.keys import part_file
from tcmrl_data.store.part_record import PartRecord, References

STEPS = 10_000
"""Environment steps between two snapshots."""


def generate_dataset(
    folder: Path, environment_name: str, *, tasks: int, snapshots: int, episodes: int, seed: int = 0
) -> int:
    """Writes a dataset of training tasks whose episodes are white noise of the full horizon.

    The code that builds datasets creates, hashes and publishes every file; only simulation and policy
    training are omitted. Noise compresses worse than the data of a simulator.

    Args:
        folder: folder of the dataset; a dataset of the same arguments is kept.
        environment_name: gives observation and action size and the horizon.
        tasks: number of training tasks, the first of the task set.
        snapshots: number of parts per task.
        episodes: number of episodes per part.
        seed: seed of the noise.

    Returns:
        The number of transitions.
    """
    plan = plan_noise(environment_name, tasks=tasks, snapshots=snapshots, episodes=episodes, seed=seed)
    make_folders(folder)
    ledger = Ledger(plan, folder)
    ledger.begin()
    for task in plan.tasks:
        for key in ledger.missing(task.index):
            record, archive = noise_part(plan, task, key.step)
            replace_file(folder / part_file(key), archive, staging=folder / STAGING)
            ledger.take_in(Published.of_record(record, run=key.run, archive=archive))
    ledger.seal()
    return tasks * snapshots * episodes * plan.environment.settings.horizon


def plan_noise(
    environment_name: str, *, tasks: int, snapshots: int, episodes: int, seed: int = 0
) -> BuildPlan:
    """The plan of `generate_dataset`; arguments as there."""
    steps = [STEPS * i for i in range(snapshots)]
    overrides = (
        f"behavior.sac.snapshots={steps}",
        f"behavior.sac.steps={max(steps[-1], STEPS)}",
        f"rollouts.episodes={episodes}",
        "rollouts.lanes=1",
    )
    recipe = tcmrl_data.load_recipe(environment_name, overrides=overrides, behavior="sac")
    chosen = [task for task in choose_tasks(recipe) if task.split == "train"][:tasks]
    return BuildPlan.of_tasks(recipe, seed=seed, tasks=chosen)


def noise_part(plan: BuildPlan, task: Task, step: int) -> tuple[PartRecord, bytes]:
    """The record and the archive of a part whose episodes are white noise."""
    random = np.random.default_rng([plan.seed, task.index, step])
    trajectories = [_noise(random, plan.environment) for _ in range(plan.recipe.rollouts.episodes)]
    snapshot = Snapshot(step, ScriptedDescription(observation="stored", noise=1.0))
    return seal_part(
        plan,
        task=task,
        snapshot=snapshot,
        trajectories=trajectories,
        references=References(uniform=-1.0, oracle=0.0, scripted=None),
        behavior={"generated": "white noise"},
    )


def _noise(random: np.random.Generator, environment: Environment) -> Trajectory:
    steps = environment.settings.horizon
    truncated = np.zeros(steps, dtype=bool)
    truncated[-1] = True
    return Trajectory(
        random.standard_normal((steps + 1, environment.observation_dim), dtype=np.float32),
        random.uniform(-1, 1, (steps, environment.action_dim)).astype(np.float32),
        random.standard_normal(steps, dtype=np.float32),
        np.zeros(steps, dtype=bool),
        truncated,
        {name: np.zeros(steps, dtype) for name, dtype in environment.extras.items()},
    )
