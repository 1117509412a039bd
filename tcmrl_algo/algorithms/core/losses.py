"""Equations of two or more methods as pure functions: tensors in, a scalar out.

`mask` is True on real entries and False on padding; padding never changes a value or a gradient.
"""

import functools
import math
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Scalar = Float[Tensor, ""]


def where_real(mask: Bool[Tensor, "*rows"], values: Tensor, padding: float) -> Tensor:
    """The values where the mask is True, and `padding` elsewhere; the values as they are without padding.

    Most batches hold none, and a mask in vain takes as long as an equation. A GPU is not asked: it would have
    to be waited for.
    """
    if mask.device.type == "cpu" and bool(mask.all()):
        return values
    return torch.where(mask, values, padding)


def masked_mean(values: Float[Tensor, "*shape"], mask: Bool[Tensor, "*shape"]) -> Scalar:
    """Mean of the values where the mask is True; 0 where it is nowhere True."""
    real = where_real(mask, values, 0.0)
    return real.sum() / (mask.numel() if real is values else mask.sum().clamp(min=1))


def info_nce(
    queries: Float[Tensor, "*positions tasks latent"],
    keys: Float[Tensor, "*positions tasks latent"],
    mask: Bool[Tensor, "*positions tasks"],
    *,
    temperature: float = 1.0,
) -> Scalar:
    """Eq. 10: -log(exp(q_i . k_i / tau) / sum_l exp(q_i . k_l / tau)), mean over queries that have a rival.

    All tasks' queries at one position meet all tasks' keys there in one matrix product, whose diagonal
    holds the matching pairs (the trace of Eq. 12).

    Args:
        queries: z^q of every task at every position.
        keys: z^k of every task at every position; the one of the same task matches.
        mask: which tasks exist at a position. The others are in no denominator there.
    """
    # contiguous, mask included: otherwise products fall back to one small product per position
    queries, keys, mask = queries.contiguous(), keys.contiguous(), mask.contiguous()
    logits = queries @ keys.mT
    if temperature != 1.0:
        logits = logits / temperature
    present = mask & (mask.sum(dim=-1, keepdim=True) > 1)  # a lone task has nothing to be told apart from
    known = mask.unsqueeze(-2) & present.unsqueeze(-1)
    if known.device.type != "cpu" or not bool(known.all()):
        nowhere = torch.where(present, -torch.inf, 0.0)  # 0 keeps rows without any key free of NaN
        logits = torch.where(known, logits, nowhere.unsqueeze(-1))
    matching = torch.diagonal(torch.log_softmax(logits, dim=-1), dim1=-2, dim2=-1).contiguous()
    return -masked_mean(matching, present)


def distance_metric_loss(
    contexts: Float[Tensor, "tasks examples latent"],
    *,
    epsilon: float = 0.1,
    attraction: Literal["square", "root"] = "square",
) -> Scalar:
    """FOCAL's distance-metric loss (Li et al., 2021), inverse square: gathers each task's contexts.

    L = mean over pairs of one task of d^2 + mean over pairs of two tasks of 1 / (d^2 + epsilon), with
    d^2 = |c_i - c_j|^2 / latent. Attraction by d^2 is FOCAL's paper; the published codes of FOCAL and of
    TCMRL, whose paper has no such loss, attract by sqrt(d^2 + 0.001), which near contexts feel more.

    Args:
        epsilon: bounds the repulsion (published code: 0.1).
    """
    flat = contexts.flatten(0, 1)
    squares = (flat.unsqueeze(0) - flat.unsqueeze(1)).square().mean(dim=-1)
    distances = squares if attraction == "square" else (squares + 1e-3).sqrt()
    same, others, num_same, num_others = _pairs(*contexts.shape[:2], flat.device)
    attracted = torch.where(same, distances, 0.0).sum() / num_same
    return attracted + torch.where(others, 1.0 / (squares + epsilon), 0.0).sum() / num_others


@functools.lru_cache(maxsize=64)
def _pairs(tasks: int, examples: int, device: torch.device) -> tuple[Tensor, Tensor, int, int]:
    """Which two different examples are of one task, which are of two, and how many either; at least 1."""
    task = torch.arange(tasks, device=device).repeat_interleave(examples)
    same = task.unsqueeze(0) == task.unsqueeze(1)
    others = ~same
    same = same & ~torch.eye(len(task), dtype=torch.bool, device=device)
    return same, others, max(int(same.sum()), 1), max(int(others.sum()), 1)


def gaussian_divergence(
    mean: Float[Tensor, "*rows latent"],
    variance: Float[Tensor, "*rows latent"],
    other_mean: Float[Tensor, "*rows latent"],
    other_variance: Float[Tensor, "*rows latent"],
) -> Float[Tensor, "*rows"]:
    """KL( N(mu, sigma^2) || N(mu', sigma'^2) ), summed over dimensions.

    Of one dimension: (sigma^2 / sigma'^2 + (mu - mu')^2 / sigma'^2 - 1 - log(sigma^2 / sigma'^2)) / 2.
    """
    ratio = variance / other_variance
    return 0.5 * (ratio + (mean - other_mean).square() / other_variance - 1.0 - ratio.log()).sum(dim=-1)


def q_loss(
    q_values: Float[Tensor, "members rows"],
    rewards: Float[Tensor, " rows"],
    terminated: Float[Tensor, " rows"],
    next_values: Float[Tensor, " rows"],
    *,
    gamma: float,
) -> Scalar:
    """Temporal-difference error: sum over critics of mean (Q(s, a, c) - (r + gamma (1 - d) V(s', c)))^2.

    Args:
        q_values: Q of each critic for the stored actions.
        terminated: d, 1 where the task ended the episode; a time limit is 0.
        next_values: V(s', c) of the target network; no gradient reaches it.
    """
    targets = (rewards + gamma * (1.0 - terminated) * next_values).detach()
    return (q_values - targets).square().mean(dim=-1).sum()


def gaussian_log_likelihood(
    actions: Float[Tensor, "rows action"],
    means: Float[Tensor, "rows action"],
    log_std: Float[Tensor, " action"],
) -> Float[Tensor, " rows"]:
    """Log density of N(mu, sigma^2): sum of -(a - mu)^2 / (2 sigma^2) - log sigma - log(2 pi) / 2.

    No correction for a squashing: the density is that of actions themselves (published code of IQL), so that
    actions at -1 and 1, whose inverse tanh is infinite, have a finite likelihood.
    """
    terms = -0.5 * ((actions - means) / log_std.exp()).square() - log_std - 0.5 * math.log(2 * math.pi)
    return terms.sum(dim=-1)


def likelihood_loss(log_likelihoods: Float[Tensor, " rows"], weights: Float[Tensor, " rows"]) -> Scalar:
    """Mean of -w log pi(a | s, c) (IQL, equation 7); with weights of 1, behavior cloning."""
    return -(weights.detach() * log_likelihoods).mean()
