"""Methods that adapt through a context: trajectories in, a vector out, a policy conditioned on it."""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from tcmrl_algo.actor_critic.actor_critic import ActorCritic
from tcmrl_algo.methods.problem import Algorithm, Metrics, Problem, TrainedModules
from tcmrl_algo.networks.attention import Attention
from tcmrl_algo.networks.optimizer import Adam
from tcmrl_algo.networks.perceptron import set_hidden_dtype
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, Controller, Steps, Trajectory, UniformController

ACTOR_CRITIC_STREAM = 1
"""Of random draws: apart from the learner's, so that no switch of a method changes the actor-critic's."""


@dataclass(frozen=True)
class ContextLosses:
    """What a context learner makes of one batch.

    Attributes:
        total: what its parameters descend; weighted sum of its terms.
        context: (tasks, latent), what the actor-critic is conditioned on.
        metrics: the terms by name.
    """

    total: Float[Tensor, ""]
    context: Float[Tensor, "tasks latent"]
    metrics: Metrics


class ContextLearner(nn.Module, abc.ABC):
    """All in which context-based methods differ: how trajectories become a context, and what trains that.

    Attributes:
        latent: size of the context.
    """

    latent: int

    @abc.abstractmethod
    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The losses of the batch of a step, and its tasks' contexts; no gradient of others reaches these."""

    @abc.abstractmethod
    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        """One context per lane, of all its trajectories together: (lanes, trajectories, steps)."""

    def attention(self, steps: Steps) -> Attention | None:
        """How the steps of each lane weigh in its context; None for a method without attention."""
        return None

    def explore(self, actor_critic: ActorCritic, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        """As `Algorithm.explore`, for a method that collects its first episodes with its policy."""
        return UniformController()

    def optimizers(self) -> Mapping[str, Adam]:
        """Optimisers that the learner steps itself within `losses`, by name; none unless overridden."""
        return {}


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
        self.actor_critic = ActorCritic(
            settings.actor_critic,
            problem,
            latent=learner.latent,
            generator=problem.generator(0, ACTOR_CRITIC_STREAM),
        ).to(problem.device)
        everything = nn.ModuleDict({"context": self.learner, "actor_critic": self.actor_critic})
        set_hidden_dtype(everything, getattr(torch, settings.run.precision))
        table = settings.optimizer
        self._adam = Adam(
            everything,
            learning_rate=table.learning_rate,
            final_share=table.final_share,
            decay_steps=problem.steps,
            gradient_norm=table.gradient_norm,
        )
        own = {**self.learner.optimizers(), **self.actor_critic.optimizers()}
        self._trained = TrainedModules({"all": everything}, {"all": self._adam, **own})

    def update(self, batch: Batch, step: int) -> Metrics:
        found = self.learner.losses(batch, step, self._problem.generator(step))
        generator = self._problem.generator(step, ACTOR_CRITIC_STREAM)
        rows = self.actor_critic.rows(batch["policy"], found.context)
        self.actor_critic.train_dual(rows, generator)
        loss, metrics = self.actor_critic.losses(rows, generator)
        self._adam.step(found.total + loss, steps_done=step - 1)
        self.actor_critic.after_step()
        return {name: each.detach() for name, each in (found.metrics | metrics).items()}

    def limits(self) -> Mapping[str, float]:
        return self.actor_critic.limits()

    def explore(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        return self.learner.explore(self.actor_critic, trajectories)

    def adapt(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        return ContextController(self.actor_critic, self.context(trajectories))

    def context(self, trajectories: Sequence[Sequence[Trajectory]]) -> Float[Tensor, "lanes latent"]:
        """One context per lane, of all its trajectories together; at least one trajectory each."""
        with torch.no_grad():
            return self.learner.context(pack(trajectories, self._problem.device))

    def attention(self, trajectories: Sequence[Sequence[Trajectory]]) -> Attention | None:
        """How the steps of each lane weigh in its context, trajectory after trajectory, padding included."""
        with torch.no_grad():
            return self.learner.attention(pack(trajectories, self._problem.device))

    def tensors(self) -> dict[str, Tensor]:
        return self._trained.tensors()

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        self._trained.load_tensors(tensors)


@final
class ContextController(Controller):
    """Acts under one fixed context per lane."""

    def __init__(self, actor_critic: ActorCritic, context: Float[Tensor, "lanes latent"]) -> None:
        self._actor_critic, self._context = actor_critic, context

    def act(
        self, observations: np.typing.NDArray[np.floating], noise: np.typing.NDArray[np.floating]
    ) -> np.typing.NDArray[np.floating]:
        states = torch.as_tensor(observations, dtype=torch.float32, device=self._context.device)
        actions: np.typing.NDArray[np.floating] = self._actor_critic.act(states, self._context).cpu().numpy()
        return actions


def pack(trajectories: Sequence[Sequence[Trajectory]], device: torch.device) -> Steps:
    """Trajectories of several lanes as padded steps (lanes, most trajectories, longest episode).

    Lanes may hold different numbers of trajectories; what is missing is padding.
    """
    shape = (
        len(trajectories),
        max(len(lane) for lane in trajectories),
        max(len(each) for lane in trajectories for each in lane),
    )
    first = trajectories[0][0]
    observations, following = np.zeros((2, *shape, first.observations.shape[1]), dtype=np.float32)
    actions = np.zeros((*shape, first.actions.shape[1]), dtype=np.float32)
    rewards, terminated = np.zeros((2, *shape), dtype=np.float32)
    mask = np.zeros(shape, dtype=bool)
    for i, lane in enumerate(trajectories):
        for j, each in enumerate(lane):
            place = (i, j, slice(0, len(each)))
            observations[place], following[place] = each.observations[:-1], each.observations[1:]
            actions[place], rewards[place] = each.actions, each.rewards
            terminated[place], mask[place] = each.terminated, True
    arrays = (observations, actions, rewards, following, terminated, mask)
    return Steps(*(torch.from_numpy(each).to(device) for each in arrays))
