"""`bc`: behavior cloning conditioned on a context, the floor that every other kind should exceed.

    L_pi = -mean log pi(a | s, c)

The filter on returns is the run's: `run.snapshots = "return>=0.75"` clones, of every task, the quarter of its
snapshots with the highest mean return, and `last` the last ones, while `run.context_snapshots` chooses what
contexts come from. Returns of single rows would be no better filter: a transition's return to go depends on
its place in the episode, and the episodes of a snapshot differ by noise for the most part.

There is no critic. Where a method lets the critics train its contexts (CORRO, PEARL), the likelihood trains
them here: a deviation from those methods, without which nothing would.
"""

from typing import final

import torch
from torch import Tensor

from tcmrl_algo.actor_critic.actor_critic import ActorCritic
from tcmrl_algo.actor_critic.rows import ConditionedRows
from tcmrl_algo.losses.actor_critic import gaussian_log_likelihood, likelihood_loss
from tcmrl_algo.methods.base import Metrics
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.networks.policy import LikelihoodPolicy
from tcmrl_algo.settings.actor_critic import ActorCriticSettings


@final
class BehaviorCloning(ActorCritic):
    """A policy alone.

    Args:
        settings: the resolved table.
        problem: sizes and moments of the data.
        latent: size of the context.
        generator: draws the start.
    """

    policy: LikelihoodPolicy

    def __init__(
        self, settings: ActorCriticSettings, problem: Problem, *, latent: int, generator: torch.Generator
    ) -> None:
        super().__init__(settings, problem, latent=latent)
        inputs = problem.observation_dim + latent
        self.policy = LikelihoodPolicy(
            inputs, problem.action_dim, hidden=settings.hidden, generator=generator
        )

    def losses(self, rows: ConditionedRows, generator: torch.Generator) -> tuple[Tensor, Metrics]:
        """The negative log-likelihood; it trains the contexts in place of Q's loss, where that is asked."""
        means, log_std = self.policy(rows.critic_inputs)
        likelihoods = gaussian_log_likelihood(rows.actions, means, log_std)
        loss = likelihood_loss(likelihoods, torch.ones_like(likelihoods))
        return loss, {"loss/policy": loss, "actor_critic/policy_std": log_std.exp().mean()}
