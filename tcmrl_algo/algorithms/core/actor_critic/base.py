"""What the actor-critics of context-based methods have in common."""

import abc
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tcmrl_algo.algorithms.core.method import FunctionController, Metrics
from tcmrl_algo.algorithms.core.networks import Standardizer
from tcmrl_algo.algorithms.core.optimizer import Adam
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import ActorCriticSettings
from tcmrl_data import Controller, Steps, TrainingError


@dataclass(frozen=True)
class ConditionedRows:
    """Transitions of all tasks in one flat batch; states are standardised and followed by their context.

    Attributes:
        inputs: states and contexts, without gradient.
        critic_inputs: the same for Q, whose gradient may reach the contexts; without Q, for the policy.
        next_inputs: next states and their contexts, without gradient.
        actions: in [-1, 1].
        rewards: scaled.
        terminated: 1 where the task ended the episode.
    """

    inputs: Float[Tensor, "rows inputs"]
    critic_inputs: Float[Tensor, "rows inputs"]
    next_inputs: Float[Tensor, "rows inputs"]
    actions: Float[Tensor, "rows action"]
    rewards: Float[Tensor, " rows"]
    terminated: Float[Tensor, " rows"]

    def where(self, real: Bool[Tensor, " all_rows"]) -> "ConditionedRows":
        """The rows at which `real` is True."""
        return ConditionedRows(*(getattr(self, field.name)[real] for field in fields(self)))


LARGEST_Q = "actor_critic/largest_q"


def value_bounds(settings: ActorCriticSettings, problem: Problem) -> tuple[float, float]:
    """Lowest and highest V that rewards within the data's range can add up to.

    The rewards are those that the actor-critic learns from, stored or dense ones.
    An episode may end after one step, or go on forever: time limits do not cut the sum. The highest V
    includes the largest entropy bonus of `sac`; the lowest leaves out what a narrow policy's entropy takes
    away.

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
    entropy = settings.entropy if settings.kind == "sac" else 0.0
    bonus = entropy * problem.action_dim * 0.6931471805599453  # ln 2: uniform in [-1, 1]
    return min(lowest, lowest * most_steps), max(highest + bonus, (highest + bonus) * most_steps)


def divergence_limits(settings: ActorCriticSettings, bounds: tuple[float, float]) -> dict[str, float]:
    """The |Q| that tells divergence; at least the factor itself, where rewards are next to nothing."""
    return {LARGEST_Q: settings.divergence_factor * max(1.0, *map(abs, bounds))}


class ActorCritic(nn.Module, abc.ABC):
    """A policy conditioned on a context, and what trains it; `make_actor_critic` picks the kind.

    Args:
        latent: size of the context; 0 makes everything blind to the task.
    """

    def __init__(
        self, settings: ActorCriticSettings, problem: Problem, *, latent: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.settings, self.latent, self.action_dim = settings, latent, problem.action_dim
        self.scaling = Standardizer(problem.observation_mean, problem.observation_std)
        self.make_networks(problem, problem.observation_dim + latent, generator)

    @abc.abstractmethod
    def make_networks(self, problem: Problem, inputs: int, generator: torch.Generator) -> None:
        """Makes everything that is trained; states and contexts side by side are `inputs` wide."""

    @abc.abstractmethod
    def most_likely(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "rows action"]:
        """The policy's most likely actions for states beside contexts."""

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
            critic_gradient: leaves the context in `critic_inputs` attached, so that Q's loss trains it, or
                that of a policy without critic; nothing else does.
        """
        contexts = [_by_row(context, steps)] * 2
        if next_context is not None:
            contexts[1] = _by_row(next_context, steps)
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

    @abc.abstractmethod
    def losses(self, rows: ConditionedRows, generator: torch.Generator) -> tuple[Tensor, Metrics]:
        """The sum of all losses and its parts; every part trains only its own network.

        Args:
            generator: draws the policy's actions, where a kind needs them.
        """

    def limits(self) -> dict[str, float]:
        """Size beyond which a metric says that learning diverges; none unless overridden."""
        return {}

    def optimizers(self) -> dict[str, Adam]:
        """Optimisers that this object steps itself, by name; none unless overridden."""
        return {}

    def train_dual(self, rows: ConditionedRows, generator: torch.Generator) -> None:
        """Trains what the losses need first, on the current policy; does nothing unless overridden."""

    def after_step(self) -> None:
        """Updates what no optimiser trains, such as target networks; does nothing unless overridden."""

    def act(
        self, observations: Float[Tensor, "lanes observation"], context: Float[Tensor, "lanes latent"]
    ) -> Float[Tensor, "lanes action"]:
        """The policy's most likely actions, without noise."""
        with torch.no_grad():
            return self.most_likely(torch.cat([self.scaling(observations), context], dim=-1))

    def controller(self, context: Float[Tensor, "lanes latent"]) -> Controller:
        """Acts by the policy's most likely actions under one fixed context per lane."""
        return FunctionController(lambda states: self.act(states, context), context.device)


def _by_row(context: Float[Tensor, "tasks *steps latent"], steps: Steps) -> Float[Tensor, "rows latent"]:
    """One context per row; a task's only one is repeated."""
    if context.ndim == 2:
        context = context.unsqueeze(1).expand(-1, steps.mask[0].numel(), -1)
    return context.flatten(0, -2)
