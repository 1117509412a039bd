"""MACAW (Mitchell et al., 2021): meta-learned starts from which one gradient step adapts to a task.

A value network phi and a policy theta, whose layers are weight-linear, take one inner step on a context:

    phi' = phi - rate grad mean (V_phi(s) - G)^2,
    theta' = theta - rate grad mean [-w log pi_theta(a | s) + c (h_theta(s, a) - A)^2],

where G is the return to go, A = G + gamma^(T-t) V_phi'(s_T) - V_phi'(s), w grows with A, and h is a head on
the policy's last hidden layer, so that the inner gradient tells advantages apart. The outer losses are those
of V_phi', with targets that bootstrap from 0.9 phi + 0.1 phi', and of pi_theta' without the head, on
transitions that are drawn apart from the context and may be among it (in the paper they are others). Their
gradients pass through the inner steps (second order) to phi, theta, h, c and a rate per parameter tensor.

Nothing loops over tasks: all lanes take their step at once, by `torch.func`, and a step on the parameters of
a layer is computed, exactly, as what it makes of the layer's weights (`networks/weight_linear.py`).

Our inferences and choices:

- Inner rows are the trajectories of the recipe's contexts, outer rows the transitions that other methods give
  the actor-critic, of as many tasks (published code: 256 consecutive ones of every seventh step, 256 random
  ones, 5 tasks). Of a long context `inner_rows` evenly spaced steps are taken, in training as at test; the
  published code trains on consecutive steps and tests on random ones.
- There is one inner step, as published, on all parameters: the published code names an adaptation of codes
  alone, which it cannot reach. The head, of ordinary layers, serves the inner loss alone and needs no rate.
- Outer losses are means over the batch's tasks (published code: divided by the number of training tasks).
- The head's first ReLU leaves actions alone (published code: it sets their negative components to 0).
- Nothing is bootstrapped where the task ended an episode.
- Returns are divided by the largest that rewards allow in an episode, so that V, its learning rate and the
  inner rates mean the same everywhere. The head's errors shrink with them, where published weights of it
  (c starts at 0.01) stand beside advantages in the unit of rewards; c is learned.
- `target_step` is the published 0.1, but for sparse-point-robot: V_phi itself is fitted by no loss, and with
  a learning rate for 3,000 steps in place of 10^6 the targets that it takes part in diverged there.
- Exploration is uniform, as the protocols have it. No loss trains the policy of the start to act well, and
  training contexts hold episodes of untrained policies, but none like those that it collects.
- With dense rewards for the outer losses (`actor_critic.rewards`), inner steps see the stored rewards, as a
  test task shows them.

Of `[training.actor_critic]` only `gamma` and `rewards` apply, and of `[training.optimizer]` only the decay;
`run.precision` changes nothing. There is no behavior regularisation: regression stays near the data.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from tcmrl_algo.algorithms.macaw.config import MacawConfig
from tcmrl_algo.algorithms.macaw.inner_step import InnerStep
from tcmrl_algo.algorithms.macaw.networks import MacawNetworks
from tcmrl_algo.algorithms.macaw.rows import LaneRows, largest_return, read_rows
from tcmrl_algo.context_methods.requests import policy_transitions
from tcmrl_algo.methods.base import Algorithm, Capabilities, Method, Metrics
from tcmrl_algo.methods.network_algorithm import FunctionController, NetworkAlgorithm
from tcmrl_algo.methods.padding import pad_trajectories
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.methods.search import Factors, Search
from tcmrl_algo.networks.optimizer import ParameterGroup
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Controller, Steps, Trajectories, Trajectory, UniformController


@final
class MacawLearner(NetworkAlgorithm):
    """Inner steps, and the outer losses that train what they start from."""

    networks: MacawNetworks

    def __init__(self, problem: Problem, settings: TrainingSettings, config: MacawConfig) -> None:
        networks = MacawNetworks(problem, config, generator=problem.generator(0))
        self._config, self._gamma = config, settings.actor_critic.gamma
        self._largest_return = largest_return(problem, settings.actor_critic)
        self.inner_step = InnerStep(networks, config)
        super().__init__(
            problem,
            settings,
            networks,
            groups={
                "value": ParameterGroup(config.value_learning_rate),
                "policy": ParameterGroup(config.policy_learning_rate),
                "head": ParameterGroup(config.policy_learning_rate),
                "inner": ParameterGroup(config.rate_learning_rate),
            },
        )

    def loss(self, batch: Batch, step: int) -> tuple[Float[Tensor, ""], Metrics]:
        """The outer losses; each trains its own network and the inner settings of that network."""
        adapted = self.inner_step.adapted(self.inner_rows(batch["context"]))
        value_loss, policy_loss = self.inner_step.outer_losses(adapted, self.rows(batch["policy"]))
        inner = self.networks.inner
        metrics = {
            "loss/value": value_loss,
            "loss/policy": policy_loss,
            "inner/value_rate": functional.softplus(inner.value_rates).mean(),
            "inner/policy_rate": functional.softplus(inner.policy_rates).mean(),
            "inner/head_weight": functional.softplus(inner.head_weight),
        }
        return value_loss + policy_loss, metrics

    def rows(self, steps: Steps, *, most: int | None = None) -> LaneRows:
        """As of `read_rows`."""
        return read_rows(steps, self.networks.scaling, largest_return=self._largest_return, most=most)

    def inner_rows(self, steps: Steps) -> LaneRows:
        """The rows of a context that an inner step reads."""
        return self.rows(steps, most=self._config.inner_rows)

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        """The policy after one inner step on the trajectories of every lane."""
        steps = pad_trajectories(trajectories, self.problem, gamma=self._gamma)
        with torch.no_grad():  # `grad` differentiates all the same, and keeps nothing for second derivatives
            policy = self.inner_step.adapted(self.inner_rows(steps)).policy

        def act(states: Tensor) -> Tensor:
            scaled = self.networks.scaling(states).unsqueeze(1)
            return self.networks.means(policy, scaled).squeeze(1)

        return FunctionController(act, self.problem.device)

    def explore(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        if self._config.explore == "uniform":
            return UniformController()
        return NoisyPolicy(self.adapt([[] for _ in trajectories]), std=self._config.sigma)


@final
class NoisyPolicy(Controller):
    """Another controller's actions with normal noise of a standard deviation, held in [-1, 1]."""

    def __init__(self, controller: Controller, *, std: float) -> None:
        self._controller, self._std = controller, std

    def act(
        self, observations: np.typing.NDArray[np.floating], noise: np.typing.NDArray[np.floating]
    ) -> np.typing.NDArray[np.floating]:
        actions = self._controller.act(observations, noise) + self._std * noise
        return np.clip(actions, -1.0, 1.0)


@final
class Macaw(Method[MacawConfig]):
    """The plug-in."""

    name = "macaw"
    Config = MacawConfig
    capabilities = Capabilities(explores=True, explores_by_default=False, needs_trajectories=False)
    search: ClassVar[Search] = {
        "macaw.policy_learning_rate": Factors(1 / 3, 3.0),
        "macaw.inner_learning_rate": Factors(0.1, 10.0),
        "macaw.temperature": Factors(0.1, 10.0),
    }

    def batch_request(self, settings: TrainingSettings, config: MacawConfig) -> BatchRequest:
        """Transitions and contexts of the other methods, with returns: for outer losses and inner steps."""
        policy = replace(policy_transitions(settings), returns=True)
        context = Trajectories(settings.batch.context_trajectories, returns=True)
        return BatchRequest(
            settings.batch.tasks, {"policy": policy, "context": context}, gamma=settings.actor_critic.gamma
        )

    def create(self, problem: Problem, settings: TrainingSettings, config: MacawConfig) -> Algorithm:
        return MacawLearner(problem, settings, config)
