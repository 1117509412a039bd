"""A belief that every step changes, and a policy that reads it; no trajectory is the prior."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tcmrl_algo import (
    Algorithm,
    Capabilities,
    FunctionController,
    Method,
    MethodConfig,
    Metrics,
    Problem,
    TrainingSettings,
    pad_trajectories,
)
from tcmrl_algo.algorithms.core.networks import linear
from tcmrl_data import Batch, BatchRequest, Controller, LaneTransition, Steps, Trajectories, Trajectory

BELIEF = 4


class BeliefLearner(Algorithm):
    """A recurrent belief trained by copying the actions of trajectories."""

    def __init__(self, problem: Problem, settings: TrainingSettings) -> None:
        states, actions, generator = problem.observation_dim, problem.action_dim, problem.generator(0)
        self.change = linear(BELIEF + states + actions + 1, BELIEF, generator)
        self.policy = linear(states + BELIEF, actions, generator)
        super().__init__(problem, settings, nn.ModuleDict({"change": self.change, "policy": self.policy}))

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

    def loss(self, batch: Batch, step: int) -> tuple[Tensor, Metrics]:
        steps = batch["episodes"]
        beliefs = torch.stack(self.beliefs(steps)[:-1], dim=1)
        errors = self.act(steps.observations.flatten(1, 2), beliefs) - steps.actions.flatten(1, 2)
        loss = errors[steps.mask.flatten(1, 2)].square().mean()
        return loss, {"loss/copy": loss}

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        with torch.no_grad():
            return BeliefController(self, self.beliefs(pad_trajectories(trajectories, self.problem))[-1])


class BeliefController(FunctionController):
    """Acts by a belief that every step changes."""

    def __init__(self, learner: BeliefLearner, belief: Tensor) -> None:
        super().__init__(lambda states: learner.act(states, self._belief), learner.problem.device)
        self._learner, self._belief = learner, belief

    def observe(self, transition: LaneTransition) -> None:
        names = ("observations", "actions", "rewards")
        values = [torch.as_tensor(getattr(transition, name)).float() for name in names]
        with torch.no_grad():
            self._belief = self._learner.follow(self._belief, *values, torch.as_tensor(transition.active))


class BeliefMethod(Method[MethodConfig]):
    """The plug-in."""

    name = "double_belief"
    capabilities = Capabilities(stateful=True, needs_trajectories=False)

    def batch_request(self, settings: TrainingSettings, config: MethodConfig) -> BatchRequest:
        return BatchRequest(settings.batch.tasks, {"episodes": Trajectories(2)})

    def create(self, problem: Problem, settings: TrainingSettings, config: MethodConfig) -> Algorithm:
        return BeliefLearner(problem, settings)
