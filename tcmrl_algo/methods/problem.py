"""What a method learns from: sizes and statistics of the data, stages, tasks, and the seed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int64
from pydantic import BaseModel, ConfigDict
from torch import Tensor

from tcmrl_algo.methods.stages import StagePlan
from tcmrl_data import NO_TASK, Environment, Moments, Purpose, keyed_seed


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
        seed: the run's.
        stages: of training; schedules stretch over them.
        training_tasks: indices of the training tasks, ascending.
        privileged: (training tasks, parameters), standardised task parameters in the order of
            `training_tasks`; None for methods without that capability.
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
