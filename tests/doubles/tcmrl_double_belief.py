"""A belief that every step changes, and a policy that reads it; no trajectory is the prior."""

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
from tcmrl_algo.context_methods.packing import pack
from tcmrl_algo.networks.perceptron import linear
from tcmrl_data import Batch, BatchRequest, Controller, Steps, Trajectories, Trajectory, Transition

BELIEF = 4


class BeliefConfig(BaseModel):
    """No settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class BeliefLearner(Algorithm):
    """A recurrent belief trained by copying the actions of trajectories."""

    def __init__(self, problem: Problem, settings: TrainingSettings) -> None:
        self.problem, generator = problem, problem.generator(0)
        states, actions = problem.observation_dim, problem.action_dim
        self.change = linear(BELIEF + states + actions + 1, BELIEF, generator)
        self.policy = linear(states + BELIEF, actions, generator)
        networks = nn.ModuleDict({"change": self.change, "policy": self.policy})
        self.optimizer = StagedOptimizer(networks, problem.stages, settings.optimizer)
        self.trained = TrainedModules({"networks": networks}, self.optimizer.adams)

    def follow(
        self, belief: Tensor, states: Tensor, actions: Tensor, rewards: Tensor, real: Tensor
    ) -> Tensor:
        changed = torch.tanh(self.change(torch.cat([belief, states, actions, rewards.unsqueeze(-1)], dim=-1)))
        return torch.where(real.unsqueeze(-1), changed, belief)

    def act(self, states: Tensor, belief: Tensor) -> Tensor:
        return torch.tanh(self.policy(torch.cat([states, belief], dim=-1)))

    def beliefs(self, steps: Steps) -> list[Tensor]:
        """Before every step of the lanes' trajectories, and after the last."""
        found = [torch.zeros(len(steps.mask), BELIEF)]
        values = (steps.observations, steps.actions, steps.rewards, steps.mask)
        for now in zip(*(value.flatten(1, 2).unbind(1) for value in values), strict=True):
            found.append(self.follow(found[-1], *now))
        return found

    def update(self, batch: Batch, step: int) -> Metrics:
        self.optimizer.begin(step)
        steps = batch["episodes"]
        beliefs = torch.stack(self.beliefs(steps)[:-1], dim=1)
        errors = self.act(steps.observations.flatten(1, 2), beliefs) - steps.actions.flatten(1, 2)
        loss = errors[steps.mask.flatten(1, 2)].square().mean()
        self.optimizer.step(loss, step)
        return {"loss/copy": loss.detach()}

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        with torch.no_grad():
            return BeliefController(self, self.beliefs(pack(trajectories, self.problem))[-1])

    def tensors(self) -> dict[str, Tensor]:
        return self.trained.tensors()

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        self.trained.load_tensors(tensors)


class BeliefController(Controller):
    """Acts by a belief that every step changes."""

    def __init__(self, learner: BeliefLearner, belief: Tensor) -> None:
        self._learner, self._belief = learner, belief

    def act(self, observations: np.ndarray, noise: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return self._learner.act(torch.as_tensor(observations).float(), self._belief).numpy()

    def observe(self, transition: Transition) -> None:
        names = ("observations", "actions", "rewards")
        values = [torch.as_tensor(getattr(transition, name)).float() for name in names]
        with torch.no_grad():
            self._belief = self._learner.follow(self._belief, *values, torch.as_tensor(transition.active))


class BeliefMethod(Method[BeliefConfig]):
    """The plug-in."""

    name = "double_belief"
    Config = BeliefConfig
    capabilities = Capabilities(stateful=True, needs_trajectories=False)

    def batch_request(self, settings: TrainingSettings, config: BeliefConfig) -> BatchRequest:
        return BatchRequest(settings.batch.tasks, {"episodes": Trajectories(2)})

    def create(self, problem: Problem, settings: TrainingSettings, config: BeliefConfig) -> Algorithm:
        return BeliefLearner(problem, settings)
