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

from typing import final

import torch
from torch import Tensor

from tcmrl_algo.actor_critic.actor_critic import LARGEST_Q, ActorCritic, divergence_limits, value_bounds
from tcmrl_algo.actor_critic.rows import ConditionedRows
from tcmrl_algo.losses.actor_critic import (
    advantage_weights,
    expectile_loss,
    gaussian_log_likelihood,
    likelihood_loss,
    q_loss,
)
from tcmrl_algo.methods.base import Metrics
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.networks.momentum import follow, momentum_copy
from tcmrl_algo.networks.perceptron import Perceptron, PerceptronEnsemble
from tcmrl_algo.networks.policy import LikelihoodPolicy
from tcmrl_algo.settings.actor_critic import ActorCriticSettings


@final
class ImplicitQLearning(ActorCritic):
    """Two Q with targets, V, and a policy that clones actions by their advantage.

    Args:
        settings: the resolved table.
        problem: sizes and moments of the data.
        latent: size of the context.
        generator: draws the starts.
    """

    policy: LikelihoodPolicy

    def __init__(
        self, settings: ActorCriticSettings, problem: Problem, *, latent: int, generator: torch.Generator
    ) -> None:
        super().__init__(settings, problem, latent=latent)
        self.bounds = value_bounds(settings, problem)
        inputs, hidden = problem.observation_dim + latent, settings.hidden
        self.critics = PerceptronEnsemble(2, (inputs + problem.action_dim, *hidden), generator=generator)
        self.target_critics = momentum_copy(self.critics)
        self.value = Perceptron((inputs, *hidden, 1), generator=generator)
        self.policy = LikelihoodPolicy(inputs, problem.action_dim, hidden=hidden, generator=generator)

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
