"""Base classes for methods without an actor-critic, which then define only a loss and a policy."""

import abc
from collections.abc import Callable, Collection, Mapping
from typing import final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from tcmrl_algo.methods.base import Algorithm, Metrics
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.methods.stages import StagedOptimizer
from tcmrl_algo.methods.state import TrainedModules
from tcmrl_algo.networks.optimizer import ParameterGroup
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, Controller


class NetworkAlgorithm(Algorithm):
    """An algorithm whose networks descend one loss per step; a method adds `loss` and `adapt`.

    Args:
        problem: what is learned from.
        settings: the shared tables.
        networks: everything that is trained; moved to the problem's device.
        parts: as of `StagedOptimizer`.
        groups: as of `StagedOptimizer`.

    Attributes:
        problem: as above.
        networks: as above.
    """

    def __init__(
        self,
        problem: Problem,
        settings: TrainingSettings,
        networks: nn.Module,
        *,
        parts: Mapping[str, Collection[str]] | None = None,
        groups: Mapping[str, ParameterGroup] | None = None,
    ) -> None:
        self.problem, self.networks = problem, networks.to(problem.device)
        self._optimizer = StagedOptimizer(
            self.networks, problem.stages, settings.optimizer, parts=parts, groups=groups
        )
        self._trained = TrainedModules({"all": self.networks}, self._optimizer.adams)

    @abc.abstractmethod
    def loss(self, batch: Batch, step: int) -> tuple[Float[Tensor, ""], Metrics]:
        """The loss of the networks in a step, and the metrics of the step."""

    @final
    def update(self, batch: Batch, step: int) -> Metrics:
        self._optimizer.begin(step)
        loss, metrics = self.loss(batch, step)
        self._optimizer.step(loss, step)
        return {name: value.detach() for name, value in metrics.items()}

    @final
    def tensors(self) -> dict[str, Tensor]:
        return self._trained.tensors()

    @final
    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        self._trained.load_tensors(tensors)


class FunctionController(Controller):
    """Acts by a function of observations, without exploration.

    Args:
        policy: actions (lanes, action_dim) in [-1, 1] for observations (lanes, observation_dim); called
            without gradients.
        device: where the function reads observations.
    """

    def __init__(self, policy: Callable[[Tensor], Tensor], device: torch.device) -> None:
        self._policy, self._device = policy, device

    def act(
        self, observations: np.typing.NDArray[np.floating], noise: np.typing.NDArray[np.floating]
    ) -> np.typing.NDArray[np.floating]:
        states = torch.as_tensor(observations, dtype=torch.float32, device=self._device)
        with torch.no_grad():
            actions: np.typing.NDArray[np.floating] = self._policy(states).cpu().numpy()
        return actions
