"""Meta-testing: adapts a trained run to the test tasks, and compares its returns with controls."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from tcmrl_algo.adaptation.arena import Arena, Context, ProgressCallback, ignore_progress
from tcmrl_algo.adaptation.control_records import Controls
from tcmrl_algo.adaptation.controls import dataset_controls
from tcmrl_algo.adaptation.paths import FinalEpisodes, PathPlot
from tcmrl_algo.adaptation.protocols.base import PROTOCOLS, Adaptation
from tcmrl_algo.adaptation.results import Evaluation, Reference, TaskResult
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_algo.training.checkpoint import Run, open_run
from tcmrl_algo.training.config import method_of
from tcmrl_algo.training.metrics import log_evaluation
from tcmrl_algo.training.train import create_algorithm
from tcmrl_data import Dataset, Task, TrainingError, Trajectory
from tcmrl_data.foundation.seeding import evenly_spread

MOST_OTHERS = 3
"""Most other tasks whose contexts are tried on a task; a single one may be very similar or dissimilar."""


def evaluate_run(
    run_folder: str | Path,
    *,
    protocol: str | None = None,
    dataset_path: str | Path | None = None,
    episodes: int | None = None,
    random_episodes: int | None = None,
    repeats: int | None = None,
    plot: Path | None = None,
    report: ProgressCallback = ignore_progress,
) -> Evaluation:
    """Evaluates the newest checkpoint of a run, and logs the means in the folder of the run.

    Args:
        run_folder: folder of a run of `tcmrl train`.
        protocol: replaces the protocol of the run.
        dataset_path: folder of the run's dataset, if the dataset was moved.
        episodes: replaces the number of adaptation episodes per task of the run.
        random_episodes: replaces `run.random_episodes`, how many of them form the first stage.
        repeats: replaces `run.repeats`, how many times a protocol with a random first stage is run.
        plot: picture to write, of the paths of the adapted policy in the test tasks.
        report: called when episodes end.

    Raises:
        CheckpointError: no run, no checkpoint, or not the dataset that the run was trained on.
        TrainingError: the dataset holds no test task.
        UnknownNameError: an unknown protocol; the message lists the nearest names.
        RenderingError: the environment's paths cannot be drawn, or the picture's ending is not known.

    Example:
        >>> evaluation = evaluate_run("runs/point-robot-tcmrl-seed0", protocol="idaq")  # doctest: +SKIP
        >>> evaluation.mean_final, evaluation.mean_shuffled  # doctest: +SKIP
    """
    run = open_run(run_folder)
    dataset = run.open_dataset(dataset_path)
    settings = run.record.config.settings.run
    changes = {
        "protocol": protocol,
        "episodes": episodes,
        "random_episodes": random_episodes,
        "repeats": repeats,
    }
    settings = settings.model_copy(update={key: value for key, value in changes.items() if value is not None})
    torch.set_num_threads(settings.threads)
    show = ignore_episodes if plot is None else PathPlot(plot, dataset, settings)
    evaluation = evaluate_open_run(run, dataset, settings, report=report, show=show)
    scores = {
        "final": evaluation.mean_final,
        "shuffled": evaluation.mean_shuffled,
        "regret": evaluation.mean_regret,
        "normalized": evaluation.mean_normalized,
    }
    log_evaluation(run.folder, step=run.newest().step, protocol=evaluation.protocol, scores=scores)
    return evaluation


def ignore_episodes(episodes: FinalEpisodes) -> None:
    """Ignores final episodes."""


def evaluate_open_run(
    run: Run,
    dataset: Dataset,
    settings: RunSettings,
    *,
    report: ProgressCallback = ignore_progress,
    show: Callable[[FinalEpisodes], None] = ignore_episodes,
) -> Evaluation:
    """As `evaluate_run`, for an open run and dataset.

    Args:
        run: the run.
        dataset: its dataset.
        settings: may differ from those of the run.
        report: called when episodes end.
        show: called with the final episodes of all tasks.
    """
    protocol = PROTOCOLS.get(settings.protocol)()
    tasks = dataset.test_tasks
    if not tasks:
        raise TrainingError(
            f"{dataset.folder} contains no test task; build one with `tcmrl-data build --tasks`"
        )
    config = run.record.config
    config = config.model_copy(update={"settings": config.settings.model_copy(update={"run": settings})})
    # This machine may lack the run's device, and how a method explores may depend on the settings here.
    algorithm = create_algorithm(run.record.model_copy(update={"device": "cpu", "config": config}), dataset)
    algorithm.load_tensors(run.newest().tensors())
    method, _ = method_of(config)
    seed = run.record.seed
    controls = dataset_controls(dataset, report=report)
    arena = Arena(dataset, algorithm, settings, capabilities=method.capabilities, seed=seed, report=report)
    repeats = settings.repeats if protocol.repeated else 1
    try:
        arena.begin("adaptation", len(tasks) * repeats * settings.episodes)
        adaptations = protocol.adapt(arena, [task for task in tasks for _ in range(repeats)])
        by_task = [adaptations[repeats * place :][:repeats] for place in range(len(tasks))]
        results = _results(arena, tasks, by_task, controls, show)
    finally:
        arena.close()
    return Evaluation(
        algorithm=settings.algorithm,
        environment=dataset.name,
        seed=seed,
        protocol=settings.protocol,
        repeats=repeats,
        tasks=results,
        adaptation_curve=[fmean(returns) for returns in zip(*(one.returns for one in results), strict=False)],
        mean_final=fmean(result.final for result in results),
        mean_regret=_mean([result.regret for result in results]),
        mean_normalized=_mean([result.normalized for result in results]),
        mean_shuffled=fmean(result.shuffled for result in results),
        mean_behavior=_mean([result.behavior for result in results]),
        mean_fixed=_mean([result.fixed for result in results]),
        privileged=run.record.privileged or method.capabilities.privileged,
    )


def _results(
    arena: Arena,
    tasks: Sequence[Task],
    adaptations: Sequence[Sequence[Adaptation]],
    controls: Controls,
    show: Callable[[FinalEpisodes], None],
) -> list[TaskResult]:
    """Results of every task, given its adaptations, one per repeat."""
    own = {
        task.index: [context for adaptation in repeats for context in adaptation.contexts]
        for task, repeats in zip(tasks, adaptations, strict=True)
    }
    others = {task.index: contexts_of_others(arena, task, own) for task in tasks}
    num_contexts = sum(len(contexts) for contexts in (*own.values(), *others.values()))
    arena.begin("final episodes", num_contexts * arena.settings.final_episodes)
    final = _final_episodes(arena, tasks, own)
    shuffled = _final_episodes(arena, tasks, others)
    show(FinalEpisodes(final, shuffled))
    results = []
    for task, repeats in zip(tasks, adaptations, strict=True):
        references, control = arena.dataset.references(task.index), controls.task(task.index)
        mean = _mean_return(final[task.index])
        reference, best = _reference(references.oracle, control.behavior, references.behavior)
        results.append(
            TaskResult(
                task=task.index,
                split=task.split,
                returns=[fmean(found) for found in zip(*(one.returns for one in repeats), strict=True)],
                final=mean,
                finals=_finals(final[task.index], [len(one.contexts) for one in repeats]),
                oracle=references.oracle,
                random=references.uniform,
                behavior=control.behavior,
                fixed=control.fixed,
                regret=None if references.oracle is None else references.oracle - mean,
                normalized=_share(mean, references.uniform, best),
                reference=reference,
                success=_success(final[task.index]),
                shuffled=_mean_return(shuffled[task.index]),
            )
        )
    return results


def contexts_of_others(arena: Arena, task: Task, own: dict[int, list[Context]]) -> list[Context]:
    """Contexts of other tasks for the shuffled control, as many as the task has itself or more.

    The contexts are those of up to MOST_OTHERS other test tasks, evenly spaced, in turn, and at least one
    context per other task. A test task is skipped if it shares a context with this task (with `idaq`, two
    test tasks may keep the context of the same training task) or has an empty context (the prior belongs to
    no task). If no test task remains, the contexts are stored trajectories of training tasks.
    """
    num_own = len(own[task.index])
    excluded = {_key(context) for context in own[task.index]} | {()}

    def foreign(candidates: Iterable[list[Context]]) -> list[list[Context]]:
        return [contexts for contexts in candidates if excluded.isdisjoint(map(_key, contexts))]

    others = foreign(contexts for index, contexts in own.items() if index != task.index)
    if not others:
        others = foreign(
            [arena.stored(other, draw=draw) for draw in range(num_own)] for other in arena.dataset.train_tasks
        )
    chosen = evenly_spread(others, MOST_OTHERS)
    lanes = range(max(num_own, len(chosen)))
    return [chosen[lane % len(chosen)][lane // len(chosen)] for lane in lanes]


def _key(context: Context) -> tuple[int, ...]:
    """Identifies a context by its trajectories."""
    return tuple(id(trajectory) for trajectory in context)


def _finals(trajectories: Sequence[Trajectory], num_contexts: Sequence[int]) -> list[float]:
    """Mean final return of every repeat, whose contexts follow one another in every round of episodes."""
    returns = np.array([trajectory.undiscounted_return for trajectory in trajectories])
    by_context = returns.reshape(-1, sum(num_contexts)).mean(axis=0)
    return [float(part.mean()) for part in np.split(by_context, np.cumsum(num_contexts)[:-1])]


def _final_episodes(
    arena: Arena, tasks: Sequence[Task], contexts: dict[int, list[Context]]
) -> dict[int, list[Trajectory]]:
    """Final episodes of all tasks with all their contexts, by task index."""
    lanes = [(task, context) for task in tasks for context in contexts[task.index]]
    found: dict[int, list[Trajectory]] = {task.index: [] for task in tasks}
    for repeat in range(arena.settings.final_episodes):
        trajectories = arena.adapted(
            [task for task, _ in lanes],
            [context for _, context in lanes],
            episode=arena.settings.episodes + repeat,  # not the seeds of adaptation episodes
        )
        for (task, _), trajectory in zip(lanes, trajectories, strict=True):
            found[task.index].append(trajectory)
    return found


def _mean_return(trajectories: Sequence[Trajectory]) -> float:
    return fmean(trajectory.undiscounted_return for trajectory in trajectories)


def _success(trajectories: Sequence[Trajectory]) -> float | None:
    if any("success" not in trajectory.extras for trajectory in trajectories):
        return None
    return fmean(float(trajectory.extras["success"].any()) for trajectory in trajectories)


def _reference(oracle: float | None, behavior: float | None, stored: float) -> tuple[Reference, float]:
    """The return at which `normalized` is 1, and what it is."""
    if oracle is not None:
        return "oracle", oracle
    return ("stored", stored) if behavior is None else ("behavior", behavior)


def _share(value: float, low: float | None, high: float) -> float | None:
    return None if low is None or high == low else (value - low) / (high - low)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None
