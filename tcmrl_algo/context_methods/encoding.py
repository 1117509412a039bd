"""Eq. 1: transitions into representations, standardised once and encoded in one pass."""

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.networks.perceptron import Perceptron, Standardizer
from tcmrl_data import Steps


@dataclass(frozen=True)
class EncoderInputs:
    """Standardised transitions of trajectories, or of windows.

    Attributes:
        inputs: (tasks, trajectories, steps, inputs): s_t, a_t, r_t, s_{t+1} - s_t side by side.
        mask: (tasks, trajectories, steps) bool, real transitions.
        state_action: width of s_t and a_t, with which the inputs begin.
    """

    inputs: Float[Tensor, "tasks trajectories steps inputs"]
    mask: Bool[Tensor, "tasks trajectories steps"]
    state_action: int

    @property
    def state_actions(self) -> Float[Tensor, "tasks trajectories steps inputs"]:
        """s_t and a_t."""
        return self.inputs[..., : self.state_action]

    @property
    def outcomes(self) -> Float[Tensor, "tasks trajectories steps outcomes"]:
        """r_t and s_{t+1} - s_t."""
        return self.inputs[..., self.state_action :]

    def first(self, number: int) -> "EncoderInputs":
        """The first trajectories of every task."""
        return EncoderInputs(self.inputs[:, :number], self.mask[:, :number], self.state_action)

    @property
    def rewards(self) -> Float[Tensor, "tasks trajectories steps"]:
        """r_t."""
        return self.inputs[..., self.state_action]


def transition_scaling(problem: Problem) -> Standardizer:
    """Standardises s_t, a_t, r_t and s_{t+1} - s_t, side by side, by the moments of the data."""
    parts = (
        (problem.observation_mean, problem.observation_std),
        (problem.action_mean, problem.action_std),
        (torch.tensor([problem.reward_mean]), torch.tensor([problem.reward_std])),
        (problem.change_mean, problem.change_std),
    )
    mean, std = (torch.cat(vectors) for vectors in zip(*parts, strict=True))
    return Standardizer(mean, std)


def read_steps(steps: Steps, scaling: Standardizer) -> EncoderInputs:
    """The steps in units of the data's standard deviations.

    Args:
        steps: (tasks, trajectories, steps).
        scaling: of `transition_scaling`.
    """
    changes = steps.next_observations - steps.observations
    inputs = torch.cat([steps.observations, steps.actions, steps.rewards.unsqueeze(-1), changes], dim=-1)
    state_action = steps.observations.shape[-1] + steps.actions.shape[-1]
    return EncoderInputs(scaling(inputs), steps.mask, state_action)


@final
class ContextEncoder(nn.Module):
    """Eq. 1: c_t = e(s_t, a_t, r_t, s_{t+1}), in [-1, 1] per latent dimension.

    Deviation: the encoder reads s_{t+1} - s_t in place of s_{t+1}; the two carry the same information,
    and the difference keeps its scale where states move little in one step.

    Args:
        problem: sizes and moments of the data.
        latent: size of a representation.
        hidden: widths of the layers.
        generator: draws the start.
    """

    def __init__(
        self, problem: Problem, *, latent: int, hidden: tuple[int, ...], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.state_action = problem.observation_dim + problem.action_dim
        self.scaling = transition_scaling(problem)
        self.perceptron = Perceptron((len(self.scaling.mean), *hidden, latent), generator=generator)

    def read(self, steps: Steps) -> EncoderInputs:
        """The steps in units of the data's standard deviations."""
        return read_steps(steps, self.scaling)

    def forward(self, *groups: EncoderInputs) -> tuple[Float[Tensor, "..."], ...]:
        """Representations of every group, (tasks, trajectories, steps, latent), by one forward pass."""
        return tuple(torch.tanh(part) for part in self.unbounded(*groups))

    def unbounded(self, *groups: EncoderInputs) -> tuple[Float[Tensor, "..."], ...]:
        """What `forward` squashes into [-1, 1]."""
        rows = torch.cat([group.inputs.flatten(0, 2) for group in groups])
        parts = self.perceptron(rows).split([group.mask.numel() for group in groups])
        return tuple(part.unflatten(0, group.mask.shape) for part, group in zip(parts, groups, strict=True))
