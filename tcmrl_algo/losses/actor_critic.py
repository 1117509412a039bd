"""Losses of the offline actor-critic as pure functions: tensors in, a scalar or one value per row out.

Q(s, a, c), V(s, c) and pi(a|s, c) are conditioned on a context c; rows are transitions of all tasks.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

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
