"""Gaussians with diagonal covariance, as pure functions."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

SMALLEST_VARIANCE = 1e-7
"""Of a factor of a product, whose precision would be infinite below (published code of PEARL)."""


def product_of_gaussians(
    means: Float[Tensor, "lanes steps latent"],
    variances: Float[Tensor, "lanes steps latent"],
    mask: Bool[Tensor, "lanes steps"],
) -> tuple[Float[Tensor, "lanes latent"], Float[Tensor, "lanes latent"]]:
    """Mean and variance of prod_t N(mu_t, sigma_t^2), up to its scale (PEARL, Rakelly et al., 2019).

    sigma^2 = 1 / sum_t 1 / sigma_t^2, mu = sigma^2 sum_t mu_t / sigma_t^2. Padding has precision 0; without a
    real step the result is the prior N(0, I), which is no factor otherwise.
    """
    precisions = torch.where(mask.unsqueeze(-1), 1.0 / variances.clamp(min=SMALLEST_VARIANCE), 0.0)
    some = mask.any(dim=1, keepdim=True)
    precision = torch.where(some, precisions.sum(dim=1), 1.0)
    weighted = torch.where(mask.unsqueeze(-1), means * precisions, 0.0)
    return weighted.sum(dim=1) / precision, 1.0 / precision


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
