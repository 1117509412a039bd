"""Writes datasets of random numbers in any size with the code that publishes real ones, for benchmarks."""

from pathlib import Path

import numpy as np

import tcmrl_data
from tcmrl_data.behavior.snapshot import ScriptedDescription, Snapshot
from tcmrl_data.build.driver import Driver, make_groups
from tcmrl_data.build.part import seal_part
from tcmrl_data.build.plan import BuildPlan
from tcmrl_data.envs.base import Environment
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.disk import publish_folder
from tcmrl_data.recipe.tasks import choose_tasks
from tcmrl_data.store.manifest import References, part_folder

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
    steps = [STEPS * i for i in range(snapshots)]
    overrides = (
        f"behavior.sac.snapshots={steps}",
        f"behavior.sac.steps={max(steps[-1], STEPS)}",
        f"rollouts.episodes={episodes}",
        "rollouts.lanes=1",
    )
    recipe = tcmrl_data.load_recipe(environment_name, overrides=overrides, behavior="sac")
    chosen = [task for task in choose_tasks(recipe) if task.split == "train"][:tasks]
    plan = BuildPlan.of_tasks(recipe, seed=seed, tasks=chosen)
    make_groups(folder, chosen)
    for task in chosen:
        for step in steps:
            if not (folder / part_folder(task.index, step)).is_dir():
                _publish(folder, plan, task, step)
    Driver(plan, folder).write_manifest()
    return len(chosen) * snapshots * episodes * plan.environment.settings.horizon


def _publish(folder: Path, plan: BuildPlan, task: Task, step: int) -> None:
    random = np.random.default_rng([plan.seed, task.index, step])
    trajectories = [_noise(random, plan.environment) for _ in range(plan.recipe.rollouts.episodes)]
    snapshot = Snapshot(step, ScriptedDescription(observation="stored", noise=1.0))
    _, files = seal_part(
        plan,
        task=task,
        snapshot=snapshot,
        trajectories=trajectories,
        references=References(uniform=-1.0, oracle=0.0, scripted=None),
        behavior={"generated": "white noise"},
    )
    publish_folder(folder, folder / part_folder(task.index, step), files, attempt="generated")


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
