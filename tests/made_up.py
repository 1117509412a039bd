"""A made-up problem, its batches and trajectories: three tasks, observations of 3, actions of 2."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, Steps, Trajectory

TASKS, EPISODE = 3, 6


def problem(*, sparse: bool = False, seed: int = 0) -> Problem:
    return Problem(
        environment="made-up",
        observation_dim=3,
        action_dim=2,
        horizon=EPISODE,
        reward_density="sparse" if sparse else "dense",
        observation_mean=torch.zeros(3),
        observation_std=torch.ones(3),
        change_mean=torch.zeros(3),
        change_std=torch.full((3,), 0.5),
        action_mean=torch.zeros(2),
        action_std=torch.ones(2),
        reward_mean=0.0,
        reward_std=1.0,
        reward_range=(-2.0, 1.0),
        seed=seed,
        steps=100,
        device=torch.device("cpu"),
    )


def settings(**actor_critic: Any) -> TrainingSettings:
    return TrainingSettings.model_validate(
        {
            "batch": {"tasks": TASKS, "transitions": 5, "execution_trajectories": 1, "window_length": 2},
            "optimizer": {"learning_rate": 1e-2},
            "actor_critic": {"hidden": (8,), **actor_critic},
        }
    )


def steps(*shape: int, seed: int, lengths: tuple[int, ...] | None = None) -> Steps:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *more: torch.randn(*shape, *more, generator=generator)  # noqa: E731
    mask = torch.ones(shape, dtype=torch.bool)
    for task, length in enumerate(lengths or ()):
        mask[task, :, length:] = False
    return Steps(draw(3), draw(2).tanh(), draw(), draw(3), torch.zeros(shape), mask)


def batch(*, lengths: tuple[int, ...] | None = (6, 4, 5), trajectories: int = 2) -> Batch:
    return Batch(
        task_indices=torch.arange(TASKS),
        steps={
            "policy": steps(TASKS, 5, seed=1),
            "context": steps(TASKS, trajectories, EPISODE, seed=2, lengths=lengths),
            "execution": steps(TASKS, 1, EPISODE, seed=3, lengths=lengths),
        },
    )


def with_steps(plain: Batch, **steps: Steps) -> Batch:
    """The batch with other steps for some kinds."""
    return replace(plain, steps={**plain.steps, **steps})


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
