"""The controls: the shared actor-critic without a context, and with the task itself as the context.

`no_context` is trained on the same tasks, blind to which task it is in. Expect it to do worse than the best
policy that ignores the task, at times worse than uniform actions. Near a goal the data come from the agents
that were paid for going there, so that a blind critic believes every goal to pay well, and the policy leaves
for one of them or beyond. With rewards averaged over the training tasks the same training ends at the best
fixed target. Where all tasks pay the same, as on point-robot-wind, the
explanation does not apply, and the method stays close to the best fixed target, which `tcmrl controls` fits.

`task_known` tells what limits a method on an environment. Where this control does well and a method does not,
the method's contexts are the limit; where both do not, the data or the offline actor-critic are.
"""

import math
from typing import final

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn

from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextLearner,
    ContextLosses,
    policy_transitions,
)
from tcmrl_algo.algorithms.core.method import Algorithm, Capabilities, Method, MethodConfig
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps, TrainingError


@final
class Blind(ContextLearner):
    """A context of no dimensions."""

    latent = 0

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        rewards = batch["policy"].rewards
        return ContextLosses(rewards.new_zeros(()), rewards.new_zeros(len(rewards), 0), {})

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        return steps.rewards.new_zeros(len(steps.rewards), 0)


@final
class NoContext(Method[MethodConfig]):
    """The plug-in."""

    name = "no_context"
    capabilities = Capabilities(blind=True, needs_trajectories=False)

    def batch_request(self, settings: TrainingSettings, config: MethodConfig) -> BatchRequest:
        """The actor-critic's transitions: nothing here reads a trajectory."""
        return BatchRequest(settings.batch.tasks, {"policy": policy_transitions(settings)})

    def create(self, problem: Problem, settings: TrainingSettings, config: MethodConfig) -> Algorithm:
        return ContextAlgorithm(problem, settings, learner=Blind())


class TaskKnownConfig(MethodConfig):
    """The `[training.task_known]` table.

    Attributes:
        embedding: number of random Fourier features (Rahimi & Recht, 2007) that stand for the parameters; 0
            gives the parameters themselves. Then one scalar is easily lost beside the 17 observations of a
            robot, and 41 parameters of 30 tasks are memorised one by one; 16 features make both comparable.
    """

    embedding: int = Field(default=0, ge=0)


@final
class FourierFeatures(nn.Module):
    """Fixed features sqrt(2) cos(w . p / sqrt(P) + b) of P parameters p, w from N(0, I), b from U(0, 2 pi).

    Their mean product over two tasks estimates exp(-|p - p'|^2 / (2 P)), whose width grows with the number of
    parameters, so that the distance of two random tasks counts as much with many parameters as with one.
    Nothing is trained: features that are could memorise the training tasks.
    """

    frequencies: Tensor
    phases: Tensor

    def __init__(self, parameters: int, features: int, *, generator: torch.Generator) -> None:
        super().__init__()
        frequencies = torch.randn(parameters, features, generator=generator) / math.sqrt(parameters)
        self.register_buffer("frequencies", frequencies)
        self.register_buffer("phases", 2.0 * math.pi * torch.rand(features, generator=generator))

    def forward(self, values: Float[Tensor, "tasks parameters"]) -> Float[Tensor, "tasks features"]:
        return math.sqrt(2.0) * torch.cos(values @ self.frequencies + self.phases)


@final
class KnownTask(ContextLearner):
    """The task parameters as the context, in units of the training tasks' standard deviations.

    Args:
        embedding: number of features in place of the parameters; 0 for none.

    Raises:
        TrainingError: the environment's tasks have no parameters.
    """

    def __init__(self, problem: Problem, *, embedding: int = 0) -> None:
        super().__init__()
        assert problem.privileged is not None, "the capability gives the parameters"
        if not problem.privileged.shape[1]:
            raise TrainingError(f"tasks of {problem.environment} have no parameters; choose another --algo")
        self._problem, self._known = problem, problem.privileged
        self._width = problem.privileged.shape[1]
        self.latent = embedding or self._width
        self.embedding: FourierFeatures | None = None
        if embedding:
            self.embedding = FourierFeatures(self._width, embedding, generator=problem.generator(0))

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """No loss: nothing is learned but the actor-critic."""
        context = self._embedded(self._known[self._problem.position(batch.task_indices)])
        return ContextLosses(context.new_zeros(()), context, {})

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        """The mean training task, whatever the trajectories."""
        return self._embedded(steps.rewards.new_zeros(len(steps.rewards), self._width))

    def known_context(self, privileged: Float[Tensor, "lanes parameters"]) -> Float[Tensor, "lanes latent"]:
        return self._embedded(privileged.to(self._problem.device))

    def _embedded(self, parameters: Float[Tensor, "tasks parameters"]) -> Float[Tensor, "tasks latent"]:
        return parameters if self.embedding is None else self.embedding(parameters)


@final
class TaskKnown(Method[TaskKnownConfig]):
    """The plug-in."""

    name = "task_known"
    Config = TaskKnownConfig
    capabilities = Capabilities(blind=True, privileged=True, needs_trajectories=False)

    def batch_request(self, settings: TrainingSettings, config: TaskKnownConfig) -> BatchRequest:
        """The actor-critic's transitions: nothing here reads a trajectory."""
        return BatchRequest(settings.batch.tasks, {"policy": policy_transitions(settings)})

    def create(self, problem: Problem, settings: TrainingSettings, config: TaskKnownConfig) -> Algorithm:
        return ContextAlgorithm(problem, settings, learner=KnownTask(problem, embedding=config.embedding))
