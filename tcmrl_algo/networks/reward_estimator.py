"""The reward estimator of Eq. 7, 8, 17 and 18."""

from collections.abc import Sequence
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.networks.perceptron import Perceptron


@final
class RewardEstimator(nn.Module):
    """r_hat(s, a, c), the reward of a transition, or r_hat(s_1, a_1, ..., c), the return of a trajectory.

    Args:
        inputs: width of what is estimated on: a transition's state and action (Eq. 7 and 8), or those of a
            whole trajectory `side_by_side` (Eq. 17 and 18).
        latent: size of the context.
        hidden: widths of the layers.
        generator: draws the start.
    """

    def __init__(
        self, inputs: int, *, latent: int, hidden: Sequence[int], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.perceptron = Perceptron((inputs + latent, *hidden, 1), generator=generator)

    def forward(
        self, inputs: Float[Tensor, "tasks rows inputs"], context: Float[Tensor, "tasks latent"]
    ) -> Float[Tensor, "tasks rows"]:
        """One estimate per row, under its task's context."""
        spread = context.unsqueeze(1).expand(-1, inputs.shape[1], -1)
        values: Tensor = self.perceptron(torch.cat([inputs, spread], dim=-1))
        return values.squeeze(-1)


def side_by_side(
    steps: Float[Tensor, "tasks trajectories steps inputs"],
    mask: Bool[Tensor, "tasks trajectories steps"],
    *,
    horizon: int,
) -> Float[Tensor, "tasks trajectories all_inputs"]:
    """The steps of a trajectory as one vector; steps that an episode does not have are zeros."""
    real = torch.where(mask.unsqueeze(-1), steps, 0.0)
    return functional.pad(real, (0, 0, 0, horizon - steps.shape[2])).flatten(2)
