"""Readings of TCMRL's equations that are not the default; settings of `[training.tcmrl]` choose them.

`mask` is True on real transitions and False on padding, which never changes a value or a gradient.
"""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tcmrl_algo.algorithms.core.losses import Scalar, masked_mean
from tcmrl_algo.algorithms.core.networks import Attention, mean_representation


def uniform_attention(
    representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
) -> Attention:
    """What remains of Eq. 2-5 without an extractor: equal weights, and with them the mean of Eq. 2."""
    weights = mask / mask.sum(dim=1, keepdim=True)
    context = mean_representation(representations, mask)
    return Attention(representations, torch.zeros_like(weights), weights, context, mask)


def literal_sparsity_loss(weights: Float[Tensor, "lanes steps"], mask: Bool[Tensor, "lanes steps"]) -> Scalar:
    """Eq. 6 as printed: L_spa = ||(w_1, ..., w_T)||_1, averaged over lanes.

    Weights are non-negative and sum to 1, so the value is 1 and the gradient 0, whatever the scores are.
    """
    return torch.where(mask, weights, 0.0).abs().sum(dim=-1).mean()


def centered_sparsity_loss(scores: Float[Tensor, "lanes steps"], mask: Bool[Tensor, "lanes steps"]) -> Scalar:
    """Our reading of Eq. 6 that no bias satisfies: mean over transitions of sigmoid(score - mean score).

    The mean score is that of the lane's real transitions, so that a constant added to all scores changes this
    loss as little as it changes the softmax. The value is 1/2 where all scores are equal, and tends to the
    share of transitions above the mean, at best 1/T, as these are told apart from the others.
    """
    real = torch.where(mask, scores, 0.0)
    means = real.sum(dim=-1, keepdim=True) / mask.sum(dim=-1, keepdim=True).clamp(min=1)
    return masked_mean(torch.sigmoid(real - means), mask)


def entropy_sparsity_loss(scores: Float[Tensor, "lanes steps"], mask: Bool[Tensor, "lanes steps"]) -> Scalar:
    """Sparsity of the softmax weights themselves: L = -sum_t w_t log(w_t) / log(T), averaged over lanes.

    Not in the paper. w = softmax(score) over the lane's T real transitions (Eq. 4). The entropy is divided by
    its maximum, so that the value lies in [0, 1] for every T; a lane of one transition counts as 0.
    """
    logarithms = torch.log_softmax(torch.where(mask, scores, -torch.inf), dim=-1)
    logarithms = torch.where(mask, logarithms, 0.0)  # padding: 0 times minus infinity is NaN
    entropies = -torch.where(mask, logarithms.exp() * logarithms, 0.0).sum(dim=-1)
    return (entropies / mask.sum(dim=-1).clamp(min=2).log()).mean()


SPARSITY = {
    "literal": literal_sparsity_loss,
    "centered": centered_sparsity_loss,
    "entropy": entropy_sparsity_loss,
}
"""Readings of Eq. 6: of the weights, and of the scores."""


def extreme_rewards(
    rewards: Float[Tensor, "*lanes steps"], mask: Bool[Tensor, "*lanes steps"], *, kind: Literal["max", "min"]
) -> Float[Tensor, "*lanes steps"]:
    """Wrong targets for L_neg without noise: the trajectory's largest or smallest reward (Appendix G.3)."""
    padding, extreme = (-torch.inf, torch.amax) if kind == "max" else (torch.inf, torch.amin)
    return extreme(torch.where(mask, rewards, padding), -1, keepdim=True).expand_as(rewards)


def orthogonality_loss(weights: Float[Tensor, "lanes steps"]) -> Scalar:
    """Mean over pairs of tasks i != j of w_i . w_j: how far tasks attend to the same steps.

    Not in the paper; in its published code. Padding has weight 0.
    """
    overlap = weights @ weights.T
    return (overlap.sum() - overlap.diagonal().sum()) / max(len(weights) * (len(weights) - 1), 1)
