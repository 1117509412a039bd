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

LIKELIHOOD_LOG_STD = (-5.0, 2.0)
"""Bounds of the log standard deviation of `LikelihoodPolicy` (published code of IQL)."""


def held_between(free: Tensor, low: float, high: float) -> Tensor:
    """Values in [low, high] by softplus from either side: the identity between, never without a gradient."""
    below = high - functional.softplus(high - free)
    return low + functional.softplus(below - low)


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

    Log standard deviations are held in [log_std_min, log_std_max] by `held_between`.
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
        return mean, held_between(free, *self.log_std_range)

    def most_likely(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "rows action"]:
        """The squashed mean."""
        return torch.tanh(self(inputs)[0])

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


@final
class LikelihoodPolicy(nn.Module):
    """A Gaussian with diagonal covariance around tanh of a perceptron, for fitting stored actions.

    As in the published code of IQL, the mean is squashed and the distribution is not, so that the likelihood
    of a stored action at -1 or 1 is finite; and one standard deviation per action dimension, 1 at first,
    serves all states. Deviation: `held_between` bounds its logarithm in place of a hard clamp.
    """

    def __init__(
        self, inputs: int, action_dim: int, *, hidden: Sequence[int], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.perceptron = Perceptron((inputs, *hidden, action_dim), generator=generator)
        self.free_log_std = nn.Parameter(torch.zeros(action_dim))

    def forward(
        self, inputs: Float[Tensor, "rows inputs"]
    ) -> tuple[Float[Tensor, "rows action"], Float[Tensor, " action"]]:
        """The mean, in (-1, 1), and the log standard deviation."""
        return self.most_likely(inputs), held_between(self.free_log_std, *LIKELIHOOD_LOG_STD)

    def most_likely(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "rows action"]:
        """The mean."""
        return torch.tanh(self.perceptron(inputs))
