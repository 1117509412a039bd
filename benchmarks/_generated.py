"""Datasets of a wanted size without training anyone: noise as episodes, published as a build publishes.

`python -m benchmarks._generated ENV FOLDER --tasks N --snapshots N`, or `generate` from another benchmark.
"""

import argparse
from pathlib import Path

import numpy as np

from tcmrl_data import Dataset, Trajectory, load_recipe, open_dataset
from tcmrl_data.driver import Driver, make_groups
from tcmrl_data.environment import Environment
from tcmrl_data.manifest import References, part_folder
from tcmrl_data.publish import publish_folder
from tcmrl_data.snapshot import GaussianPolicy, Snapshot
from tcmrl_data.tasks import choose_tasks, draw_tasks
from tcmrl_data.unit import UnitSpec, part_files

EPISODES = 50
"""Per part, as the recipes of the paper have it."""

SIZES = {"half-cheetah-vel": (20, 10), "ml1/reach": (40, 2)}
"""Training tasks and snapshots that make 2 million transitions."""


def generate(name: str, folder: Path, *, tasks: int, snapshots: int) -> Dataset:
    """A dataset of `tasks` training tasks, each with `snapshots` parts of 50 episodes of full length.

    Args:
        name: an environment with a recipe; its dimensions and horizon are used, its dynamics are not.
        folder: a new folder.
        tasks: training tasks; the first ones by index.
        snapshots: parts per task.
    """
    steps = [0, *range(10_000, 10_000 * snapshots, 10_000)]
    overrides = (f"behavior.sac.snapshots={steps}", f"behavior.sac.steps={max(10_000, steps[-1])}")
    recipe = load_recipe(name, overrides=overrides, behavior="sac")
    environment = recipe.make_environment()
    train = [task.index for task in draw_tasks(environment) if task.split == "train"][:tasks]
    chosen = choose_tasks(recipe, train)
    make_groups(folder, chosen)
    spec = UnitSpec(folder, recipe, 0, tuple(chosen))
    random = np.random.default_rng(0)
    for task in chosen:
        for step in steps:
            episodes = [_episode(environment, random) for _ in range(EPISODES)]
            _, files = part_files(
                spec, environment, task=task, snapshot=_snapshot(environment, step),
                trajectories=episodes, references=References(uniform=0.0, oracle=None, scripted=None),
            )  # fmt: skip
            publish_folder(
                folder, folder / part_folder(task.index, step), files, attempt=f"task_{task.index}"
            )
    Driver(recipe, folder, 0, chosen).write_manifest()
    return open_dataset(folder)


def _snapshot(environment: Environment, step: int) -> Snapshot:
    """The smallest policy that a part can hold."""
    description = GaussianPolicy(
        observation="stored",
        observation_dim=environment.observation_dim,
        action_dim=environment.action_dim,
        hidden=(1,),
    )
    zeros = {name: np.zeros(shape, dtype=np.float32) for name, shape in description.shapes().items()}
    return Snapshot(step, description, zeros)


def _episode(environment: Environment, random: np.random.Generator) -> Trajectory:
    steps = environment.settings.horizon
    truncated = np.arange(1, steps + 1) == steps
    return Trajectory(
        random.standard_normal((steps + 1, environment.observation_dim), dtype=np.float32),
        random.uniform(-1, 1, (steps, environment.action_dim)).astype(np.float32),
        random.standard_normal(steps, dtype=np.float32),
        np.zeros(steps, dtype=bool),
        truncated,
    )


def main() -> None:
    """Generates one dataset; by default one of 2 million transitions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("environment", choices=sorted(SIZES))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tasks", type=int)
    parser.add_argument("--snapshots", type=int)
    asked = parser.parse_args()
    tasks, snapshots = SIZES[asked.environment]
    dataset = generate(
        asked.environment, asked.folder, tasks=asked.tasks or tasks, snapshots=asked.snapshots or snapshots
    )
    print(f"{dataset.folder}: {len(dataset.manifest.parts)} parts, root {dataset.manifest.root[:12]}")


if __name__ == "__main__":
    main()
