"""Meta-testing: adapts a trained run to the test tasks, and compares its returns with controls."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import numpy as np
import torch

from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_algo.evaluation.arena import Arena, Context, ProgressCallback, ignore_progress
from tcmrl_algo.evaluation.controls import TaskControls, dataset_controls
from tcmrl_algo.evaluation.protocols.base import PROTOCOLS, Adaptation
from tcmrl_algo.training.checkpoint import open_run
from tcmrl_algo.training.config import method_of
from tcmrl_algo.training.train import create_algorithm, log_evaluation
from tcmrl_data import Dataset, Environment, RenderingError, Task, TrainingError, Trajectory
from tcmrl_data.foundation.seeding import evenly_spread

Reference = Literal["oracle", "behavior", "stored"]


@dataclass(frozen=True)
class TaskResult:
    """Result of a run on one test task; returns are undiscounted sums of rewards.

    Attributes:
        returns: returns of the adaptation episodes, means over the repeats of the protocol.
        final: mean return of the adapted policy.
        finals: the same for every repeat; their spread is that of the protocol's own chance.
        oracle: return of a controller that knows the task, None if the environment has none.
        random: return of uniform actions, None if it was not measured.
        behavior: return of the best of the task's own behavior policies, without their noise; None if the
            dataset holds none.
        fixed: return of the best policy that acts the same in all tasks, fitted on the training tasks; None
            if there is neither an oracle nor a stored policy.
        regret: oracle - final, None without an oracle.
        normalized: (final - random) / (best - random), with `best` the return of the reference.
        reference: where `normalized` is 1: the `oracle` or, without one, `behavior`, or without that one
            too the best policy's `stored` episodes.
        success: share of successful final episodes, None if the environment does not define success.
        shuffled: mean return of the same policy with the contexts of other tasks. A policy that adapts
            within an episode starts with the belief of the other task and updates it by its observations,
            so the value measures how well it corrects a wrong belief. A privileged policy keeps the
            parameters of the task itself.
    """

    task: int
    split: str
    returns: list[float]
    final: float
    finals: list[float]
    oracle: float | None
    random: float | None
    behavior: float | None
    fixed: float | None
    regret: float | None
    normalized: float | None
    reference: Reference
    success: float | None
    shuffled: float


@dataclass(frozen=True)
class Evaluation:
    """Result of a run on all tasks of its protocol; means are over tasks, and None if a task has no value.

    Attributes:
        repeats: how many times the protocol was run; 1 unless its first stage is random.
        adaptation_curve: mean returns of the first, second, … adaptation episode: how many episodes it
            takes until the policy is adapted. The episodes are those of the protocol; under `paper` the
            first ones are the method's exploration, uniform actions unless it has one of its own.
        mean_final, mean_regret, mean_normalized, mean_shuffled, mean_behavior, mean_fixed: means of the
            tasks' values.
        privileged: whether the method is a control that observes the task parameters.
    """

    algorithm: str
    environment: str
    seed: int
    protocol: str
    repeats: int
    tasks: list[TaskResult]
    adaptation_curve: list[float]
    mean_final: float
    mean_regret: float | None
    mean_normalized: float | None
    mean_shuffled: float
    mean_behavior: float | None
    mean_fixed: float | None
    privileged: bool

    def to_json(self) -> dict[str, Any]:
        """The JSON document of `tcmrl evaluate --json`."""
        return dataclasses.asdict(self)


PLOT_FORMATS = (".pdf", ".png", ".svg")
PANEL = 4.0
"""Width of a panel in inches."""

FinalEpisodes = Mapping[int, Sequence[Trajectory]]
"""The final episodes of an evaluation, by index of the test task."""


def check_plot(file: Path, environment: Environment) -> None:
    """Refuses a picture that `draw_paths` cannot draw.

    Raises:
        RenderingError: the environment's paths cannot be drawn, or the file's ending is not known.
    """
    if file.suffix.lower() not in PLOT_FORMATS:
        raise RenderingError(f"--plot {file}: the name must end in {', '.join(PLOT_FORMATS)}")
    if type(environment).draw_path is Environment.draw_path:
        raise RenderingError(
            f"--plot {file}: {environment.name} has no paths in a plane to draw; leave --plot out"
        )


def draw_paths(
    file: Path, dataset: Dataset, settings: RunSettings, adapted: FinalEpisodes, other: FinalEpisodes
) -> None:
    """Draws a final episode of every test task, and beside it one under another task's context."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2 * PANEL, PANEL), layout="compressed")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    name = settings.algorithm
    titles = (f"{name}, adapted ({settings.protocol})", f"{name}, other tasks' contexts")
    colors = colormaps["turbo"](np.linspace(0.05, 0.95, len(adapted)))
    for axes, title, found in zip(panels, titles, (adapted, other), strict=True):
        for place, (index, trajectories) in enumerate(found.items()):
            # contexts of several other tasks take turns
            observations = trajectories[place % len(trajectories)].observations
            parameters, color = dataset.task(index).parameters, to_hex(colors[place])
            dataset.environment.draw_path(axes, parameters, observations, color=color)
        axes.set(title=title, xlabel="x")
    panels[0].set_ylabel("y")
    figure.suptitle(f"{dataset.name}: paths in {len(adapted)} test tasks")
    figure.savefig(file, dpi=110, bbox_inches="tight")


LOGGED = ("final", "shuffled", "regret", "normalized")
"""Means that the run's curves hold."""

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
        protocol: replaces the protocol of the run.
        dataset_path: folder of the run's dataset, if the dataset was moved.
        episodes: replaces the number of adaptation episodes per task of the run.
        random_episodes: replaces `run.random_episodes`, how many of them form the first stage.
        repeats: replaces `run.repeats`, how many times a protocol with a random first stage is run.

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
    if plot is not None:
        check_plot(plot, dataset.environment)
    adapts = PROTOCOLS.get(settings.protocol)()
    tasks = dataset.test_tasks
    if adapts.split == "train":
        tasks = tuple(evenly_spread(dataset.train_tasks, len(tasks)))
    if not tasks:
        raise TrainingError(
            f"{dataset.path} contains no test task; build one with `tcmrl-data build --tasks`"
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
    repeats = settings.repeats if adapts.repeated else 1
    try:
        arena.begin("adaptation", len(tasks) * repeats * settings.episodes)
        adaptations = adapts.adapt(arena, [task for task in tasks for _ in range(repeats)])
        by_task = [adaptations[repeats * place :][:repeats] for place in range(len(tasks))]
        final, shuffled = _final_episodes(arena, tasks, by_task)
    finally:
        arena.close()
    results = [
        _result(dataset, task, ended, controls.task(task.index), final[task.index], shuffled[task.index])
        for task, ended in zip(tasks, by_task, strict=True)
    ]
    evaluation = Evaluation(
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
    if plot is not None:
        draw_paths(plot, dataset, settings, final, shuffled)
    scores = {name: getattr(evaluation, f"mean_{name}") for name in LOGGED}
    log_evaluation(run.folder, step=run.newest().step, protocol=evaluation.protocol, scores=scores)
    return evaluation


def _result(
    dataset: Dataset,
    task: Task,
    adaptations: Sequence[Adaptation],
    control: TaskControls | None,
    final: Sequence[Trajectory],
    shuffled: Sequence[Trajectory],
) -> TaskResult:
    """Result of a task, given its adaptations, one per repeat, and its final episodes."""
    references, mean = dataset.references(task.index), _mean_return(final)
    behavior, fixed = (None, None) if control is None else (control.behavior, control.fixed)
    reference, best = _reference(references.oracle, behavior, references.behavior)
    return TaskResult(
        task=task.index,
        split=task.split,
        returns=[fmean(found) for found in zip(*(one.returns for one in adaptations), strict=True)],
        final=mean,
        finals=_finals(final, [len(one.contexts) for one in adaptations]),
        oracle=references.oracle,
        random=references.uniform,
        behavior=behavior,
        fixed=fixed,
        regret=None if references.oracle is None else references.oracle - mean,
        normalized=_share(mean, references.uniform, best),
        reference=reference,
        success=_success(final),
        shuffled=_mean_return(shuffled),
    )


def contexts_of_others(arena: Arena, task: Task, own: dict[int, list[Context]]) -> list[Context]:
    """Contexts of other tasks for the shuffled control, as many as the task has itself or more.

    The contexts are those of up to MOST_OTHERS other evaluated tasks, evenly spaced, in turn, and at least
    one context per other task. A task is skipped if it shares a context with this task (with `idaq`, two
    tasks may keep the context of the same training task) or has an empty context (the prior belongs to no
    task). If none remains, the contexts are stored trajectories of training tasks.
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
    arena: Arena, tasks: Sequence[Task], adaptations: Sequence[Sequence[Adaptation]]
) -> tuple[FinalEpisodes, FinalEpisodes]:
    """Final episodes of all tasks with all their own contexts, and with those of other tasks."""
    own = {
        task.index: [context for adaptation in repeats for context in adaptation.contexts]
        for task, repeats in zip(tasks, adaptations, strict=True)
    }
    others = {task.index: contexts_of_others(arena, task, own) for task in tasks}
    num_contexts = sum(len(contexts) for contexts in (*own.values(), *others.values()))
    arena.begin("final episodes", num_contexts * arena.settings.final_episodes)
    return _episodes_with(arena, tasks, own), _episodes_with(arena, tasks, others)


def _episodes_with(arena: Arena, tasks: Sequence[Task], contexts: dict[int, list[Context]]) -> FinalEpisodes:
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
