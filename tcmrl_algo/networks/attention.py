"""Eq. 2-5: how the transitions of a task weigh in its context."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tcmrl_algo.networks.perceptron import Perceptron


def mean_representation(
    representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
) -> Float[Tensor, "lanes latent"]:
    """Eq. 2: c_mean = mean(c_1, ..., c_T) over each lane's real steps; FOCAL's context."""
    real = mask.unsqueeze(-1)
    return torch.where(real, representations, 0.0).sum(dim=1) / real.sum(dim=1)


@dataclass(frozen=True)
class Attention:
    """The extractor's output for the transitions of every lane.

    Attributes:
        representations: (lanes, steps, latent), c_t.
        scores: (lanes, steps), Eq. 3.
        weights: (lanes, steps), Eq. 4; 0 on padding, sums to 1.
        context: (lanes, latent), Eq. 5.
        mask: (lanes, steps) bool, real transitions.
    """

    representations: Float[Tensor, "lanes steps latent"]
    scores: Float[Tensor, "lanes steps"]
    weights: Float[Tensor, "lanes steps"]
    context: Float[Tensor, "lanes latent"]
    mask: Bool[Tensor, "lanes steps"]


@final
class TaskExtractor(nn.Module):
    """The task characteristic extractor, Eq. 2-5: scores transitions against their mean and aggregates them.

    Args:
        latent: size of a representation.
        hidden: widths of q's sigmoid layers (paper, F.2: 256); empty makes q linear, as in the code.
        generator: draws the start.
    """

    def __init__(self, latent: int, *, hidden: Sequence[int], generator: torch.Generator) -> None:
        super().__init__()
        self.perceptron = Perceptron((2 * latent, *hidden, 1), generator=generator, activation=torch.sigmoid_)

    def forward(
        self, representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
    ) -> Attention:
        """Attention over each lane's real transitions, of which there must be at least one.

        c_mean = mean(c_1, ..., c_T); score_t = q(c_t, c_mean); w = softmax(score); c = sum_t w_t c_t.
        """
        mean = mean_representation(representations, mask).unsqueeze(1)
        inputs = torch.cat([representations, mean.expand_as(representations)], dim=-1)
        scores = self.perceptron(inputs).squeeze(-1)
        weights = torch.softmax(torch.where(mask, scores, -torch.inf), dim=-1)
        context = torch.einsum("lt,ltd->ld", weights, torch.where(mask.unsqueeze(-1), representations, 0.0))
        return Attention(representations, scores, weights, context, mask)


def uniform_attention(
    representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
) -> Attention:
    """What remains of Eq. 2-5 without an extractor: equal weights, and with them the mean of Eq. 2."""
    weights = mask / mask.sum(dim=1, keepdim=True)
    context = mean_representation(representations, mask)
    return Attention(representations, torch.zeros_like(weights), weights, context, mask)
