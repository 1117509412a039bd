"""The offline actor-critic under every context-based method: two Q, V with a target, a Gaussian policy."""

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tcmrl_algo.actor_critic.brac import DualCritic
from tcmrl_algo.actor_critic.rows import ConditionedRows
from tcmrl_algo.losses.actor_critic import cloning_loss, policy_loss, q_loss, value_loss
from tcmrl_algo.methods.base import Metrics
from tcmrl_algo.methods.network_algorithm import FunctionController
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.networks.momentum import follow, momentum_copy
from tcmrl_algo.networks.optimizer import Adam
from tcmrl_algo.networks.perceptron import Perceptron, PerceptronEnsemble, Standardizer, call_frozen
from tcmrl_algo.networks.policy import PolicyActions, PolicyNetwork
from tcmrl_algo.settings.actor_critic import ActorCriticSettings
from tcmrl_data import Controller, Steps, TrainingError

LARGEST_Q = "actor_critic/largest_q"


def value_bounds(settings: ActorCriticSettings, problem: Problem) -> tuple[float, float]:
    """Lowest and highest V that rewards within the data's range can add up to.

    The rewards are those that the actor-critic learns from, stored or dense ones.
    An episode may end after one step, or go on forever: time limits do not cut the sum. The highest V
    includes the largest entropy bonus; the lowest leaves out what a narrow policy's entropy takes away.

    Raises:
        TrainingError: dense rewards, of which the batches hold none.
    """
    rewards = problem.reward_range if settings.rewards == "stored" else problem.dense_reward_range
    if rewards is None:
        raise TrainingError(
            "actor_critic.rewards is 'dense', but the method's batches hold stored rewards only; "
            "let its batch_request take policy_transitions(settings)"
        )
    lowest, highest = (settings.reward_scale * reward for reward in rewards)
    most_steps = 1.0 / (1.0 - settings.gamma)
    bonus = settings.entropy * problem.action_dim * 0.6931471805599453  # ln 2: uniform in [-1, 1]
    return min(lowest, lowest * most_steps), max(highest + bonus, (highest + bonus) * most_steps)


@final
class ActorCritic(nn.Module):
    """Critics and policy conditioned on a context, which the critics alone may train, where asked.

    Args:
        settings: the resolved table.
        problem: sizes and moments of the data.
        latent: size of the context; 0 makes everything blind to the task.
        generator: draws the starts.
    """

    def __init__(
        self, settings: ActorCriticSettings, problem: Problem, *, latent: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.settings, self.latent, self.action_dim = settings, latent, problem.action_dim
        self.bounds = value_bounds(settings, problem)
        self.scaling = Standardizer(problem.observation_mean, problem.observation_std)
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

    def rows(
        self,
        steps: Steps,
        context: Float[Tensor, "tasks *steps latent"],
        next_context: Float[Tensor, "tasks *steps latent"] | None = None,
        *,
        critic_gradient: bool = False,
    ) -> ConditionedRows:
        """Flattens the steps of all tasks and puts the context of a step beside it.

        Args:
            steps: transitions (tasks, n), or trajectories (tasks, n, steps), whose padding is left out.
            context: (tasks, latent), or one of every step.
            next_context: of the next observations; `context` if left out.
            critic_gradient: leaves Q's context attached, so that Q's loss trains it; nothing else does.
        """
        following = context if next_context is None else next_context
        contexts = [_by_row(value, steps) for value in (context, following)]
        states = torch.stack([steps.observations, steps.next_observations]).flatten(1, -2)
        detached = torch.stack([value.detach() for value in contexts])
        inputs = torch.cat([self.scaling(states), detached], dim=-1)
        critic_inputs = inputs[0]
        if critic_gradient:
            critic_inputs = torch.cat([inputs[0, :, : states.shape[-1]], contexts[0]], dim=-1)
        rows = ConditionedRows(
            inputs[0],
            critic_inputs,
            inputs[1],
            steps.actions.flatten(0, -2),
            steps.rewards.flatten() * self.settings.reward_scale,
            steps.terminated.flatten(),
        )
        return rows.where(steps.mask.flatten()) if steps.mask.ndim > 2 else rows

    def losses(self, rows: ConditionedRows, generator: torch.Generator) -> tuple[Tensor, Metrics]:
        """The sum of all losses and its parts; every part trains only its own network.

        Args:
            rows: transitions with their contexts.
            generator: draws the policy's actions.
        """
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
        """The |Q| that tells divergence; at least the factor itself, where rewards are next to nothing."""
        return {LARGEST_Q: self.settings.divergence_factor * max(1.0, *map(abs, self.bounds))}

    def optimizers(self) -> dict[str, Adam]:
        """Optimisers that this object steps itself, by name."""
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

    def act(
        self, observations: Float[Tensor, "lanes observation"], context: Float[Tensor, "lanes latent"]
    ) -> Float[Tensor, "lanes action"]:
        """The policy's most likely actions, without noise."""
        with torch.no_grad():
            mean, _ = self.policy(torch.cat([self.scaling(observations), context], dim=-1))
            return torch.tanh(mean)

    def controller(self, context: Float[Tensor, "lanes latent"]) -> Controller:
        """Acts by the policy's most likely actions under one fixed context per lane."""
        return FunctionController(lambda states: self.act(states, context), context.device)


def _by_row(context: Float[Tensor, "tasks *steps latent"], steps: Steps) -> Float[Tensor, "rows latent"]:
    """One context per row; a task's only one is repeated."""
    if context.ndim == 2:
        context = context.unsqueeze(1).expand(-1, steps.mask[0].numel(), -1)
    return context.flatten(0, -2)
