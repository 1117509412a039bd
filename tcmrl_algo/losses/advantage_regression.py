"""Advantage-weighted regression on Monte-Carlo returns, as pure functions: the losses of MACAW.

`mask` is True on real transitions and False on padding, which never changes a value or a gradient.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tcmrl_algo.losses.context import Scalar, masked_mean

SMALLEST_STD = 1e-6
"""Added to the standard deviation of advantages, so that equal advantages have weight 1."""


def return_regression(
    values: Float[Tensor, "*rows"], targets: Float[Tensor, "*rows"], mask: Bool[Tensor, "*rows"]
) -> Scalar:
    """Mean of (V(s) - G)^2 (MACAW, Mitchell et al., 2021)."""
    return masked_mean((values - targets).square(), mask)


def bootstrapped_return(
    returns: Float[Tensor, "*rows"], discounts: Float[Tensor, "*rows"], final_values: Float[Tensor, "*rows"]
) -> Float[Tensor, "*rows"]:
    """G_t + gamma^(T - t) V(s_T): the return to go, where a time limit is no end (MACAW).

    Args:
        returns: G_t, the sum over k < T - t of gamma^k r_{t+k}.
        discounts: gamma^(T - t), 0 where the task ended the episode.
        final_values: V(s_T).
    """
    return returns + discounts * final_values


def advantage_weights(
    advantages: Float[Tensor, "*lanes rows"],
    mask: Bool[Tensor, "*lanes rows"],
    *,
    temperature: float,
    largest: float,
) -> Float[Tensor, "*lanes rows"]:
    """How much actions weigh: w = min(exp(A' / temperature), largest) (MACAW).

    A' = (A - mean A) / std A over the rows of a lane, with the unbiased standard deviation. Deviation: the
    published code divides 0 by 0 where all advantages are equal; here their weights are 1.
    """
    real = torch.where(mask, advantages, 0.0)
    number = mask.sum(dim=-1, keepdim=True)
    centered = torch.where(mask, real - real.sum(dim=-1, keepdim=True) / number.clamp(min=1), 0.0)
    variance = centered.square().sum(dim=-1, keepdim=True) / (number - 1).clamp(min=1)
    normalized = centered / (variance.sqrt() + SMALLEST_STD)
    return (normalized / temperature).clamp(max=math.log(largest)).exp()


def gaussian_log_likelihood(
    actions: Float[Tensor, "*rows action"], means: Float[Tensor, "*rows action"], *, std: float
) -> Float[Tensor, "*rows"]:
    """Log density of N(mu, std^2): the sum of -(a - mu)^2 / (2 std^2) - log std - log(2 pi) / 2."""
    terms = -0.5 * ((actions - means) / std).square() - math.log(std) - 0.5 * math.log(2 * math.pi)
    return terms.sum(dim=-1)


def weighted_likelihood(
    log_likelihoods: Float[Tensor, "*rows"], weights: Float[Tensor, "*rows"], mask: Bool[Tensor, "*rows"]
) -> Scalar:
    """Mean of -w log pi(a | s) (advantage-weighted regression, Peng et al., 2019)."""
    return masked_mean(-weights * log_likelihoods, mask)
