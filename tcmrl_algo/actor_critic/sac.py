"""`sac`: two Q, V with a target, and a squashed Gaussian policy that climbs Q, as in the published codes.

BRAC and cloning are options that hold the policy near the data.
"""

from typing import final

import torch
from torch import Tensor

from tcmrl_algo.actor_critic.actor_critic import LARGEST_Q, ActorCritic, divergence_limits, value_bounds
from tcmrl_algo.actor_critic.brac import DualCritic
from tcmrl_algo.actor_critic.rows import ConditionedRows
from tcmrl_algo.losses.actor_critic import cloning_loss, policy_loss, q_loss, value_loss
from tcmrl_algo.methods.base import Metrics
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.networks.momentum import follow, momentum_copy
from tcmrl_algo.networks.optimizer import Adam
from tcmrl_algo.networks.perceptron import Perceptron, PerceptronEnsemble, call_frozen
from tcmrl_algo.networks.policy import PolicyActions, PolicyNetwork
from tcmrl_algo.settings.actor_critic import ActorCriticSettings


@final
class SoftActorCritic(ActorCritic):
    """Critics and policy conditioned on a context, which the critics alone may train, where asked.

    Args:
        settings: the resolved table.
        problem: sizes and moments of the data.
        latent: size of the context; 0 makes everything blind to the task.
        generator: draws the starts.
    """

    policy: PolicyNetwork

    def __init__(
        self, settings: ActorCriticSettings, problem: Problem, *, latent: int, generator: torch.Generator
    ) -> None:
        super().__init__(settings, problem, latent=latent)
        self.bounds = value_bounds(settings, problem)
        inputs, hidden = problem.observation_dim + latent, settings.hidden
        with_action = (inputs + problem.action_dim, *hidden)
        self.critics = PerceptronEnsemble(2, with_action, generator=generator)
        self.value = Perceptron((inputs, *hidden, 1), generator=generator)
        self.target_value = momentum_copy(self.value)
        self.policy = PolicyNetwork(
            inputs,
            problem.action_dim,
            hidden=hidden,
            log_std_range=settings.log_std_range,
            generator=generator,
        )
        self.brac: DualCritic | None = None
        if settings.brac.mode != "off":
            self.brac = DualCritic(settings.brac, with_action, generator=generator)

    def losses(self, rows: ConditionedRows, generator: torch.Generator) -> tuple[Tensor, Metrics]:
        settings = self.settings
        with torch.no_grad():
            next_values = self.target_value(rows.next_inputs).squeeze(-1)
            if settings.clip_targets:
                low, high = self.bounds  # a penalised V may lie below what rewards alone add up to
                next_values = next_values.clamp(None if settings.brac.mode == "value" else low, high)
        q_values = self.critics(torch.cat([rows.critic_inputs, rows.actions], dim=-1))
        critic_loss = q_loss(q_values, rows.rewards, rows.terminated, next_values, gamma=settings.gamma)

        noise = torch.randn(rows.actions.shape, generator=generator).to(rows.actions.device)
        sample = self.policy.sample(rows.inputs, noise)
        acted = torch.cat([rows.inputs, sample.actions], dim=-1)
        acted_values = call_frozen(self.critics, acted).amin(dim=0)
        targets = acted_values - settings.entropy * sample.log_probabilities
        actor_loss = policy_loss(sample.log_probabilities, acted_values, entropy=settings.entropy)
        if settings.cloning > 0:
            actor_loss = actor_loss + settings.cloning * cloning_loss(
                sample.actions, rows.actions, acted_values
            )
        metrics: Metrics = {}
        if self.brac is not None:
            divergences = self.brac.divergences(rows, acted)
            actor_loss = actor_loss + self.brac.alpha * divergences.mean()
            if settings.brac.mode == "value":
                targets = targets - self.brac.alpha * divergences
            metrics = {
                "actor_critic/divergence": divergences.mean(),
                "actor_critic/brac_alpha": self.brac.alpha.clone(),
            }
        values = self.value(rows.inputs).squeeze(-1)
        state_value_loss = value_loss(values, targets)
        total = critic_loss + state_value_loss + actor_loss + self._regularization(sample)
        metrics |= {
            "loss/critic": critic_loss,
            "loss/value": state_value_loss,
            "loss/policy": actor_loss,
            "actor_critic/q": q_values.mean(),
            LARGEST_Q: q_values.abs().amax(),
            "actor_critic/policy_std": sample.log_std.exp().mean(),
        }
        return total, metrics

    def _regularization(self, sample: PolicyActions) -> Tensor:
        return (
            self.settings.mean_regularization * sample.mean.square().mean()
            + self.settings.std_regularization * sample.log_std.square().mean()
        )

    def limits(self) -> dict[str, float]:
        return divergence_limits(self.settings, self.bounds)

    def optimizers(self) -> dict[str, Adam]:
        return {} if self.brac is None else {"dual": self.brac.optimizer}

    def train_dual(self, rows: ConditionedRows, generator: torch.Generator) -> None:
        """Trains BRAC's dual critic, where there is one, on the current policy; call before `losses`."""
        if self.brac is None:
            return
        for _ in range(self.settings.brac.steps):
            noise = torch.randn(rows.actions.shape, generator=generator).to(rows.actions.device)
            with torch.no_grad():
                actions = self.policy.sample(rows.inputs, noise).actions
            mixture = torch.rand(len(actions), 1, generator=generator).to(actions.device)
            self.brac.train_once(rows, actions, mixture)

    def after_step(self) -> None:
        """Moves V's target by tau towards V, and BRAC's alpha by one step of dual descent."""
        follow(self.target_value, self.value, step=self.settings.tau)
        if self.brac is not None:
            self.brac.adapt_alpha()
