"""The control: TCMRL's actor-critic trained on the same tasks, blind to which task it is in.

Expect it to do worse than the best policy that ignores the task, at times worse than uniform actions. The
behavior data confound state and task: near a goal it comes from the agents that were paid for going there,
so that a blind critic believes every goal to pay well, and the policy leaves for one of them or beyond.
With rewards averaged over the training tasks the same training ends at the best fixed target.
"""

from collections.abc import Mapping, Sequence
from typing import final

import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict
from torch import Tensor

from tcmrl_algo.actor_critic import ActorCritic
from tcmrl_algo.config import TrainingSettings
from tcmrl_algo.context_algorithm import ContextAlgorithm
from tcmrl_algo.problem import Algorithm, Metrics, Problem, TrainedModules
from tcmrl_data import Batch, BatchSizes, Trajectory

NAME = "no_context"


class Config(BaseModel):
    """The `[training.no_context]` table: nothing but the shared settings matters."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def batch_sizes(settings: TrainingSettings) -> BatchSizes:
    """The `[training.batch]` table without the trajectories that nothing here reads."""
    unused = {"context_trajectories": (1,), "execution_trajectories": 0, "windows": 0}
    return settings.batch.model_copy(update=unused)


def create(problem: Problem, settings: TrainingSettings, config: Config) -> Algorithm:
    """A new learner, its networks at their start."""
    return NoContext(problem, settings)


@final
class NoContext(ContextAlgorithm):
    """An actor-critic under a context of no dimensions."""

    def __init__(self, problem: Problem, settings: TrainingSettings) -> None:
        self._problem = problem
        self.actor_critic = ActorCritic(
            settings.actor_critic, problem, latent=0, generator=problem.generator(0)
        ).to(problem.device)
        self._adam = settings.optimizer.build(self.actor_critic, decay_steps=problem.steps)
        self._trained = TrainedModules(
            {"all": self.actor_critic}, {"all": self._adam, **self.actor_critic.optimizers()}
        )

    def update(self, batch: Batch, step: int) -> Metrics:
        generator = self._problem.generator(step)
        nothing = batch.transitions.rewards.new_zeros(len(batch.task_indices), 0)
        rows = self.actor_critic.rows(batch.transitions, nothing)
        self.actor_critic.train_dual(rows, generator)
        loss, metrics = self.actor_critic.losses(rows, generator)
        self._adam.step(loss, steps_done=step - 1)
        self.actor_critic.after_step()
        return {name: each.detach() for name, each in metrics.items()}

    def context(self, trajectories: Sequence[Sequence[Trajectory]]) -> Float[Tensor, "lanes latent"]:
        return torch.zeros(len(trajectories), 0, device=self._problem.device)

    def policy(
        self, observations: Float[Tensor, "lanes observation"], context: Float[Tensor, "lanes latent"]
    ) -> Float[Tensor, "lanes action"]:
        return self.actor_critic.act(observations, context)

    def tensors(self) -> dict[str, Tensor]:
        return self._trained.tensors()

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        self._trained.load_tensors(tensors)
