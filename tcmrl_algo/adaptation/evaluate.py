"""Meta-testing: adapts a trained run to the test tasks and scores it against its controls."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import numpy as np
import torch

from tcmrl_algo.adaptation.arena import Arena, Context, ProgressCallback, ignore_progress
from tcmrl_algo.adaptation.protocols.base import PROTOCOLS, Adaptation
from tcmrl_algo.settings.run import RunSettings
from tcmrl_algo.training.checkpoint import Run, open_run
from tcmrl_algo.training.config import method_of
from tcmrl_algo.training.metrics import log_evaluation
from tcmrl_algo.training.train import create_algorithm
from tcmrl_data import Dataset, Task, TrainingError, Trajectory

MOST_OTHERS = 3
"""Other tasks whose contexts are tried on a task; one alone could lie too near or far."""


@dataclass(frozen=True)
class TaskResult:
    """How a run does on one test task; returns are undiscounted sums of rewards.

    Attributes:
        task: its index.
        split: `test`.
        returns: one per adaptation episode.
        final: mean return of the adapted policy.
        oracle: return of a controller that knows the task, or None.
        random: return of uniform actions.
        regret: oracle - final, or None.
        normalized: (final - random) / (best - random), best being the return of the reference.
        reference: what `normalized` is 1 at: the `oracle` or, without one, the best `behavior` policy.
        success: share of final episodes that succeed, or None where the environment does not say.
        shuffled: mean return of the same policy under other tasks' contexts. A policy that adapts within
            an episode begins with the other task's belief and goes on from it by what it observes, so that
            this tells how well it corrects a wrong belief. A privileged policy keeps the parameters of the
            task itself.
    """

    task: int
    split: str
    returns: list[float]
    final: float
    oracle: float | None
    random: float
    regret: float | None
    normalized: float | None
    reference: Literal["oracle", "behavior"]
    success: float | None
    shuffled: float


@dataclass(frozen=True)
class Evaluation:
    """How a run does on all test tasks; means are over them, None where a task has no value.

    `privileged` marks a control that saw the tasks' parameters.
    """

    algorithm: str
    environment: str
    seed: int
    protocol: str
    tasks: list[TaskResult]
    mean_final: float
    mean_regret: float | None
    mean_normalized: float | None
    mean_shuffled: float
    privileged: bool

    def to_json(self) -> dict[str, Any]:
        """The document of `tcmrl evaluate --json`."""
        return dataclasses.asdict(self)


def evaluate_run(
    run_folder: str | Path,
    *,
    protocol: str | None = None,
    dataset_path: str | Path | None = None,
    episodes: int | None = None,
    report: ProgressCallback = ignore_progress,
) -> Evaluation:
    """Evaluates the newest checkpoint of a run, and logs the means in the run's folder.

    Args:
        run_folder: made by `train`.
        protocol: instead of the run's own.
        dataset_path: where the run's dataset lies now, if it has moved.
        episodes: adaptation episodes per task, instead of the run's own.
        report: called as episodes end.

    Raises:
        CheckpointError: no run, no checkpoint, or another dataset than the run was trained on.
        TrainingError: the dataset holds no test task.
        UnknownNameError: no such protocol; the message lists the nearest names.

    Example:
        >>> evaluation = evaluate_run("runs/point-robot-tcmrl-seed0", protocol="idaq")  # doctest: +SKIP
        >>> evaluation.mean_final, evaluation.mean_shuffled  # doctest: +SKIP
    """
    run = open_run(run_folder)
    dataset = run.open_dataset(dataset_path)
    settings = run.record.config.settings.run
    changes = {"protocol": protocol, "episodes": episodes}
    settings = settings.model_copy(update={key: each for key, each in changes.items() if each is not None})
    torch.set_num_threads(settings.threads)
    evaluation = evaluate_open_run(run, dataset, settings, report=report)
    scores = {
        "final": evaluation.mean_final,
        "shuffled": evaluation.mean_shuffled,
        "regret": evaluation.mean_regret,
        "normalized": evaluation.mean_normalized,
    }
    log_evaluation(run.folder, step=run.newest().step, protocol=evaluation.protocol, scores=scores)
    return evaluation


def evaluate_open_run(
    run: Run, dataset: Dataset, settings: RunSettings, *, report: ProgressCallback = ignore_progress
) -> Evaluation:
    """As `evaluate_run`, for what is already open; `settings` may differ from the run's own."""
    protocol = PROTOCOLS.get(settings.protocol)()
    tasks = dataset.test_tasks
    if not tasks:
        raise TrainingError(f"{dataset.folder} holds no test task; build one with `tcmrl-data build --tasks`")
    on_cpu = run.record.model_copy(update={"device": "cpu"})  # the run's own may be another machine's
    algorithm = create_algorithm(on_cpu, dataset)
    algorithm.load_tensors(run.newest().tensors())
    method, _ = method_of(run.record.config)
    seed = run.record.seed
    arena = Arena(dataset, algorithm, settings, capabilities=method.capabilities, seed=seed, report=report)
    try:
        arena.begin("adaptation", len(tasks) * settings.episodes)
        adaptations = protocol.adapt(arena, tasks)
        results = _results(arena, tasks, adaptations)
    finally:
        arena.close()
    regrets = [each.regret for each in results]
    scores = [each.normalized for each in results]
    return Evaluation(
        algorithm=settings.algorithm,
        environment=dataset.name,
        seed=seed,
        protocol=settings.protocol,
        tasks=results,
        mean_final=fmean(each.final for each in results),
        mean_regret=_mean(regrets),
        mean_normalized=_mean(scores),
        mean_shuffled=fmean(each.shuffled for each in results),
        privileged=run.record.privileged or method.capabilities.privileged,
    )


def _results(arena: Arena, tasks: Sequence[Task], adaptations: Sequence[Adaptation]) -> list[TaskResult]:
    own = {task.index: each.contexts for task, each in zip(tasks, adaptations, strict=True)}
    others = {task.index: contexts_of_others(arena, task, own) for task in tasks}
    num_contexts = sum(len(each) for each in (*own.values(), *others.values()))
    arena.begin("final episodes", num_contexts * arena.settings.final_episodes)
    final = _final_episodes(arena, tasks, own)
    shuffled = _final_episodes(arena, tasks, others)
    results = []
    for task, adaptation in zip(tasks, adaptations, strict=True):
        references = arena.dataset.references(task.index)
        mean = _mean_return(final[task.index])
        best = references.behavior if references.oracle is None else references.oracle
        results.append(
            TaskResult(
                task=task.index,
                split=task.split,
                returns=adaptation.returns,
                final=mean,
                oracle=references.oracle,
                random=references.uniform,
                regret=None if references.oracle is None else references.oracle - mean,
                normalized=_share(mean, references.uniform, best),
                reference="behavior" if references.oracle is None else "oracle",
                success=_success(final[task.index]),
                shuffled=_mean_return(shuffled[task.index]),
            )
        )
    return results


def contexts_of_others(arena: Arena, task: Task, own: dict[int, list[Context]]) -> list[Context]:
    """As many contexts of other tasks as the task has of its own; at least one of each lender.

    Up to MOST_OTHERS other test tasks, evenly spaced, lend in turn what they were adapted by, unless the
    task was adapted by the same (two may keep one training task's context under `idaq`), or it holds no
    trajectory (the prior is no task's). Where nobody is left, training tasks lend stored trajectories.
    """
    num_own = len(own[task.index])
    excluded = {_key(context) for context in own[task.index]} | {()}

    def foreign(lenders: Iterable[list[Context]]) -> list[list[Context]]:
        return [contexts for contexts in lenders if excluded.isdisjoint(map(_key, contexts))]

    others = foreign(contexts for index, contexts in own.items() if index != task.index)
    if not others:
        others = foreign(
            [arena.stored(each, draw=draw) for draw in range(num_own)] for each in arena.dataset.train_tasks
        )
    spread = np.linspace(0, len(others) - 1, min(MOST_OTHERS, len(others))).round().astype(int)
    chosen = [others[index] for index in spread]
    lanes = range(max(num_own, len(chosen)))
    return [chosen[lane % len(chosen)][lane // len(chosen)] for lane in lanes]


def _key(context: Context) -> tuple[int, ...]:
    """Tells contexts apart by the trajectories that they hold."""
    return tuple(id(trajectory) for trajectory in context)


def _final_episodes(
    arena: Arena, tasks: Sequence[Task], contexts: dict[int, list[Context]]
) -> dict[int, list[Trajectory]]:
    """Final episodes of every task, under each of its contexts; by task index."""
    lanes = [(task, context) for task in tasks for context in contexts[task.index]]
    found: dict[int, list[Trajectory]] = {task.index: [] for task in tasks}
    for repeat in range(arena.settings.final_episodes):
        trajectories = arena.adapted(
            [task for task, _ in lanes],
            [context for _, context in lanes],
            episode=arena.settings.episodes + repeat,  # seeds that no adaptation episode had
        )
        for (task, _), trajectory in zip(lanes, trajectories, strict=True):
            found[task.index].append(trajectory)
    return found


def _mean_return(trajectories: Sequence[Trajectory]) -> float:
    return fmean(each.undiscounted_return for each in trajectories)


def _success(trajectories: Sequence[Trajectory]) -> float | None:
    if any("success" not in each.extras for each in trajectories):
        return None
    return fmean(float(each.extras["success"].any()) for each in trajectories)


def _share(value: float, low: float, high: float) -> float | None:
    return None if high == low else (value - low) / (high - low)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [each for each in values if each is not None]
    return fmean(known) if len(known) == len(values) else None
