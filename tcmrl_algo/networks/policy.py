"""The policy network: a Gaussian squashed into the range of actions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.networks.perceptron import Perceptron


@dataclass(frozen=True)
class PolicyActions:
    """Actions drawn from the policy.

    Attributes:
        actions: (rows, action_dim) in (-1, 1).
        log_probabilities: (rows,), of the squashed actions.
        mean: (rows, action_dim), before squashing.
        log_std: (rows, action_dim), before squashing.
    """

    actions: Float[Tensor, "rows action"]
    log_probabilities: Float[Tensor, " rows"]
    mean: Float[Tensor, "rows action"]
    log_std: Float[Tensor, "rows action"]


@final
class PolicyNetwork(nn.Module):
    """A Gaussian with diagonal covariance, squashed by tanh.

    Log standard deviations are held in [log_std_min, log_std_max] by softplus from either side, which is
    the identity between and, unlike a hard clamp, never loses its gradient.
    """

    def __init__(
        self,
        inputs: int,
        action_dim: int,
        *,
        hidden: Sequence[int],
        log_std_range: tuple[float, float],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.log_std_range = log_std_range
        self.perceptron = Perceptron((inputs, *hidden, 2 * action_dim), generator=generator)

    def forward(
        self, inputs: Float[Tensor, "rows inputs"]
    ) -> tuple[Float[Tensor, "rows action"], Float[Tensor, "rows action"]]:
        """Mean and log standard deviation before squashing."""
        mean, free = self.perceptron(inputs).chunk(2, dim=-1)
        low, high = self.log_std_range
        below = high - functional.softplus(high - free)
        return mean, low + functional.softplus(below - low)

    def sample(
        self, inputs: Float[Tensor, "rows inputs"], noise: Float[Tensor, "rows action"]
    ) -> PolicyActions:
        """Reparameterised actions from standard normal noise.

        log pi(a) = sum over dimensions of log N(u) - log(1 - tanh(u)^2), the latter as
        2 (log 2 - u - softplus(-2u)), which is exact for large |u|.
        """
        mean, log_std = self(inputs)
        free = mean + log_std.exp() * noise
        normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        squash = 2.0 * (math.log(2.0) - free - functional.softplus(-2.0 * free))
        return PolicyActions(torch.tanh(free), (normal - squash).sum(dim=-1), mean, log_std)
