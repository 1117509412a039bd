"""The control: TCMRL's actor-critic trained on the same tasks, blind to which task it is in.

Expect it to do worse than the best policy that ignores the task, at times worse than uniform actions. The
behavior data confound state and task: near a goal it comes from the agents that were paid for going there,
so that a blind critic believes every goal to pay well, and the policy leaves for one of them or beyond.
With rewards averaged over the training tasks the same training ends at the best fixed target. Where all tasks
pay the same, as on point-robot-wind, the explanation does not apply, and the method stays close to the best
fixed target, which `tcmrl controls` fits.
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
from tcmrl_data import Batch, BatchRequest, Steps


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
