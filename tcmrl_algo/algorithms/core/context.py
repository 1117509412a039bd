"""Methods that adapt through a context: trajectories in, a vector out, a policy conditioned on it."""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, final, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tcmrl_algo.algorithms.core.actor_critic.base import ActorCritic
from tcmrl_algo.algorithms.core.actor_critic.bc import BehaviorCloning
from tcmrl_algo.algorithms.core.actor_critic.iql import ImplicitQLearning
from tcmrl_algo.algorithms.core.actor_critic.sac import SoftActorCritic
from tcmrl_algo.algorithms.core.method import Algorithm, Metrics
from tcmrl_algo.algorithms.core.networks import Attention, Perceptron, Standardizer, set_hidden_dtype
from tcmrl_algo.algorithms.core.optimizer import Adam, ParameterGroup
from tcmrl_algo.algorithms.core.problem import Problem, pad_trajectories
from tcmrl_algo.algorithms.core.settings import ActorCriticSettings, TrainingSettings
from tcmrl_data import (
    Batch,
    BatchRequest,
    Controller,
    Steps,
    Trajectories,
    Trajectory,
    Transitions,
    UniformController,
)
from tcmrl_data.foundation.errors import TrainingError

ACTOR_CRITIC_STREAM = 1
"""Of random draws: apart from the learner's, so that no switch of a method changes the actor-critic's."""


def policy_transitions(settings: TrainingSettings) -> Transitions:
    """The transitions, with the rewards, that the shared actor-critic learns from."""
    return Transitions(settings.batch.transitions, rewards=settings.actor_critic.rewards)


def trajectory_request(settings: TrainingSettings) -> BatchRequest:
    """The `[training.batch]` table without windows: transitions, and two disjoint groups of trajectories."""
    batch = settings.batch
    return BatchRequest(
        batch.tasks,
        {
            "policy": policy_transitions(settings),
            "context": Trajectories(batch.context_trajectories),
            "execution": Trajectories(batch.execution_trajectories, apart_from="context"),
        },
    )


@dataclass(frozen=True)
class EncoderInputs:
    """Standardised transitions of trajectories, or of windows.

    Attributes:
        inputs: (tasks, trajectories, steps, inputs): s_t, a_t, r_t, s_{t+1} - s_t side by side.
        mask: (tasks, trajectories, steps) bool, real transitions.
        state_action: width of s_t and a_t, with which the inputs begin.
    """

    inputs: Float[Tensor, "tasks trajectories steps inputs"]
    mask: Bool[Tensor, "tasks trajectories steps"]
    state_action: int

    @property
    def state_actions(self) -> Float[Tensor, "tasks trajectories steps inputs"]:
        """s_t and a_t."""
        return self.inputs[..., : self.state_action]

    @property
    def outcomes(self) -> Float[Tensor, "tasks trajectories steps outcomes"]:
        """r_t and s_{t+1} - s_t."""
        return self.inputs[..., self.state_action :]

    def first(self, number: int) -> "EncoderInputs":
        """The first trajectories of every task."""
        return EncoderInputs(self.inputs[:, :number], self.mask[:, :number], self.state_action)

    @property
    def rewards(self) -> Float[Tensor, "tasks trajectories steps"]:
        """r_t."""
        return self.inputs[..., self.state_action]


def transition_scaling(problem: Problem) -> Standardizer:
    """Standardises s_t, a_t, r_t and s_{t+1} - s_t, side by side, by the moments of the data."""
    parts = (
        (problem.observation_mean, problem.observation_std),
        (problem.action_mean, problem.action_std),
        (torch.tensor([problem.reward_mean]), torch.tensor([problem.reward_std])),
        (problem.change_mean, problem.change_std),
    )
    mean, std = (torch.cat(vectors) for vectors in zip(*parts, strict=True))
    return Standardizer(mean, std)


def read_steps(steps: Steps, scaling: Standardizer) -> EncoderInputs:
    """The steps in units of the data's standard deviations."""
    changes = steps.next_observations - steps.observations
    inputs = torch.cat([steps.observations, steps.actions, steps.rewards.unsqueeze(-1), changes], dim=-1)
    state_action = steps.observations.shape[-1] + steps.actions.shape[-1]
    return EncoderInputs(scaling(inputs), steps.mask, state_action)


@final
class ContextEncoder(nn.Module):
    """Eq. 1: c_t = e(s_t, a_t, r_t, s_{t+1}), in [-1, 1] per latent dimension.

    Deviation: the encoder reads s_{t+1} - s_t in place of s_{t+1}; the two carry the same information,
    and the difference keeps its scale where states move little in one step.
    """

    def __init__(
        self, problem: Problem, *, latent: int, hidden: tuple[int, ...], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.state_action = problem.observation_dim + problem.action_dim
        self.scaling = transition_scaling(problem)
        self.perceptron = Perceptron((len(self.scaling.mean), *hidden, latent), generator=generator)

    def read(self, steps: Steps) -> EncoderInputs:
        """The steps in units of the data's standard deviations."""
        return read_steps(steps, self.scaling)

    def forward(self, *groups: EncoderInputs) -> tuple[Float[Tensor, "..."], ...]:
        """Representations of every group, (tasks, trajectories, steps, latent), by one forward pass."""
        return tuple(torch.tanh(part) for part in self.unbounded(*groups))

    def unbounded(self, *groups: EncoderInputs) -> tuple[Float[Tensor, "..."], ...]:
        """What `forward` squashes into [-1, 1]."""
        rows = torch.cat([group.inputs.flatten(0, 2) for group in groups])
        parts = self.perceptron(rows).split([group.mask.numel() for group in groups])
        return tuple(part.unflatten(0, group.mask.shape) for part, group in zip(parts, groups, strict=True))


@dataclass(frozen=True)
class ContextLosses:
    """Contexts and losses of one batch.

    Attributes:
        total: the loss of the learner's parameters, a weighted sum of terms.
        context: input of the actor-critic, (tasks, latent), or one context per step; None in a
            stage that does not train the actor-critic.
        metrics: the terms by name.
        next_context: of the next observations, where it differs from `context`.
        critic_gradient: lets Q's loss train `context`; V, the policy and all targets see it detached. `bc`,
            which has no Q, lets the policy's loss train it.
        steps: training data of the actor-critic; the batch's "policy" transitions if left out. Padding of
            trajectories (tasks, n, steps) is left out.
    """

    total: Float[Tensor, ""]
    context: Float[Tensor, "tasks *steps latent"] | None
    metrics: Metrics
    next_context: Float[Tensor, "tasks *steps latent"] | None = None
    critic_gradient: bool = False
    steps: Steps | None = None


class ContextLearner(nn.Module, abc.ABC):
    """How a method turns trajectories into a context, and the losses that train this.

    Attributes:
        latent: size of the context.
    """

    latent: int

    @abc.abstractmethod
    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The losses of the batch of a step, and its tasks' contexts."""

    @abc.abstractmethod
    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        """One context per lane, of all its trajectories together: (lanes, trajectories, steps)."""

    def known_context(self, privileged: Float[Tensor, "lanes parameters"]) -> Float[Tensor, "lanes latent"]:
        """One context per lane of the task parameters that a method with the capability observes."""
        raise NotImplementedError(f"{type(self).__name__} makes no context of task parameters")

    def controller(self, actor_critic: ActorCritic, steps: Steps) -> Controller:
        """Acts after the given trajectories, under their one context unless overridden; without gradients."""
        return actor_critic.controller(self.context(steps))

    def explore(self, actor_critic: ActorCritic, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        """As `Algorithm.explore`, for a method that collects its first episodes with its policy."""
        return UniformController()

    def parts(self, stage: str) -> Sequence[str]:
        """Names of the modules and parameters here that a stage trains; everything unless overridden."""
        return ("",)

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Learning rates and bounds of their own, by the name of a module or parameter here."""
        return {}

    def optimizers(self) -> Mapping[str, Adam]:
        """Optimisers that the learner steps itself within `losses`, by name; none unless overridden."""
        return {}

    def after_step(self, step: int) -> None:
        """Updates what no optimiser trains, such as momentum copies; does nothing unless overridden."""


Kind = type[SoftActorCritic] | type[ImplicitQLearning] | type[BehaviorCloning]

KINDS: dict[str, Kind] = {"sac": SoftActorCritic, "iql": ImplicitQLearning, "bc": BehaviorCloning}


def make_actor_critic(
    settings: ActorCriticSettings, problem: Problem, *, latent: int, generator: torch.Generator
) -> ActorCritic:
    """A new actor-critic of `settings.kind`."""
    return KINDS[settings.kind](settings, problem, latent=latent, generator=generator)


@final
class ContextAlgorithm(Algorithm):
    """A context learner and the actor-critic that its contexts condition, trained side by side.

    Args:
        learner: makes and trains contexts; its draws are those of stream 0.
    """

    def __init__(self, problem: Problem, settings: TrainingSettings, *, learner: ContextLearner) -> None:
        self.learner, self._trains_policy = learner, True
        self.actor_critic = make_actor_critic(
            settings.actor_critic,
            problem,
            latent=learner.latent,
            generator=problem.generator(0, ACTOR_CRITIC_STREAM),
        )
        everything = nn.ModuleDict({"context": self.learner, "actor_critic": self.actor_critic})
        set_hidden_dtype(everything, getattr(torch, settings.run.precision))
        super().__init__(
            problem,
            settings,
            everything,
            parts={
                stage.name: ("actor_critic", *map(_in_everything, learner.parts(stage.name)))
                for stage in problem.stages
            },
            groups={_in_everything(name): group for name, group in learner.groups().items()},
            optimizers={**learner.optimizers(), **self.actor_critic.optimizers()},
        )

    def loss(self, batch: Batch, step: int) -> tuple[Float[Tensor, ""], Metrics]:
        found = self.learner.losses(batch, step, self.problem.generator(step))
        self._trains_policy = found.context is not None
        if found.context is None:
            return found.total, found.metrics
        tasks, latent, shape = len(batch.task_indices), self.learner.latent, tuple(found.context.shape)
        if len(shape) < 2 or (shape[0], shape[-1]) != (tasks, latent):
            raise TrainingError(
                f"{type(self.learner).__name__}.losses returned contexts of shape {shape}; one per task is "
                f"{(tasks, latent)}, one per step ({tasks}, …, {latent})"
            )
        generator = self.problem.generator(step, ACTOR_CRITIC_STREAM)
        rows = self.actor_critic.rows(
            batch["policy"] if found.steps is None else found.steps,
            found.context,
            found.next_context,
            critic_gradient=found.critic_gradient,
        )
        self.actor_critic.train_dual(rows, generator)
        loss, metrics = self.actor_critic.losses(rows, generator)
        return found.total + loss, found.metrics | metrics

    def after_step(self, step: int) -> None:
        self.learner.after_step(step)
        if self._trains_policy:
            self.actor_critic.after_step()

    def limits(self) -> Mapping[str, float]:
        return self.actor_critic.limits()

    def explore(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        return self.learner.explore(self.actor_critic, trajectories)

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        if privileged is not None:
            return self.actor_critic.controller(self.learner.known_context(privileged))
        with torch.no_grad():
            return self.learner.controller(self.actor_critic, self.pack(trajectories))

    def latents(self, trajectories: Sequence[Sequence[Trajectory]]) -> Tensor:
        return self.context(trajectories)

    def context(self, trajectories: Sequence[Sequence[Trajectory]]) -> Float[Tensor, "lanes latent"]:
        """One context per lane, of all its trajectories together."""
        with torch.no_grad():
            return self.learner.context(self.pack(trajectories))

    def pack(self, trajectories: Sequence[Sequence[Trajectory]]) -> Steps:
        """The trajectories of every lane as the learner reads them, on its device."""
        return pad_trajectories(trajectories, self.problem)


def _in_everything(name: str) -> str:
    """The name of a learner's part in the module that holds the actor-critic too."""
    return f"context.{name}" if name else "context"


@runtime_checkable
class Attentive(Protocol):
    """A context learner with attention."""

    def attention(self, steps: Steps) -> Attention:
        """How the steps of every lane weigh in its context, trajectory after trajectory, padding included."""
        ...


def attention_of(algorithm: Algorithm, trajectories: Sequence[Sequence[Trajectory]]) -> Attention | None:
    """How the steps of every lane weigh in its context; None for a method without attention."""
    if not isinstance(algorithm, ContextAlgorithm) or not isinstance(algorithm.learner, Attentive):
        return None
    with torch.no_grad():
        return algorithm.learner.attention(algorithm.pack(trajectories))
