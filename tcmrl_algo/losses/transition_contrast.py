"""Contrast between transitions that share state and action, and the model that makes such ones, for CORRO."""

import torch
from jaxtyping import Float
from torch import Tensor

from tcmrl_algo.losses.context import Scalar


def relabelled_contrastive_loss(
    queries: Float[Tensor, "rows latent"],
    keys: Float[Tensor, "rows latent"],
    negatives: Float[Tensor, "rows negatives latent"],
    *,
    temperature: float,
) -> Scalar:
    """CORRO (Yuan and Lu, 2022): mean of -log( e(q.k) / (e(q.k) + sum_n e(q.n)) ), e(x) = exp(x / tau).

    InfoNCE whose negatives belong to one query alone, where `info_nce` takes the keys of all others. Without
    a negative the loss is 0.

    Args:
        queries: representations of transitions.
        keys: of other transitions of the same task.
        negatives: of the queries' states and actions with the outcomes of another task.
        temperature: tau.
    """
    matching = torch.einsum("rd,rd->r", queries, keys).unsqueeze(-1)
    others = torch.einsum("rd,rnd->rn", queries, negatives)
    logits = torch.cat([matching, others], dim=-1) / temperature
    return -torch.log_softmax(logits, dim=-1)[:, 0].mean()


def outcome_error(
    predicted: Float[Tensor, "rows outcomes"], outcomes: Float[Tensor, "rows outcomes"]
) -> Scalar:
    """CORRO's reconstruction: mean (r_hat - r)^2 + mean over dimensions of (s'_hat - s')^2, mean over rows.

    Deviation: the published code compares raw rewards and states, so that their units decide how much either
    counts; hand over standardised rewards and changes of state.

    Args:
        predicted: r_hat, then s'_hat, as `outcomes`.
        outcomes: r, then s', or s' - s.
    """
    errors = (predicted - outcomes).square()
    return errors[:, :1].mean() + errors[:, 1:].mean()
