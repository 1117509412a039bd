"""Perceptrons whose output is a Gaussian with diagonal covariance."""

from collections.abc import Sequence
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.networks.perceptron import Perceptron

LOG_VARIANCE_START = (-10.0, 0.5)
"""Bounds of the log variance before training (Chua et al., 2018, in the implementation of mbrl-lib)."""


@final
class GaussianPerceptron(nn.Module):
    """Mean and log variance, the latter held between learnt bounds by softplus from either side.

    Args:
        sizes: width of input, hidden layers and output.
        generator: draws the start.
    """

    def __init__(self, sizes: Sequence[int], *, generator: torch.Generator) -> None:
        super().__init__()
        *first, outputs = sizes
        self.perceptron = Perceptron((*first, 2 * outputs), generator=generator)
        low, high = LOG_VARIANCE_START
        self.lowest = nn.Parameter(torch.full((outputs,), low))
        self.highest = nn.Parameter(torch.full((outputs,), high))

    def forward(
        self, inputs: Float[Tensor, "*rows inputs"]
    ) -> tuple[Float[Tensor, "*rows outputs"], Float[Tensor, "*rows outputs"]]:
        mean, free = self.perceptron(inputs).chunk(2, dim=-1)
        below = self.highest - functional.softplus(self.highest - free)
        return mean, self.lowest + functional.softplus(below - self.lowest)

    def width(self) -> Float[Tensor, ""]:
        """The sum over outputs of the distance between the bounds; a loss that keeps them close."""
        return (self.highest - self.lowest).sum()
