"""Bounds of what a representation z knows, as pure functions: CLUB of CSRO, likelihoods of UNICORN.

`mask` is True on real transitions and False on padding, which never changes a value or a gradient. Means are
over real transitions and over dimensions.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional

from tcmrl_algo.losses.context import Scalar, masked_mean


def club_likelihood(
    representations: Float[Tensor, "tasks steps latent"],
    mean: Float[Tensor, "tasks steps latent"],
    variance: Float[Tensor, "tasks steps latent"],
    mask: Bool[Tensor, "tasks steps"],
) -> Scalar:
    """Mean of (z - mu)^2 / (2 sigma^2) + log(sigma^2) / 2: what trains q(z | s, a) (CSRO, Gao et al., 2023).

    The constant of the Gaussian is left out.
    """
    terms = 0.5 * ((representations - mean).square() / variance + variance.log())
    return masked_mean(terms.mean(dim=-1), mask)


def club_penalty(
    representations: Float[Tensor, "tasks steps latent"],
    mean: Float[Tensor, "tasks steps latent"],
    variance: Float[Tensor, "tasks steps latent"],
    mask: Bool[Tensor, "tasks steps"],
) -> Scalar:
    """CSRO's bound of I(z; s, a): P - N, P = -mean_t (z_t - mu_t)^2 / sigma_t^2, N = the same over all pairs.

    N = -mean_ij (z_j - mu_i)^2 / sigma_i^2 over pairs of one task, i = j included. The published code expands
    all pairs; here mean_j (z_j - mu_i)^2 = Var_j(z_j) + (mean_j z_j - mu_i)^2, with the biased variance.
    As in that code there is no 1/2 and a mean over dimensions: the value is 2 / latent times CLUB's estimate
    (Cheng et al., 2020).

    Args:
        representations: z_t.
        mean, variance: of q(z | s_t, a_t); hand them over without gradient.
        mask: real transitions.
    """
    real = mask.unsqueeze(-1)
    number = real.sum(dim=1, keepdim=True).clamp(min=1)
    center = torch.where(real, representations, 0.0).sum(dim=1, keepdim=True) / number
    spread = torch.where(real, (representations - center).square(), 0.0).sum(dim=1, keepdim=True) / number
    pairs = spread + (center - mean).square()
    return masked_mean(((pairs - (representations - mean).square()) / variance).mean(dim=-1), mask)


def gaussian_reconstruction(
    mean: Float[Tensor, "*rows outputs"],
    log_variance: Float[Tensor, "*rows outputs"],
    targets: Float[Tensor, "*rows outputs"],
    mask: Bool[Tensor, "*rows"],
) -> Scalar:
    """Mean of (x - mu)^2 exp(-log sigma^2) + log sigma^2: twice a Gaussian's -log p(x), without the constant.

    UNICORN's L_recon (Li et al., 2024), whose negative bounds I(z; s', r | s, a) from below up to a constant.
    """
    terms = (targets - mean).square() * (-log_variance).exp() + log_variance
    return masked_mean(terms.mean(dim=-1), mask)


def task_classification(logits: Float[Tensor, "tasks classes"], positions: Int64[Tensor, " tasks"]) -> Scalar:
    """Cross-entropy of the training task, -mean log p(task | z): UNICORN-SUP (Li et al., 2024).

    Args:
        logits: of every training task, for every context.
        positions: dense index of the task that a context comes from.
    """
    return functional.cross_entropy(logits, positions)
