"""Learning curves of the behavior sources `stacked` and `sac` side by side, as JSON: are they equivalent?

    python benchmarks/behavior_parity.py point-robot-wind --tasks 8 --seeds 5
    python benchmarks/behavior_parity.py half-cheetah-vel --tasks 4 --seeds 3 --profile quick

`sac` trains every task with twice as many seeds as named. Its first half against its second half gives the
margin: the larger end of the 90% bootstrap interval of the difference, paired by task. `stacked`, with as
many seeds as `sac` has in all, is equivalent where the interval of its difference from all of `sac` lies
within that margin. Compared are the final return and the area under the learning curve (the mean over
checkpoints), of stochastic policies as a build rolls them out.
"""

import argparse
import json
import math
import os
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tcmrl_data import Recipe, load_recipe
from tcmrl_data.behavior.base import CheckpointFolder
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.envs.base import Task
from tcmrl_data.parts.operation import Simulator
from tcmrl_data.parts.own_operations import act
from tcmrl_data.recipe.recipe import choose_tasks

CHECKPOINTS = 5
RESAMPLES = 10_000
COVERAGE = 0.9
Returns = npt.NDArray[np.float64]


def curves(recipe: Recipe, tasks: list[Task], seed: int) -> Returns:
    """Mean returns at the recipe's snapshots after the first, (tasks, snapshots)."""
    plan = BuildPlan(recipe, seed, tuple(tasks))
    nowhere = CheckpointFolder(Path(os.devnull), "", key="", missing={}, seconds=math.inf)
    context = plan.context(lambda count: None, lambda tasks: nowhere)
    found = defaultdict(list)
    for task, snapshot in plan.source.snapshots(context):
        simulator = Simulator(recipe, seed=plan.seed, task=task, environment=plan.environment)
        episodes = act(snapshot, simulator, parameters=task.parameters)
        simulator.close()
        found[task.index].append(np.mean([episode.undiscounted_return for episode in episodes]))
    return np.array([found[task.index][1:] for task in tasks])


def difference(left: Returns, right: Returns) -> dict[str, float]:
    """Mean of left - right, both (tasks, seeds), and its bootstrap interval over tasks and seeds."""
    random = np.random.default_rng(0)
    num_tasks = len(left)
    tasks = random.integers(num_tasks, size=(RESAMPLES, num_tasks))

    def means(values: Returns) -> Returns:
        num_seeds = values.shape[1]
        seeds = random.integers(num_seeds, size=(RESAMPLES, num_tasks, num_seeds))
        resampled: Returns = values[tasks[..., None], seeds].mean(axis=(1, 2))
        return resampled

    low, high = np.quantile(means(left) - means(right), [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    return {"mean": float(left.mean() - right.mean()), "low": float(low), "high": float(high)}


def compare(sac: Returns, stacked: Returns) -> dict[str, Any]:
    """Differences of one quantity, given as two arrays of shape (tasks, seeds)."""
    half = sac.shape[1] // 2
    among_sac, between = difference(sac[:, :half], sac[:, half:]), difference(stacked, sac)
    margin = max(abs(among_sac["low"]), abs(among_sac["high"]))
    return {
        "sac": float(sac.mean()),
        "stacked": float(stacked.mean()),
        "sac_minus_sac": among_sac,
        "stacked_minus_sac": between,
        "margin": margin,
        "equivalent": -margin <= between["low"] and between["high"] <= margin,
    }


def main() -> None:
    """Trains, compares and prints."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("environment")
    parser.add_argument("--tasks", type=int, default=8, help="how many, evenly spaced")
    parser.add_argument("--seeds", type=int, default=5, help="in each half of sac's")
    parser.add_argument("--steps", type=int, help="of training, instead of the recipe's")
    parser.add_argument("--profile", choices=("paper", "quick", "reduced"), default="paper")
    parser.add_argument("--set", dest="overrides", action="append", default=[], help="section.key=value")
    arguments = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    recipes = {source: recipe_of(source, arguments) for source in ("sac", "stacked")}
    every = choose_tasks(recipes["sac"], None)
    tasks = [every[i] for i in np.linspace(0, len(every) - 1, arguments.tasks).round().astype(int)]
    found: dict[str, Returns] = {}
    for source, recipe in recipes.items():
        began, runs = time.process_time(), []
        for seed in range(2 * arguments.seeds):
            runs.append(curves(recipe, tasks, seed))
            seconds = time.process_time() - began
            print(f"{source}, seed {seed}: {seconds:.0f} s of the processor so far", file=sys.stderr)
        found[source] = np.stack(runs, axis=1)  # (tasks, seeds, checkpoints)
    result = {
        "benchmark": "behavior_parity",
        "environment": arguments.environment,
        "behavior": recipes["sac"].behavior.settings,
        "tasks": [task.index for task in tasks],
        "sac_seeds": 2 * arguments.seeds,
        "curves": {source: values.mean(axis=(0, 1)).tolist() for source, values in found.items()},
        "final_return": compare(found["sac"][..., -1], found["stacked"][..., -1]),
        "area_under_curve": compare(found["sac"].mean(axis=-1), found["stacked"].mean(axis=-1)),
    }
    print(json.dumps(result, indent=2))


def recipe_of(source: str, arguments: argparse.Namespace) -> Recipe:
    """The environment's recipe with evenly spaced checkpoints and few rollouts."""

    def load(overrides: list[str]) -> Recipe:
        chosen = [*arguments.overrides, *overrides]
        return load_recipe(
            arguments.environment, profile=arguments.profile, behavior=source, overrides=chosen
        )

    steps = arguments.steps or load([]).behavior.settings["steps"]
    snapshots = [steps * k // CHECKPOINTS for k in range(CHECKPOINTS + 1)]
    training = [f"behavior.sac.steps={steps}", f"behavior.sac.snapshots={snapshots}"]
    return load([*training, "rollouts.episodes=20", "rollouts.lanes=20"])


if __name__ == "__main__":
    main()
