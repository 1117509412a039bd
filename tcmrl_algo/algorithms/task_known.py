"""The control: TCMRL's actor-critic, whose context is the task itself.

It tells what limits a method on an environment. Where this control does well and a method does not, the
method's contexts are the limit; where both do not, the data or the offline actor-critic are.
"""

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor

from tcmrl_algo.context_methods.learner import ContextAlgorithm, ContextLearner, ContextLosses
from tcmrl_algo.context_methods.requests import policy_transitions
from tcmrl_algo.methods.base import Algorithm, Capabilities, Method, MethodConfig
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps, TrainingError


@final
class KnownTask(ContextLearner):
    """The task parameters as the context, in units of the training tasks' standard deviations.

    Raises:
        TrainingError: the environment's tasks have no parameters.
    """

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        assert problem.privileged is not None, "the capability gives the parameters"
        if not problem.privileged.shape[1]:
            raise TrainingError(f"tasks of {problem.environment} have no parameters; choose another --algo")
        self._problem, self._known = problem, problem.privileged
        self.latent = problem.privileged.shape[1]

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """No loss: nothing is learned but the actor-critic."""
        context = self._known[self._problem.position(batch.task_indices)]
        return ContextLosses(context.new_zeros(()), context, {})

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        """The mean training task, whatever the trajectories."""
        return steps.rewards.new_zeros(len(steps.rewards), self.latent)

    def known_context(self, privileged: Float[Tensor, "lanes parameters"]) -> Float[Tensor, "lanes latent"]:
        return privileged.to(self._problem.device)


@final
class TaskKnown(Method[MethodConfig]):
    """The plug-in."""

    name = "task_known"
    capabilities = Capabilities(blind=True, privileged=True, needs_trajectories=False)

    def batch_request(self, settings: TrainingSettings, config: MethodConfig) -> BatchRequest:
        """The actor-critic's transitions: nothing here reads a trajectory."""
        return BatchRequest(settings.batch.tasks, {"policy": policy_transitions(settings)})

    def create(self, problem: Problem, settings: TrainingSettings, config: MethodConfig) -> Algorithm:
        return ContextAlgorithm(problem, settings, learner=KnownTask(problem))
