"""What a method learns from: sizes and statistics of the data, stages, tasks, trajectories, and the seed."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tcmrl_data import (
    NO_TASK,
    BatchRequest,
    Environment,
    Moments,
    Purpose,
    Steps,
    Task,
    TrainingError,
    Trajectory,
    keyed_seed,
)
from tcmrl_data.foundation.records import Frozen


@dataclass(frozen=True)
class Stage:
    """One stage of training.

    Attributes:
        name: unique within a method.
    """

    name: str
    steps: int
    request: BatchRequest


class StagePosition(NamedTuple):
    """Where a training step lies.

    Attributes:
        step: its number within the stage, from 1.
    """

    stage: str
    step: int
    steps: int


@final
class StagePlan:
    """The stages of a run, one after the other.

    Raises:
        TrainingError: no stage, a stage without a step, a name twice, or another sum of steps.
    """

    def __init__(self, stages: Collection[Stage], *, steps: int) -> None:
        self.stages, self.steps = tuple(stages), steps
        names = [stage.name for stage in stages]
        if len(set(names)) < len(names):
            raise TrainingError(f"stages {names} share a name; give every stage its own")
        described = ", ".join(f"{stage.name} {stage.steps}" for stage in stages)
        if any(stage.steps < 1 for stage in stages) or sum(stage.steps for stage in stages) != steps:
            raise TrainingError(
                f"the stages' steps ({described}) must be positive and sum to run.steps, {steps}; change "
                "run.steps, or the method's own steps, with --set"
            )

    def __iter__(self) -> Iterator[Stage]:
        return iter(self.stages)

    def at(self, step: int) -> StagePosition:
        """The position of a training step, from 1; beyond the last stage's end, that stage goes on."""
        before = 0
        for stage in self.stages[:-1]:
            if step <= before + stage.steps:
                return StagePosition(stage.name, step - before, stage.steps)
            before += stage.steps
        last = self.stages[-1]
        return StagePosition(last.name, step - before, last.steps)


@dataclass(frozen=True)
class Problem:
    """Sizes and statistics of the selected data, and the seed of everything random in learning from it.

    Attributes:
        environment: its name; part of every seed's key.
        observation_dim, action_dim, horizon: sizes.
        reward_density: `sparse` picks trajectory-level reward estimation (paper, F.3).
        observation_mean, observation_std: (observation_dim,).
        change_mean, change_std: (observation_dim,), of s_{t+1} - s_t.
        action_mean, action_std: (action_dim,).
        reward_mean, reward_std: of single steps.
        reward_range: lowest and highest reward of a step.
        dense_reward_range: those of dense rewards, if the actor-critic learns from them; else None.
        stages: of training; schedules stretch over them.
        training_tasks: indices of the training tasks, ascending.
        privileged: (training tasks, parameters), standardised task parameters in the order of
            `training_tasks`; None for methods without that capability.
    """

    environment: str
    observation_dim: int
    action_dim: int
    horizon: int
    reward_density: Literal["dense", "sparse"]
    observation_mean: Float[Tensor, " observation"]
    observation_std: Float[Tensor, " observation"]
    change_mean: Float[Tensor, " observation"]
    change_std: Float[Tensor, " observation"]
    action_mean: Float[Tensor, " action"]
    action_std: Float[Tensor, " action"]
    reward_mean: float
    reward_std: float
    reward_range: tuple[float, float]
    seed: int
    stages: StagePlan
    training_tasks: tuple[int, ...]
    privileged: Float[Tensor, "training_tasks parameters"] | None
    device: torch.device
    dense_reward_range: tuple[float, float] | None = None

    def position(self, task_indices: Int64[Tensor, " tasks"]) -> Int64[Tensor, " tasks"]:
        """Dense indices, from 0, of training tasks given by the indices that batches hold."""
        known = torch.tensor(self.training_tasks, device=task_indices.device)
        return torch.searchsorted(known, task_indices)

    def generator(self, step: int, stream: int = 0) -> torch.Generator:
        """The CPU generator of one training step (0: the networks' starts), a function of seed and step.

        Parts of a method draw from streams of their own, so that a switch in one changes no other's draws.
        """
        seed = keyed_seed(self.seed, self.environment, NO_TASK, Purpose.LEARNER, step, stream)
        return torch.Generator().manual_seed(seed)


class MomentsRecord(Frozen):
    """`tcmrl_data.Moments` as JSON, kept with a run so that it is rebuilt without its data."""

    observation_mean: tuple[float, ...]
    observation_std: tuple[float, ...]
    delta_mean: tuple[float, ...]
    delta_std: tuple[float, ...]
    action_mean: tuple[float, ...]
    action_std: tuple[float, ...]
    reward_mean: float
    reward_std: float
    reward_min: float
    reward_max: float
    dense_reward_range: tuple[float, float] | None = None

    @classmethod
    def of(cls, moments: Moments) -> "MomentsRecord":
        """The record of a sampler's statistics."""
        values = {name: getattr(moments, name) for name in cls.model_fields}
        return cls.model_validate(
            {
                name: value.tolist() if isinstance(value, np.ndarray) else value
                for name, value in values.items()
            }
        )


def problem_of(
    environment: Environment,
    moments: MomentsRecord,
    *,
    seed: int,
    stages: StagePlan,
    training_tasks: Sequence[int],
    privileged: Float[Tensor, "training_tasks parameters"] | None,
    device: torch.device,
) -> Problem:
    """The problem that an environment, its training tasks and the statistics of the selected data pose."""
    return Problem(
        environment=environment.name,
        observation_dim=environment.observation_dim,
        action_dim=environment.action_dim,
        horizon=environment.settings.horizon,
        reward_density=environment.settings.reward_density,
        observation_mean=torch.tensor(moments.observation_mean),
        observation_std=torch.tensor(moments.observation_std),
        change_mean=torch.tensor(moments.delta_mean),
        change_std=torch.tensor(moments.delta_std),
        action_mean=torch.tensor(moments.action_mean),
        action_std=torch.tensor(moments.action_std),
        reward_mean=moments.reward_mean,
        reward_std=moments.reward_std,
        reward_range=(moments.reward_min, moments.reward_max),
        seed=seed,
        stages=stages,
        training_tasks=tuple(sorted(training_tasks)),
        privileged=None if privileged is None else privileged.to(device),
        device=device,
        dense_reward_range=moments.dense_reward_range,
    )


def pad_trajectories(
    trajectories: Sequence[Sequence[Trajectory]], problem: Problem, *, gamma: float | None = None
) -> Steps:
    """Trajectories of several lanes as padded steps (lanes, most trajectories, longest episode).

    Lanes may hold different numbers of trajectories, or none; what is missing is padding.

    Args:
        gamma: discount factor of the returns to go; None leaves out the fields that batches hold only of
            kinds with `returns=True`.
    """
    shape = (
        len(trajectories),
        max((len(lane) for lane in trajectories), default=0),
        max((len(trajectory) for lane in trajectories for trajectory in lane), default=0),
    )
    observations, following, final = np.zeros((3, *shape, problem.observation_dim), dtype=np.float32)
    actions = np.zeros((*shape, problem.action_dim), dtype=np.float32)
    rewards, terminated = np.zeros((2, *shape), dtype=np.float32)
    mask = np.zeros(shape, dtype=bool)
    for i, lane in enumerate(trajectories):
        for j, trajectory in enumerate(lane):
            place = (i, j, slice(0, len(trajectory)))
            observations[place] = trajectory.observations[:-1]
            following[place] = trajectory.observations[1:]
            final[place] = trajectory.observations[-1]
            actions[place], rewards[place] = trajectory.actions, trajectory.rewards
            terminated[place], mask[place] = trajectory.terminated, True
    arrays = (observations, actions, rewards, following, terminated, mask)
    steps = Steps(*(torch.from_numpy(array).to(problem.device) for array in arrays))
    if gamma is None:
        return steps
    return _with_endings(steps, torch.from_numpy(final).to(problem.device), gamma)


def _with_endings(
    steps: Steps, final_observations: Float[Tensor, "lanes trajectories steps observation"], gamma: float
) -> Steps:
    """The steps with G_t = r_t + gamma G_{t+1}, gamma^(T - t), s_T and t; zero on padding.

    In an episode that the task ended, 0 takes the place of gamma^(T - t).
    """
    returns, following = torch.zeros_like(steps.rewards, dtype=torch.float64), torch.zeros(())
    for t in range(returns.shape[-1] - 1, -1, -1):
        returns[..., t] = following = steps.rewards[..., t] + gamma * following
    times = torch.arange(returns.shape[-1], device=returns.device).expand(returns.shape)
    until_end = steps.mask.sum(dim=-1, keepdim=True) - times
    goes_on = steps.mask & ~steps.terminated.bool().any(dim=-1, keepdim=True)
    return replace(
        steps,
        returns_to_go=returns.float(),
        discounts_to_end=torch.where(goes_on, gamma ** until_end.double(), 0.0).float(),
        final_observations=final_observations,
        times=torch.where(steps.mask, times, 0),
    )


SMALLEST_STD = 1e-6
"""Parameters that vary less between training tasks are left undivided."""


@final
class TaskParameters:
    """Standardises the parameters of tasks by those of the training tasks.

    Parameters that are no numbers are left out where all tasks share them, such as the name of a simulator.

    Args:
        training_tasks: whose means and standard deviations scale.

    Raises:
        TrainingError: a parameter that is no number and differs between tasks.

    Example:
        >>> scaled = TaskParameters(dataset.train_tasks)(dataset.test_tasks)  # doctest: +SKIP
    """

    def __init__(self, training_tasks: Sequence[Task]) -> None:
        self._texts = texts(training_tasks[0].parameters)
        values = self._table(training_tasks)
        self._mean, std = values.mean(dim=0), values.std(dim=0, correction=0)
        self._scale = torch.where(std < SMALLEST_STD, torch.ones_like(std), std)

    def __call__(self, tasks: Sequence[Task]) -> Float[Tensor, "tasks parameters"]:
        """The parameters of some tasks, in units of the training tasks' standard deviations."""
        return ((self._table(tasks) - self._mean) / self._scale).float()

    def _table(self, tasks: Sequence[Task]) -> Tensor:
        for task in tasks:
            found = texts(task.parameters)
            if found != self._texts:
                differing = [value for value in found if value not in self._texts] or found
                raise TrainingError(
                    f"task {task.index} has the parameter {differing[0]!r}, which is no number and not "
                    "that of all tasks; choose a method that needs no task parameters"
                )
        return torch.tensor([numbers(task.parameters) for task in tasks], dtype=torch.float64)


def numbers(parameters: Any) -> list[float]:
    """The numbers of a JSON value, in the order of `leaves`."""
    return [float(leaf) for leaf in leaves(parameters) if isinstance(leaf, int | float)]


def texts(parameters: Any) -> list[Any]:
    """The leaves of a JSON value that are no numbers, in the order of `leaves`."""
    return [leaf for leaf in leaves(parameters) if not isinstance(leaf, int | float)]


def leaves(value: Any) -> Iterator[Any]:
    """The values within a JSON value, depth first; mappings by sorted key."""
    if isinstance(value, Mapping):
        value = [value[key] for key in sorted(value)]
    if isinstance(value, list | tuple):
        for item in value:
            yield from leaves(item)
    else:
        yield value
