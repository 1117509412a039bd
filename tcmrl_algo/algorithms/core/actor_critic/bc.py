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
from jaxtyping import Float
from torch import Tensor

from tcmrl_algo.algorithms.core.actor_critic.base import ActorCritic, ConditionedRows
from tcmrl_algo.algorithms.core.losses import gaussian_log_likelihood, likelihood_loss
from tcmrl_algo.algorithms.core.method import Metrics
from tcmrl_algo.algorithms.core.networks import LikelihoodPolicy
from tcmrl_algo.algorithms.core.problem import Problem


@final
class BehaviorCloning(ActorCritic):
    """A policy alone."""

    def make_networks(self, problem: Problem, inputs: int, generator: torch.Generator) -> None:
        self.policy = LikelihoodPolicy(
            inputs, problem.action_dim, hidden=self.settings.hidden, generator=generator
        )

    def most_likely(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "rows action"]:
        return self.policy.most_likely(inputs)

    def losses(self, rows: ConditionedRows, generator: torch.Generator) -> tuple[Tensor, Metrics]:
        """The negative log-likelihood; it trains the contexts in place of Q's loss, where that is asked."""
        means, log_std = self.policy(rows.critic_inputs)
        likelihoods = gaussian_log_likelihood(rows.actions, means, log_std)
        loss = likelihood_loss(likelihoods, torch.ones_like(likelihoods))
        return loss, {"loss/policy": loss, "actor_critic/policy_std": log_std.exp().mean()}
