"""Adapts by gradients: a linear policy, weighted regression inside `adapt`, trained through that step."""

from collections.abc import Sequence

import torch
from torch import Tensor

from tcmrl_algo import (
    Algorithm,
    FunctionController,
    Method,
    MethodConfig,
    Metrics,
    Problem,
    TrainingSettings,
    pad_trajectories,
)
from tcmrl_algo.algorithms.core.networks import linear
from tcmrl_data import Batch, BatchRequest, Controller, Steps, Trajectory, Transitions


class GradientConfig(MethodConfig):
    """Settings.

    Attributes:
        inner_rate: of the gradient step in `adapt`.
        gamma: discount of the returns that weigh actions.
    """

    inner_rate: float = 0.1
    gamma: float = 0.9


class GradientLearner(Algorithm):
    """MAML over return-weighted regression."""

    def __init__(self, problem: Problem, settings: TrainingSettings, config: GradientConfig) -> None:
        self.config = config
        self.policy = linear(problem.observation_dim, problem.action_dim, problem.generator(0))
        super().__init__(problem, settings, self.policy)

    def act(self, states: Tensor, weights: Tensor, biases: Tensor) -> Tensor:
        """(lanes, steps, action) by one linear policy per lane."""
        return torch.tanh(states @ weights.mT + biases.unsqueeze(1))

    def errors(self, steps: Steps, weights: Tensor, biases: Tensor) -> Tensor:
        """(lanes,) squared errors of actions, weighted by the softmax of the returns to go."""
        assert steps.returns_to_go is not None
        returns, mask = steps.returns_to_go.flatten(1), steps.mask.flatten(1)
        shares = torch.softmax(returns.masked_fill(~mask, -torch.inf), dim=1)
        predicted = self.act(steps.observations.flatten(1, -2), weights, biases)
        return (shares * (predicted - steps.actions.flatten(1, -2)).square().sum(dim=-1)).sum(dim=1)

    def adapted(self, steps: Steps) -> list[Tensor]:
        """Weights and biases of every lane after one gradient step."""
        parameters = [value.expand(len(steps.mask), *value.shape) for value in self.policy.parameters()]
        error = self.errors(steps, *parameters).sum()
        gradients = torch.autograd.grad(error, parameters, create_graph=True)
        rate = self.config.inner_rate
        return [value - rate * gradient for value, gradient in zip(parameters, gradients, strict=True)]

    def loss(self, batch: Batch, step: int) -> tuple[Tensor, Metrics]:
        loss = self.errors(batch["outer"], *self.adapted(batch["inner"])).mean()
        return loss, {"loss/outer": loss}

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        with torch.enable_grad():
            adapted = self.adapted(pad_trajectories(trajectories, self.problem, gamma=self.config.gamma))
        weights, biases = (value.detach() for value in adapted)
        return FunctionController(
            lambda states: self.act(states.unsqueeze(1), weights, biases).squeeze(1), self.problem.device
        )


class GradientMethod(Method[GradientConfig]):
    """The plug-in."""

    name = "double_gradient"
    Config = GradientConfig

    def batch_request(self, settings: TrainingSettings, config: GradientConfig) -> BatchRequest:
        rows = Transitions(16, returns=True)
        return BatchRequest(settings.batch.tasks, {"inner": rows, "outer": rows}, gamma=config.gamma)

    def create(self, problem: Problem, settings: TrainingSettings, config: GradientConfig) -> Algorithm:
        return GradientLearner(problem, settings, config)
