"""A synthetic problem, its batches and trajectories: three tasks, observations of 3, actions of 2."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.problem import Problem, Stage, StagePlan
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps, Trajectories, Trajectory, Transitions, Windows

TASKS, EPISODE = 3, 6
OBSERVATION_DIM, ACTION_DIM = 3, 2
TRAINING_TASKS = (2, 5, 9)
ONE_STAGE = StagePlan((Stage("train", 100, BatchRequest(TASKS, {"policy": Transitions(5)})),), steps=100)


def problem(
    *, sparse: bool = False, seed: int = 0, stages: StagePlan = ONE_STAGE, privileged: bool = False
) -> Problem:
    return Problem(
        environment="made-up",
        observation_dim=OBSERVATION_DIM,
        action_dim=ACTION_DIM,
        horizon=EPISODE,
        reward_density="sparse" if sparse else "dense",
        observation_mean=torch.zeros(OBSERVATION_DIM),
        observation_std=torch.ones(OBSERVATION_DIM),
        change_mean=torch.zeros(OBSERVATION_DIM),
        change_std=torch.full((OBSERVATION_DIM,), 0.5),
        action_mean=torch.zeros(ACTION_DIM),
        action_std=torch.ones(ACTION_DIM),
        reward_mean=0.0,
        reward_std=1.0,
        reward_range=(-2.0, 1.0),
        seed=seed,
        stages=stages,
        training_tasks=TRAINING_TASKS,
        privileged=torch.tensor([[-1.0, 0.5], [0.0, -1.0], [1.0, 0.5]]) if privileged else None,
        device=torch.device("cpu"),
    )


def settings(*, steps: int = 100, **actor_critic: Any) -> TrainingSettings:
    return TrainingSettings.model_validate(
        {
            "run": {"steps": steps},
            "batch": {"tasks": TASKS, "transitions": 5, "execution_trajectories": 1, "window_length": 2},
            "optimizer": {"learning_rate": 1e-2},
            "actor_critic": {"hidden": (8,), **actor_critic},
        }
    )


def steps(*shape: int, seed: int, lengths: tuple[int, ...] | None = None, returns: bool = False) -> Steps:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *more: torch.randn(*shape, *more, generator=generator)  # noqa: E731
    mask = torch.ones(shape, dtype=torch.bool)
    for task, length in enumerate(lengths or ()):
        mask[task, :, length:] = False
    drawn = Steps(draw(3), draw(2).tanh(), draw(), draw(3), torch.zeros(shape), mask)
    if not returns:
        return drawn
    return replace(
        drawn,
        returns_to_go=draw() * mask,
        discounts_to_end=draw().sigmoid() * mask,
        final_observations=draw(3) * mask.unsqueeze(-1),
        times=torch.zeros(shape, dtype=torch.int64),
    )


def batch(*, lengths: tuple[int, ...] | None = (6, 4, 5), trajectories: int = 2) -> Batch:
    kinds = {
        "policy": steps(TASKS, 5, seed=1),
        "context": steps(TASKS, trajectories, EPISODE, seed=2, lengths=lengths),
        "execution": steps(TASKS, 1, EPISODE, seed=3, lengths=lengths),
    }
    return Batch(torch.tensor(TRAINING_TASKS), kinds)


def batch_for(request: BatchRequest, *, seed: int) -> Batch:
    """A batch as a sampler makes it for a request; episodes end early."""
    kinds = {}
    for place, (name, kind) in enumerate(request.kinds.items()):
        shape: tuple[int, ...] = (TASKS, kind.number)
        if isinstance(kind, Trajectories):
            shape += (EPISODE,)
        elif isinstance(kind, Windows):
            shape += (kind.length,)
        lengths = (6, 4, 5) if isinstance(kind, Trajectories) else None
        kinds[name] = steps(*shape, seed=100 * seed + place, lengths=lengths, returns=kind.returns)
    return Batch(torch.tensor(TRAINING_TASKS), kinds)


def with_steps(plain: Batch, **changed: Steps) -> Batch:
    """The batch with the steps of some kinds replaced."""
    return replace(plain, steps={**plain.steps, **changed})


def trajectory(length: int, seed: int) -> Trajectory:
    random = np.random.default_rng(seed)
    ended = np.zeros(length, dtype=bool)
    return Trajectory(
        random.normal(size=(length + 1, 3)).astype(np.float32),
        random.uniform(-1, 1, (length, 2)).astype(np.float32),
        random.normal(size=length).astype(np.float32),
        ended,
        ended,
    )


def scramble(values: Steps) -> Steps:
    """The same real steps with other padding."""

    def other(value: Tensor) -> Tensor:
        mask = values.mask.reshape(values.mask.shape + (1,) * (value.ndim - values.mask.ndim))
        return torch.where(mask, value, value + 3.0)

    names = ("observations", "actions", "rewards", "next_observations")
    return replace(values, **{name: other(getattr(values, name)) for name in names})


def random(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal numbers in double precision, for gradient checks."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()
