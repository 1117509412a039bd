"""What a method learns from (`Problem`), and what every method is (`Algorithm`)."""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict
from torch import Tensor, nn

from tcmrl_algo.networks.optimizer import Adam
from tcmrl_data import (
    NO_TASK,
    Batch,
    Controller,
    Environment,
    Moments,
    Purpose,
    Trajectory,
    UniformController,
    keyed_seed,
)

Metrics = dict[str, Tensor]
"""Scalars of one training step, by flat names such as `loss/reward`."""


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
        seed: the run's.
        steps: training steps over which schedules stretch.
        device: where networks live.
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
    steps: int
    device: torch.device

    def generator(self, step: int, stream: int = 0) -> torch.Generator:
        """The CPU generator of one training step (0: the networks' starts), a function of seed and step.

        Parts of a method draw from streams of their own, so that a switch in one changes no other's draws.
        """
        seed = keyed_seed(self.seed, self.environment, NO_TASK, Purpose.LEARNER, step, stream)
        return torch.Generator().manual_seed(seed)


class MomentsRecord(BaseModel):
    """`tcmrl_data.Moments` as JSON, kept with a run so that it is rebuilt without its data."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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

    @classmethod
    def of(cls, moments: Moments) -> "MomentsRecord":
        """The record of a sampler's statistics."""
        values = {name: getattr(moments, name) for name in cls.model_fields}
        return cls.model_validate(
            {name: each.tolist() if isinstance(each, np.ndarray) else each for name, each in values.items()}
        )


def problem_of(
    environment: Environment, moments: MomentsRecord, *, seed: int, steps: int, device: torch.device
) -> Problem:
    """The problem that an environment and the statistics of the selected data pose."""
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
        steps=steps,
        device=device,
    )


class Algorithm(abc.ABC):
    """A meta-learner: trained on batches, then adapted to a task by that task's trajectories.

    A method is one file in `tcmrl_algo/algorithms` with NAME, a frozen `Config` (its own table of a
    recipe's `[training]`), `batch_request(settings, config)`, what its batches hold, and
    `create(problem, settings, config) -> Algorithm`. Training, checkpoints and
    evaluation know no more of it than this class.
    """

    @abc.abstractmethod
    def update(self, batch: Batch, step: int) -> Metrics:
        """One training step, a function of the current tensors, the batch and the step's number (from 1)."""

    def limits(self) -> Mapping[str, float]:
        """Size beyond which a metric says that learning diverges, for some of them; training stops there."""
        return {}

    @abc.abstractmethod
    def adapt(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        """A controller without exploration; lane i is adapted to the task that `trajectories[i]` show."""

    def explore(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        """Acts in the first stage of the protocol `paper`; uniformly, unless a method collects otherwise.

        Args:
            trajectories: what lane i has collected so far; nothing at first.
        """
        return UniformController()

    @abc.abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """Everything that training changes: parameters, buffers, optimiser state, by name."""

    @abc.abstractmethod
    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `tensors` returned, for evaluation or for going on with training."""


@final
class TrainedModules:
    """Modules and their optimisers as one flat set of named tensors, for `Algorithm.tensors`."""

    def __init__(self, modules: Mapping[str, nn.Module], optimizers: Mapping[str, Adam]) -> None:
        self._modules, self._optimizers = modules, optimizers

    def tensors(self) -> dict[str, Tensor]:
        """Detached tensors, named `module/…` and `optimizer/…`."""
        found: dict[str, Any] = {}
        for name, module in self._modules.items():
            found.update({f"module/{name}/{key}": value for key, value in module.state_dict().items()})
        for name, optimizer in self._optimizers.items():
            found.update({f"optimizer/{name}/{key}": value for key, value in optimizer.tensors().items()})
        return {name: value.detach() for name, value in found.items()}

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `tensors` returned."""
        for name, module in self._modules.items():
            module.load_state_dict(_below(tensors, f"module/{name}/"))
        for name, optimizer in self._optimizers.items():
            optimizer.load_tensors(_below(tensors, f"optimizer/{name}/"))


def _below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): each for name, each in tensors.items() if name.startswith(prefix)}
