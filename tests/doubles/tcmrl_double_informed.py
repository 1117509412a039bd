"""A control that sees the parameters of its task, and copies the actions of that task's transitions."""

from collections.abc import Sequence

import torch
from torch import Tensor

from tcmrl_algo import (
    Algorithm,
    Capabilities,
    FunctionController,
    Method,
    MethodConfig,
    Metrics,
    Problem,
    TrainingSettings,
)
from tcmrl_algo.algorithms.core.networks import linear
from tcmrl_data import Batch, BatchRequest, Controller, Trajectory, Transitions


class InformedLearner(Algorithm):
    """A linear policy of the state and the task's parameters."""

    def __init__(self, problem: Problem, settings: TrainingSettings) -> None:
        assert problem.privileged is not None
        self.parameters = problem.privileged
        inputs = problem.observation_dim + self.parameters.shape[1]
        self.policy = linear(inputs, problem.action_dim, problem.generator(0))
        super().__init__(problem, settings, self.policy)

    def act(self, states: Tensor, parameters: Tensor) -> Tensor:
        return torch.tanh(self.policy(torch.cat([states, parameters], dim=-1)))

    def loss(self, batch: Batch, step: int) -> tuple[Tensor, Metrics]:
        rows = batch["policy"]
        parameters = self.parameters[self.problem.position(batch.task_indices)].unsqueeze(1)
        actions = self.act(rows.observations, parameters.expand(*rows.mask.shape, -1))
        loss = (actions - rows.actions).square().mean()
        return loss, {"loss/copy": loss}

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        assert privileged is not None
        return FunctionController(lambda states: self.act(states, privileged), self.problem.device)


class InformedMethod(Method[MethodConfig]):
    """The plug-in."""

    name = "double_informed"
    capabilities = Capabilities(blind=True, privileged=True, needs_trajectories=False)

    def batch_request(self, settings: TrainingSettings, config: MethodConfig) -> BatchRequest:
        return BatchRequest(settings.batch.tasks, {"policy": Transitions(settings.batch.transitions)})

    def create(self, problem: Problem, settings: TrainingSettings, config: MethodConfig) -> Algorithm:
        return InformedLearner(problem, settings)
