"""`iql`: implicit Q-learning (Kostrikov, Nair & Levine, 2021), which never asks Q about an unseen action.

    L_V  = mean |expectile - 1(u < 0)| u^2,                u = min_k Q'_k(s, a, c) - V(s, c)
    L_Q  = sum_k mean (Q_k(s, a, c) - (r + gamma (1 - d) V(s', c)))^2
    L_pi = -mean min(exp(beta A), w_max) log pi(a | s, c),  A = u / std(u)

All actions are stored ones, and Q' follows Q by tau.

Deviations: advantages are divided by their standard deviation over the batch, so that one beta serves
environments of all reward scales; the three losses are descended in one step, where the published code takes
V's step first and computes the others with the new V; V(s') is held within what the data's rewards allow, if
`clip_targets` says so; learning rates are those of the run, where that code decays the policy's alone.
"""

import math
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from tcmrl_algo.algorithms.core.actor_critic.base import (
    LARGEST_Q,
    ActorCritic,
    ConditionedRows,
    divergence_limits,
    value_bounds,
)
from tcmrl_algo.algorithms.core.losses import Scalar, gaussian_log_likelihood, likelihood_loss, q_loss
from tcmrl_algo.algorithms.core.method import Metrics
from tcmrl_algo.algorithms.core.networks import (
    LikelihoodPolicy,
    Perceptron,
    PerceptronEnsemble,
    follow,
    momentum_copy,
)
from tcmrl_algo.algorithms.core.problem import Problem

SMALLEST_STD = 1e-6
"""Added to the standard deviation of advantages, so that equal advantages have weight 1."""


def expectile_loss(
    values: Float[Tensor, " rows"], targets: Float[Tensor, " rows"], *, expectile: float
) -> Scalar:
    """Mean |tau - 1(u < 0)| u^2 with u = min_k Q'_k(s, a, c) - V(s, c) (IQL, Kostrikov et al., 2021, eq. 5).

    Args:
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


@final
class ImplicitQLearning(ActorCritic):
    """Two Q with targets, V, and a policy that clones actions by their advantage."""

    def make_networks(self, problem: Problem, inputs: int, generator: torch.Generator) -> None:
        self.bounds, hidden = value_bounds(self.settings, problem), self.settings.hidden
        self.critics = PerceptronEnsemble(2, (inputs + problem.action_dim, *hidden), generator=generator)
        self.target_critics = momentum_copy(self.critics)
        self.value = Perceptron((inputs, *hidden, 1), generator=generator)
        self.policy = LikelihoodPolicy(inputs, problem.action_dim, hidden=hidden, generator=generator)

    def most_likely(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "rows action"]:
        return self.policy.most_likely(inputs)

    def losses(self, rows: ConditionedRows, generator: torch.Generator) -> tuple[Tensor, Metrics]:
        settings, iql = self.settings, self.settings.iql
        with torch.no_grad():
            next_values = self.value(rows.next_inputs).squeeze(-1)
            if settings.clip_targets:
                next_values = next_values.clamp(*self.bounds)
            stored_values = self.target_critics(torch.cat([rows.inputs, rows.actions], dim=-1)).amin(dim=0)
        q_values = self.critics(torch.cat([rows.critic_inputs, rows.actions], dim=-1))
        critic_loss = q_loss(q_values, rows.rewards, rows.terminated, next_values, gamma=settings.gamma)

        values = self.value(rows.inputs).squeeze(-1)
        state_value_loss = expectile_loss(values, stored_values, expectile=iql.expectile)

        advantages = stored_values - values.detach()
        weights = advantage_weights(
            advantages, inverse_temperature=iql.inverse_temperature, largest=iql.largest_weight
        )
        means, log_std = self.policy(rows.inputs)
        actor_loss = likelihood_loss(gaussian_log_likelihood(rows.actions, means, log_std), weights)

        metrics: Metrics = {
            "loss/critic": critic_loss,
            "loss/value": state_value_loss,
            "loss/policy": actor_loss,
            "actor_critic/q": q_values.mean(),
            LARGEST_Q: q_values.abs().amax(),
            "actor_critic/advantage_std": advantages.std(),
            "actor_critic/capped_weights": (weights >= iql.largest_weight).float().mean(),
            "actor_critic/policy_std": log_std.exp().mean(),
        }
        return critic_loss + state_value_loss + actor_loss, metrics

    def limits(self) -> dict[str, float]:
        return divergence_limits(self.settings, self.bounds)

    def after_step(self) -> None:
        """Moves Q's targets by tau towards Q."""
        follow(self.target_critics, self.critics, step=self.settings.tau)
