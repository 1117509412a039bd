"""Losses of a belief that is filtered along a trajectory, as pure functions: the two terms of BOReL's ELBO.

`mask` is True on real steps, which come first in every lane, and False on padding, which never changes a
value or a gradient. A lane of T steps has T + 1 beliefs: the prior b_0, and b_t after step t.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from tcmrl_algo.losses.context import Scalar
from tcmrl_algo.losses.gaussians import gaussian_divergence


def belief_divergence(
    means: Float[Tensor, "lanes beliefs latent"],
    log_variances: Float[Tensor, "lanes beliefs latent"],
    mask: Bool[Tensor, "lanes steps"],
) -> Scalar:
    """Sum over t of KL(b_t || b_{t-1}), with b_{-1} = N(0, I), averaged over lanes (BOReL, VariBAD).

    The gradient reaches both beliefs of a pair.

    Args:
        means, log_variances: of b_0, ..., b_T; one belief more than steps.
        mask: real steps; b_0 counts in every lane.
    """
    before = [functional.pad(values[:, :-1], (0, 0, 1, 0)) for values in (means, log_variances)]
    divergences = gaussian_divergence(means, log_variances.exp(), before[0], before[1].exp())
    return torch.where(belief_mask(mask), divergences, 0.0).sum(dim=1).mean()


def belief_mask(mask: Bool[Tensor, "lanes steps"]) -> Bool[Tensor, "lanes beliefs"]:
    """Which beliefs are real: b_0, and those after real steps."""
    return functional.pad(mask, (1, 0), value=True)


def belief_reconstruction(
    predicted: Float[Tensor, "lanes draws steps outputs"],
    targets: Float[Tensor, "lanes steps outputs"],
    mask: Bool[Tensor, "lanes steps"],
    *,
    over_steps: bool,
) -> Scalar:
    """Sum over t of the errors of what z_t ~ b_t predicts of all steps of its lane, averaged over lanes.

    The sum over the T + 1 beliefs is estimated by T + 1 times the mean over draws of t. Errors are squared
    and summed over outputs; over steps, published code of BOReL takes their mean, while the paper sums.

    Args:
        predicted: for every draw of t and z_t, past and future steps alike.
        targets: what was observed.
        mask: real steps.
        over_steps: sum errors over steps instead of taking their mean.
    """
    errors = (predicted - targets.unsqueeze(1)).square().sum(dim=-1)
    sums = torch.where(mask.unsqueeze(1), errors, 0.0).sum(dim=-1).mean(dim=1)
    numbers = mask.sum(dim=-1)
    shares = sums if over_steps else sums / numbers.clamp(min=1)
    return ((numbers + 1) * shares).mean()
