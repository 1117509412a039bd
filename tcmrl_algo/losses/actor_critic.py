"""Losses of the offline actor-critic as pure functions: tensors in, a scalar or one value per row out.

Q(s, a, c), V(s, c) and pi(a|s, c) are conditioned on a context c; rows are transitions of all tasks.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tcmrl_algo.losses.advantage_regression import SMALLEST_STD

Scalar = Float[Tensor, ""]


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
        rewards: scaled rewards.
        terminated: d, 1 where the task ended the episode; a time limit is 0.
        next_values: V(s', c) of the target network; no gradient reaches it.
        gamma: discount factor.
    """
    targets = (rewards + gamma * (1.0 - terminated) * next_values).detach()
    return (q_values - targets).square().mean(dim=-1).sum()


def value_loss(values: Float[Tensor, " rows"], targets: Float[Tensor, " rows"]) -> Scalar:
    """Mean (V(s, c) - [min_k Q_k(s, a~pi, c) - alpha log pi(a|s, c)])^2; no gradient reaches the targets."""
    return functional.mse_loss(values, targets.detach())


def policy_loss(
    log_probabilities: Float[Tensor, " rows"],
    q_values: Float[Tensor, " rows"],
    *,
    entropy: float,
) -> Scalar:
    """Mean of alpha log pi(a|s, c) - min_k Q_k(s, a, c) over a ~ pi, reparameterised."""
    return (entropy * log_probabilities - q_values).mean()


def cloning_loss(
    acted: Float[Tensor, "rows action"],
    actions: Float[Tensor, "rows action"],
    q_values: Float[Tensor, " rows"],
) -> Scalar:
    """The mean of |Q| times the mean squared difference of the policy's and the stored actions.

    TD3+BC (Fujimoto & Gu, 2021, equations 3 and 4) divides Q by mean |Q| instead and multiplies it by 2.5: a
    weight of 1 / 2.5 = 0.4 here, up to the scale of the whole loss. No gradient reaches mean |Q|.
    """
    return q_values.detach().abs().mean() * functional.mse_loss(acted, actions)


def dual_divergence(
    behavior: Float[Tensor, " rows"], policy: Float[Tensor, " rows"]
) -> Float[Tensor, " rows"]:
    """BRAC's dual estimate of KL(pi || behavior) at each state: log softplus(c_p) - softplus(c_b) + 1.

    Args:
        behavior: dual critic at stored actions, c_b.
        policy: dual critic at the policy's actions, c_p. softplus(c) estimates pi / behavior.
    """
    ratio = functional.softplus(policy).clamp(min=1e-12)  # log of an underflowed ratio would be -inf
    return torch.log(ratio) - functional.softplus(behavior) + 1.0


def gradient_penalty(gradients: Float[Tensor, "rows inputs"]) -> Scalar:
    """Mean of max(|grad c| - 1, 0)^2 over points between behavior and policy actions.

    Deviation: the published code penalises the critic's output; this is the gradient's norm.
    """
    norms = (gradients.square().sum(dim=-1) + 1e-12).sqrt()
    return functional.relu(norms - 1.0).square().mean()


def expectile_loss(
    values: Float[Tensor, " rows"], targets: Float[Tensor, " rows"], *, expectile: float
) -> Scalar:
    """Mean |tau - 1(u < 0)| u^2 with u = min_k Q'_k(s, a, c) - V(s, c) (IQL, Kostrikov et al., 2021, eq. 5).

    Args:
        values: V(s, c).
        targets: min Q' of the stored actions; no gradient reaches them.
        expectile: tau; 1/2 gives half the squared error, more weighs targets above V more.
    """
    differences = targets.detach() - values
    weights = torch.where(differences < 0, 1.0 - expectile, expectile)
    return (weights * differences.square()).mean()


def advantage_weights(
    advantages: Float[Tensor, " rows"], *, inverse_temperature: float, largest: float
) -> Float[Tensor, " rows"]:
    """How much stored actions weigh: w = min(exp(beta A / std A), largest) (IQL, equation 7).

    Deviation: the paper's advantages A = min_k Q'_k - V are in units of the reward; here they are divided by
    their unbiased standard deviation over the rows. They are not centered. No gradient reaches them.
    """
    advantages = advantages.detach()
    scaled = inverse_temperature * advantages / (advantages.std() + SMALLEST_STD)
    return scaled.clamp(max=math.log(largest)).exp()


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
