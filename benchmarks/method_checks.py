"""Whether methods do what their papers say of them: `python benchmarks/method_checks.py results/table2`.

Reads the finished runs of an experiment in one environment and prints JSON, of every method the mean over
its runs:

- All methods: the return of the policy adapted to stored trajectories, in training tasks and in test tasks.
  Where the two are equal, what is missing was not learned, rather than not generalized.
- Methods with an encoder: how often a context of as many stored episodes as `--episodes` says lies nearest to
  the centroid of its task's others, among NUM_TASKS training tasks and among the test tasks, with episodes of
  all snapshots, and of every task's last.
- The same methods: V halfway through last snapshots' episodes of these training tasks, under the task's own
  context and under another's. Where the two are equal the critic reads the task from the state.
- CSRO: the share of the variance of representations z_t that a linear function of (s_t, a_t) explains, on
  other trajectories than those it was fitted on. Its penalty is to lower it.
- UNICORN: the mean squared error of rewards that the decoder predicts from a task's own context, and from the
  context of another task.
- MACAW: the return of the policy that training starts tasks from, and after one inner step on stored
  trajectories.
- BOReL: the mean variance of the belief before the first step of a stored lane, and after others.

Contexts and rewards are of the test tasks' stored trajectories; contexts are of other trajectories than the
rewards that are predicted from them.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from tcmrl_algo import Algorithm, ContextAlgorithm, RunResult, create_algorithm
from tcmrl_algo.algorithms.borel import BorelLearner, joined_episodes
from tcmrl_algo.algorithms.csro import CsroLearner
from tcmrl_algo.algorithms.macaw import MacawLearner
from tcmrl_algo.algorithms.unicorn import UnicornLearner
from tcmrl_algo.evaluation.arena import Arena, Context
from tcmrl_algo.report.contexts import NUM_TASKS, centroid_accuracy
from tcmrl_algo.report.sources import read_sources
from tcmrl_algo.training.checkpoint import RunRecord, open_run
from tcmrl_algo.training.config import method_of
from tcmrl_data import Dataset, Steps, Task, Trajectory

TRAJECTORIES = 20
"""Stored trajectories of every task, half of them for contexts or fits."""
CONTEXTS = 20
"""Contexts of a task, and states of a task under each of them."""
Values = dict[str, float]


def returns_by_split(dataset: Dataset, arena: Arena) -> Values:
    """Mean returns after adaptation to stored trajectories, in training and in test tasks."""
    splits = {"train": _spread(dataset.train_tasks), "test": dataset.test_tasks}
    return {
        f"return: {split}": _mean_return(arena, tasks, [arena.stored(task, draw=0) for task in tasks])
        for split, tasks in splits.items()
    }


def _mean_return(arena: Arena, tasks: Sequence[Task], contexts: Sequence[Context]) -> float:
    episodes = arena.adapted(tasks, contexts, episode=0)
    return fmean(float(episode.rewards.sum()) for episode in episodes)


def nearest_centroids(algorithm: ContextAlgorithm, dataset: Dataset, episodes: int) -> Values:
    """Methods with an encoder: shares of contexts that are nearest to their own task's centroid."""
    training = dataset.train_tasks
    splits = {
        "train": training[:: max(1, len(training) // NUM_TASKS)][:NUM_TASKS],
        "test": dataset.test_tasks,
    }
    found = {}
    for split, tasks in splits.items():
        for snapshots in ("all", "last"):
            random = np.random.default_rng(0)
            lanes = []
            for task in tasks:
                stored = dataset.select(tasks=[task.index], snapshots=snapshots).trajectories(task.index)
                draws = [random.choice(len(stored), episodes, replace=False) for _ in range(CONTEXTS)]
                lanes += [[stored[index] for index in draw] for draw in draws]
            contexts = algorithm.context(lanes).numpy()
            accuracy = centroid_accuracy(contexts, np.repeat(np.arange(len(tasks)), CONTEXTS))
            if (
                accuracy is not None and np.ptp(contexts, axis=0).any()
            ):  # the controls' contexts are all equal
                found[f"nearest: {split}, {snapshots}"] = accuracy
    return found


def values_by_context(algorithm: ContextAlgorithm, dataset: Dataset, episodes: int) -> Values:
    """Methods with an encoder: V of stored states under their own task's context, and under another's."""
    stored = [
        dataset.select(tasks=[task.index], snapshots="last").trajectories(task.index)
        for task in _spread(dataset.train_tasks)
    ]
    contexts = algorithm.context([found[:episodes] for found in stored])
    own: list[float] = []
    another: list[float] = []
    for place, found in enumerate(stored):
        states = torch.stack(
            [torch.as_tensor(one.observations[len(one.actions) // 2]) for one in found[episodes:][:CONTEXTS]]
        )
        scaled = algorithm.actor_critic.scaling(states.float())
        for shift, values in ((0, own), *((shift, another) for shift in range(1, len(stored)))):
            context = contexts[(place + shift) % len(stored)].expand(len(scaled), -1)
            values.append(float(algorithm.actor_critic.value(torch.cat([scaled, context], dim=-1)).mean()))
    return {"value: own": fmean(own), "value: another's": fmean(another)}


def _spread(tasks: Sequence[Task]) -> Sequence[Task]:
    return tasks[:: max(1, len(tasks) // NUM_TASKS)][:NUM_TASKS]


def explained_by_states_and_actions(learner: CsroLearner, fitted_on: Steps, steps: Steps) -> Values:
    """CSRO: the explained share of the variance of representations."""
    (first_inputs, first), (inputs, outputs) = (_rows(learner, part) for part in (fitted_on, steps))
    errors = outputs - inputs @ torch.linalg.lstsq(first_inputs, first).solution
    share = 1.0 - float(errors.square().sum() / (outputs - outputs.mean(dim=0)).square().sum())
    return {"explained": share}


def _rows(learner: CsroLearner, steps: Steps) -> tuple[Tensor, Tensor]:
    """(s, a, 1) and z of all transitions."""
    read = learner.encoder.read(steps)
    (representations,) = learner.encoder(read)
    inputs = read.state_actions[steps.mask]
    return torch.cat([inputs, torch.ones(len(inputs), 1)], dim=1), representations[steps.mask]


def reward_errors(learner: UnicornLearner, context_steps: Steps, steps: Steps) -> Values:
    """UNICORN: errors of the reward decoder under a task's own context and under another's."""
    own = learner.context(context_steps)
    read = learner.encoder.read(steps)
    mask = steps.mask.flatten(1)

    def error(context: Tensor) -> float:
        spread = context.unsqueeze(1).expand(-1, mask.shape[1], -1)
        inputs = torch.cat([spread, read.state_actions.flatten(1, 2)], dim=-1)
        rewards, _ = learner.reward_decoder(inputs)
        return float((rewards - read.outcomes.flatten(1, 2)[..., :1])[mask].square().mean())

    others = [error(own.roll(shift, dims=0)) for shift in range(1, len(own))]
    return {"own": error(own), "another": fmean(others)}


def gain_of_inner_step(dataset: Dataset, arena: Arena) -> Values:
    """MACAW: returns before and after the inner step."""
    tasks = dataset.test_tasks
    return {
        "before": _mean_return(arena, tasks, [[] for _ in tasks]),
        "after": _mean_return(arena, tasks, [arena.stored(task, draw=0) for task in tasks]),
    }


def variances(learner: BorelLearner, steps: Steps, *, episodes: int) -> Values:
    """BOReL: variances of beliefs along lanes of as many trajectories as it was trained on."""
    found = learner.beliefs(joined_episodes(steps, episodes))[1].log_variances.exp().mean(dim=-1)
    length = steps.mask.shape[-1]
    places = sorted({0, 1, *range(length // 4, episodes * length + 1, length // 4)})
    return {f"after {place} steps": float(found[:, place].mean()) for place in places}


def checks(run: RunResult, episodes: int) -> Values:
    """The checks of a finished run's method, with contexts of as many episodes."""
    opened = open_run(run.folder)
    dataset = opened.open_dataset()
    algorithm = create_algorithm(opened.record, dataset)
    algorithm.load_tensors(opened.newest().tensors())
    found = _acted(opened.record, algorithm, dataset)
    if not isinstance(algorithm, ContextAlgorithm):
        return found
    halves: tuple[list[list[Trajectory]], ...] = ([], [])
    for task in dataset.test_tasks:
        stored = dataset.select(tasks=[task.index]).trajectories(task.index)
        chosen = stored[:: max(1, len(stored) // TRAJECTORIES)][:TRAJECTORIES]
        for half, place in zip(halves, (0, 1), strict=True):
            half.append(chosen[place::2])
    first, second = (algorithm.pack(half) for half in halves)
    nearest = nearest_centroids(algorithm, dataset, episodes)
    if nearest:
        found |= nearest | values_by_context(algorithm, dataset, episodes)
    match algorithm.learner:
        case CsroLearner():
            return found | explained_by_states_and_actions(algorithm.learner, first, second)
        case UnicornLearner():
            return found | reward_errors(algorithm.learner, first, second)
        case BorelLearner():
            joined = opened.record.config.method["episodes_per_belief"]
            return found | variances(algorithm.learner, second, episodes=joined)
    return found


def _acted(record: RunRecord, algorithm: Algorithm, dataset: Dataset) -> Values:
    """The checks for which the policy acts."""
    method, _ = method_of(record.config)
    settings = record.config.settings.run
    arena = Arena(dataset, algorithm, settings, capabilities=method.capabilities, seed=record.seed)
    try:
        found = returns_by_split(dataset, arena)
        return found | gain_of_inner_step(dataset, arena) if isinstance(algorithm, MacawLearner) else found
    finally:
        arena.close()


def main() -> None:
    """Prints the checks of all methods."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path, help="results folder of an experiment")
    parser.add_argument("--environment", default="point-robot")
    parser.add_argument("--episodes", type=int, default=4, help="of a context; 4 as of protocol `offline`")
    arguments = parser.parse_args()
    torch.set_grad_enabled(False)
    found: dict[str, list[Values]] = {}
    (source,) = read_sources([arguments.results])
    for run in source.results(arguments.environment):
        found.setdefault(run.label, []).append(checks(run, arguments.episodes))
    means = {
        label: {name: round(fmean(one[name] for one in runs), 4) for name in runs[0]} | {"runs": len(runs)}
        for label, runs in found.items()
    }
    asked = {"environment": arguments.environment, "episodes": arguments.episodes}
    print(json.dumps(asked | {"methods": means}, indent=1))


if __name__ == "__main__":
    main()
