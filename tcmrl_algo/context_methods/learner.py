"""Methods that adapt through a context: trajectories in, a vector out, a policy conditioned on it."""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tcmrl_algo.actor_critic.actor_critic import ActorCritic
from tcmrl_algo.actor_critic.kinds import make_actor_critic
from tcmrl_algo.methods.base import Algorithm, Metrics
from tcmrl_algo.methods.padding import pad_trajectories
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.methods.stages import StagedOptimizer
from tcmrl_algo.methods.state import TrainedModules
from tcmrl_algo.networks.optimizer import Adam, ParameterGroup
from tcmrl_algo.networks.perceptron import set_hidden_dtype
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, Controller, Steps, Trajectory, UniformController

ACTOR_CRITIC_STREAM = 1
"""Of random draws: apart from the learner's, so that no switch of a method changes the actor-critic's."""


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


@final
class ContextAlgorithm(Algorithm):
    """A context learner and the actor-critic that its contexts condition, trained side by side.

    Args:
        problem: what is learned from.
        settings: the shared tables.
        learner: makes and trains contexts; its draws are those of stream 0.
    """

    def __init__(self, problem: Problem, settings: TrainingSettings, *, learner: ContextLearner) -> None:
        self._problem = problem
        self.learner = learner.to(problem.device)
        self.actor_critic = make_actor_critic(
            settings.actor_critic,
            problem,
            latent=learner.latent,
            generator=problem.generator(0, ACTOR_CRITIC_STREAM),
        ).to(problem.device)
        everything = nn.ModuleDict({"context": self.learner, "actor_critic": self.actor_critic})
        set_hidden_dtype(everything, getattr(torch, settings.run.precision))
        self._optimizer = StagedOptimizer(
            everything,
            problem.stages,
            settings.optimizer,
            parts={
                stage.name: ("actor_critic", *map(_in_everything, learner.parts(stage.name)))
                for stage in problem.stages
            },
            groups={_in_everything(name): group for name, group in learner.groups().items()},
        )
        own = {**learner.optimizers(), **self.actor_critic.optimizers()}
        self._trained = TrainedModules({"all": everything}, {**self._optimizer.adams, **own})

    def update(self, batch: Batch, step: int) -> Metrics:
        self._optimizer.begin(step)
        found = self.learner.losses(batch, step, self._problem.generator(step))
        loss, metrics = found.total, found.metrics
        if found.context is not None:
            generator = self._problem.generator(step, ACTOR_CRITIC_STREAM)
            rows = self.actor_critic.rows(
                batch["policy"] if found.steps is None else found.steps,
                found.context,
                found.next_context,
                critic_gradient=found.critic_gradient,
            )
            self.actor_critic.train_dual(rows, generator)
            actor_critic_loss, more = self.actor_critic.losses(rows, generator)
            loss, metrics = loss + actor_critic_loss, metrics | more
        self._optimizer.step(loss, step)
        self.learner.after_step(step)
        if found.context is not None:
            self.actor_critic.after_step()
        return {name: value.detach() for name, value in metrics.items()}

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
        return pad_trajectories(trajectories, self._problem)

    def tensors(self) -> dict[str, Tensor]:
        return self._trained.tensors()

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        self._trained.load_tensors(tensors)


def _in_everything(name: str) -> str:
    """The name of a learner's part in the module that holds the actor-critic too."""
    return f"context.{name}" if name else "context"
