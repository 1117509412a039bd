"""Losses of contexts as pure functions: tensors in, a scalar out, one function per equation of the paper.

The paper is "TCMRL", whose equation numbers are quoted. `mask` is True on real entries and False on padding;
padding never changes a value or a gradient. Wherever the paper sums over time, these functions take the mean
over real entries, so that loss weights mean the same for short and long episodes.
"""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

Scalar = Float[Tensor, ""]
NegativeKind = Literal["random", "max", "min"]


def masked_mean(values: Float[Tensor, "*shape"], mask: Bool[Tensor, "*shape"]) -> Scalar:
    """Mean of the values where the mask is True; 0 where it is nowhere True."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def sparsity_loss(scores: Float[Tensor, "lanes steps"], mask: Bool[Tensor, "lanes steps"]) -> Scalar:
    """Our reading of Eq. 6: mean over transitions of sigmoid(score).

    Deviation: the printed form is constant (see `literal_sparsity_loss`). Scores before the softmax are
    free to fall for all but the telling transitions. They may also fall for all transitions together, which
    lowers this loss and changes no weight; `centered_sparsity_loss` and `entropy_sparsity_loss` rule that
    out.
    """
    return masked_mean(torch.sigmoid(scores), mask)


def centered_sparsity_loss(scores: Float[Tensor, "lanes steps"], mask: Bool[Tensor, "lanes steps"]) -> Scalar:
    """Our reading of Eq. 6 that no bias satisfies: mean over transitions of sigmoid(score - mean score).

    The mean score is that of the lane's real transitions, so that a constant added to all scores changes this
    loss as little as it changes the softmax. The value is 1/2 where all scores are equal, and tends to the
    share of transitions above the mean, at best 1/T, as these are told apart from the others.
    """
    real = torch.where(mask, scores, 0.0)
    means = real.sum(dim=-1, keepdim=True) / mask.sum(dim=-1, keepdim=True).clamp(min=1)
    return sparsity_loss(real - means, mask)


def entropy_sparsity_loss(scores: Float[Tensor, "lanes steps"], mask: Bool[Tensor, "lanes steps"]) -> Scalar:
    """Sparsity of the softmax weights themselves: L = -sum_t w_t log(w_t) / log(T), averaged over lanes.

    Not in the paper. w = softmax(score) over the lane's T real transitions (Eq. 4). The entropy is divided by
    its maximum, so that the value lies in [0, 1] for every T; a lane of one transition counts as 0.
    """
    logarithms = torch.log_softmax(torch.where(mask, scores, -torch.inf), dim=-1)
    logarithms = torch.where(mask, logarithms, 0.0)  # padding: 0 times minus infinity is NaN
    entropies = -torch.where(mask, logarithms.exp() * logarithms, 0.0).sum(dim=-1)
    return (entropies / mask.sum(dim=-1).clamp(min=2).log()).mean()


def literal_sparsity_loss(weights: Float[Tensor, "lanes steps"], mask: Bool[Tensor, "lanes steps"]) -> Scalar:
    """Eq. 6 as printed: L_spa = ||(w_1, ..., w_T)||_1, averaged over lanes.

    Weights are non-negative and sum to 1, so the value is 1 and the gradient 0, whatever the scores are.
    """
    return torch.where(mask, weights, 0.0).abs().sum(dim=-1).mean()


def reverse_context(
    representations: Float[Tensor, "lanes steps latent"],
    weights: Float[Tensor, "lanes steps"],
    mask: Bool[Tensor, "lanes steps"],
    *,
    literal: bool = False,
) -> Float[Tensor, "lanes latent"]:
    """The context of what attention neglects: c_neg = sum_t (1 - w_t) c_t / (T - 1) (text above Eq. 8).

    With the mean representation c_mean (Eq. 2) and the context c = sum_t w_t c_t (Eq. 5),
    c_neg = (T c_mean - c) / (T - 1) = c_mean + (c_mean - c) / (T - 1): nearly the mean context for all but
    the shortest lanes, whatever the attention is. Undivided, it points the same way and is T - 1 times
    as long, which is outside of what the reward estimator sees of contexts in L_pos.

    Args:
        representations: c_t.
        weights: attention weights w_t, which sum to 1 over each lane's real steps.
        mask: real steps; T is their number, lane by lane.
        literal: leave the sum undivided, as printed. Its weights sum to T - 1, so its scale grows with T.
    """
    reverse = torch.where(mask, 1.0 - weights, 0.0)
    if not literal:
        reverse = reverse / (mask.sum(dim=-1, keepdim=True) - 1).clamp(min=1)
    return torch.einsum("lt,ltd->ld", reverse, representations)


def negative_rewards(
    rewards: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
    *,
    kind: NegativeKind,
    noise: Float[Tensor, "*lanes steps"],
) -> Float[Tensor, "*lanes steps"]:
    """Wrong targets for L_neg: r' + noise, or the trajectory's largest or smallest reward (Appendix G.3).

    Noise of mean zero makes no target wrong on average (see `negative_reward_loss`); noise of another mean,
    `max` and `min` do.

    Args:
        rewards: r'_t of execution trajectories.
        mask: real steps.
        kind: `random` adds `noise`; `max` and `min` repeat the trajectory's extreme reward.
        noise: draws of the noise distribution; used by `random` alone.
    """
    if kind == "random":
        return rewards + noise
    if kind == "max":
        return torch.where(mask, rewards, -torch.inf).amax(-1, keepdim=True).expand_as(rewards)
    return torch.where(mask, rewards, torch.inf).amin(-1, keepdim=True).expand_as(rewards)


def positive_reward_loss(
    predicted: Float[Tensor, "*lanes steps"],
    rewards: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
) -> Scalar:
    """Eq. 7: L_pos = sum_t (r_hat(s'_t, a'_t, c) - r'_t)^2, as a mean over real steps."""
    return masked_mean((predicted - rewards) ** 2, mask)


def negative_reward_loss(
    predicted: Float[Tensor, "*lanes steps"],
    negative: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
) -> Scalar:
    """Eq. 8: L_neg = sum_t (r_hat(s'_t, a'_t, c_neg) - r_neg_t)^2, as a mean over real steps.

    `predicted` must come from an estimator whose parameters are held fixed: the paper keeps L_neg from
    training it (`networks.call_frozen` does that).

    With r_neg = r' + e and noise e of mean zero and variance v that is independent of r_hat,
    E (r_hat - r' - e)^2 = (r_hat - r')^2 + v: the expected loss is that of the true reward plus a constant,
    and so the expected gradient trains c_neg, too, to predict the true reward. The noise adds variance alone.
    With noise of mean b the expected gradient is that of fitting r' + b.
    """
    return masked_mean((predicted - negative) ** 2, mask)


def positive_return_loss(
    predicted: Float[Tensor, "*lanes"],
    rewards: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
) -> Scalar:
    """Eq. 17 (sparse rewards): L_pos = (r_hat(s'_1, a'_1, ..., s'_T, a'_T, c) - sum_t r'_t)^2, lane mean."""
    return ((predicted - torch.where(mask, rewards, 0.0).sum(dim=-1)) ** 2).mean()


def negative_return_loss(
    predicted: Float[Tensor, "*lanes"],
    negative: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
) -> Scalar:
    """Eq. 18 (sparse rewards): L_neg = (r_hat(..., c_neg) - sum_t r_neg_t)^2, lane mean.

    As for Eq. 8, the estimator behind `predicted` must be held fixed.
    """
    return ((predicted - torch.where(mask, negative, 0.0).sum(dim=-1)) ** 2).mean()


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
        temperature: tau.
    """
    # contiguous, mask included: otherwise products fall back to one small product per position
    queries, keys, mask = queries.contiguous(), keys.contiguous(), mask.contiguous()
    logits = queries @ keys.mT / temperature
    logits = torch.where(mask.unsqueeze(-2), logits, -torch.inf)
    present = mask & (mask.sum(dim=-1, keepdim=True) > 1)  # a lone task has nothing to be told apart from
    logits = torch.where(present.unsqueeze(-1), logits, 0.0)  # keeps rows without any key free of NaN
    matching = torch.diagonal(torch.log_softmax(logits, dim=-1), dim1=-2, dim2=-1)
    return -masked_mean(matching, present)


def task_contrastive_loss(
    representations: Float[Tensor, "tasks trajectories steps latent"],
    mask: Bool[Tensor, "tasks trajectories steps"],
    similarity: Float[Tensor, "latent latent"],
    *,
    window_length: int,
    temperature: float = 1.0,
) -> Scalar:
    """Eq. 11-12: L_TCL = -1/(T-K+1) 1/B sum_t sum_i log softmax_l(m_i^t W c_l^{t+K-1})[i].

    m^t is the mean of the K - 1 representations before the window's last one. Deviations: the printed
    log(a / sum a) is undefined for negative a, so Eq. 10's exponentials stand in; and a query keeps its own
    m_i in the denominator, as in Eq. 10, where Eq. 11 prints m_l. Of tasks that end early, position t knows
    only those with a whole window there.

    Args:
        representations: c_t of the n-th trajectory of every task; windows at equal (n, t) are compared.
        mask: real steps, padding at the end.
        similarity: W.
        window_length: K > 1. Trajectories shorter than K have no window.
        temperature: divides the logits (not in the paper's Eq. 11; 1 there).
    """
    if representations.shape[2] < window_length:
        return (representations * 0.0).sum() + (similarity * 0.0).sum()
    last = window_length - 1
    flat = representations[:, :, :-1].flatten(0, 1).transpose(1, 2)  # every step but the last begins a prior
    priors = functional.avg_pool1d(flat, last, stride=1).transpose(1, 2)
    return info_nce(
        (priors @ similarity).unflatten(0, representations.shape[:2]).permute(1, 2, 0, 3),
        representations[:, :, last:].permute(1, 2, 0, 3),
        mask[:, :, last:].permute(1, 2, 0),  # padding is at the end: the last step being real suffices
        temperature=temperature,
    )


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
        contexts: several contexts of every task.
        epsilon: bounds the repulsion (published code: 0.1).
        attraction: `square`, d^2, or `root`, sqrt(d^2 + 0.001).
    """
    flat = contexts.flatten(0, 1)
    squares = (flat.unsqueeze(0) - flat.unsqueeze(1)).square().mean(dim=-1)
    tasks = torch.arange(len(contexts), device=flat.device).repeat_interleave(contexts.shape[1])
    same = tasks.unsqueeze(0) == tasks.unsqueeze(1)
    pairs = ~torch.eye(len(tasks), dtype=torch.bool, device=flat.device)
    distances = squares if attraction == "square" else (squares + 1e-3).sqrt()
    return masked_mean(distances, same & pairs) + masked_mean(1.0 / (squares + epsilon), ~same)


def orthogonality_loss(weights: Float[Tensor, "lanes steps"]) -> Scalar:
    """Mean over pairs of tasks i != j of w_i . w_j: how far tasks attend to the same steps.

    Not in the paper; in its published code. Padding has weight 0.
    """
    overlap = weights @ weights.T
    return (overlap.sum() - overlap.diagonal().sum()) / max(len(weights) * (len(weights) - 1), 1)
