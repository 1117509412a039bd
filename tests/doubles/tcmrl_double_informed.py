"""A control that sees the parameters of its task, and copies the actions of that task's transitions."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor, nn

from tcmrl_algo import (
    Algorithm,
    Capabilities,
    Method,
    Metrics,
    Problem,
    StagedOptimizer,
    TrainedModules,
    TrainingSettings,
)
from tcmrl_algo.networks.perceptron import linear
from tcmrl_data import Batch, BatchRequest, Controller, Trajectory, Transitions


class InformedConfig(BaseModel):
    """No settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class InformedLearner(Algorithm):
    """A linear policy of the state and the task's parameters."""

    def __init__(self, problem: Problem, settings: TrainingSettings) -> None:
        assert problem.privileged is not None
        self.problem, self.known = problem, problem.privileged
        inputs = problem.observation_dim + self.known.shape[1]
        self.policy = linear(inputs, problem.action_dim, problem.generator(0))
        networks = nn.ModuleDict({"policy": self.policy})
        self.optimizer = StagedOptimizer(networks, problem.stages, settings.optimizer)
        self.trained = TrainedModules({"networks": networks}, self.optimizer.adams)

    def update(self, batch: Batch, step: int) -> Metrics:
        self.optimizer.begin(step)
        rows = batch["policy"]
        known = self.known[self.problem.position(batch.task_indices)].unsqueeze(1)
        states = torch.cat([rows.observations, known.expand(*rows.mask.shape, -1)], dim=-1)
        loss = (torch.tanh(self.policy(states)) - rows.actions).square().mean()
        self.optimizer.step(loss, step)
        return {"loss/copy": loss.detach()}

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        assert privileged is not None
        return InformedController(self.policy, privileged)

    def tensors(self) -> dict[str, Tensor]:
        return self.trained.tensors()

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        self.trained.load_tensors(tensors)


class InformedController(Controller):
    """Acts by state and task parameters."""

    def __init__(self, policy: nn.Linear, privileged: Tensor) -> None:
        self._policy, self._privileged = policy, privileged

    def act(self, observations: np.ndarray, noise: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            states = torch.as_tensor(observations).float()
            return torch.tanh(self._policy(torch.cat([states, self._privileged], dim=-1))).numpy()


class InformedMethod(Method[InformedConfig]):
    """The plug-in."""

    name = "double_informed"
    Config = InformedConfig
    capabilities = Capabilities(blind=True, privileged=True, needs_trajectories=False)

    def batch_request(self, settings: TrainingSettings, config: InformedConfig) -> BatchRequest:
        return BatchRequest(settings.batch.tasks, {"policy": Transitions(settings.batch.transitions)})

    def create(self, problem: Problem, settings: TrainingSettings, config: InformedConfig) -> Algorithm:
        return InformedLearner(problem, settings)
