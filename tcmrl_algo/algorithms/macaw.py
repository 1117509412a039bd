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
a layer is computed, exactly, as what it makes of the layer's weights (`macaw_networks.py`).

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

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from pydantic import Field
from torch import Tensor, nn
from torch.func import grad, vmap
from torch.nn import functional

from tcmrl_algo.algorithms.core.context import policy_transitions
from tcmrl_algo.algorithms.core.losses import Scalar
from tcmrl_algo.algorithms.core.method import (
    Algorithm,
    Capabilities,
    Factors,
    FunctionController,
    Method,
    MethodConfig,
    Metrics,
    Search,
)
from tcmrl_algo.algorithms.core.networks import Perceptron, Standardizer
from tcmrl_algo.algorithms.core.optimizer import ParameterGroup
from tcmrl_algo.algorithms.core.problem import Problem, pad_trajectories
from tcmrl_algo.algorithms.core.settings import ActorCriticSettings, TrainingSettings
from tcmrl_algo.algorithms.macaw_networks import WeightPerceptron, Weights
from tcmrl_data import Batch, BatchRequest, Controller, Steps, Trajectories, Trajectory, UniformController

SMALLEST_STD = 1e-6
"""Added to the standard deviation of advantages, so that equal advantages have weight 1."""


class MacawConfig(MethodConfig):
    """The `[training.macaw]` table.

    Attributes:
        hidden: widths of both networks (published code: 100 x 3).
        code: size of the code behind the weights of a layer (published code: 100).
        head_hidden: width of the advantage head (published code: 32).
        sigma: standard deviation of the policy, whose mean is squashed (published code: 0.2).
        inner_learning_rate: start of the inner rates (published code: 1e-3).
        rate_learning_rate: of Adam for the inner rates and the head's weight (published code: 1e-3).
        policy_learning_rate: of Adam for the policy and its head (published code: 1e-4, for 10^6 steps).
        value_learning_rate: of Adam for the value network (published code: 1e-5, for 10^6 steps).
        head_weight: start of c (published code: 0.01).
        temperature: by which normalised advantages are divided (published code: 1).
        weight_cap: largest weight of a transition (published code: 20).
        target_step: share of the adapted value network in the one of the outer targets (published code: 0.1).
        inner_rows: most steps of a context that an inner step reads (published code: 256).
        first_order: leaves out the derivative of inner gradients (ours, for speed).
        explore: who collects before there are data: `uniform` actions, or the unadapted `policy`.
    """

    hidden: tuple[int, ...] = Field(default=(100, 100, 100), min_length=1)
    code: int = Field(default=100, ge=1)
    head_hidden: int = Field(default=32, ge=1)
    sigma: float = Field(default=0.2, gt=0)
    inner_learning_rate: float = Field(default=1e-3, gt=0)
    rate_learning_rate: float = Field(default=1e-3, gt=0)
    policy_learning_rate: float = Field(default=1e-4, gt=0)
    value_learning_rate: float = Field(default=1e-5, gt=0)
    head_weight: float = Field(default=0.01, gt=0)
    temperature: float = Field(default=1.0, gt=0)
    weight_cap: float = Field(default=20.0, gt=0)
    target_step: float = Field(default=0.1, ge=0, le=1)
    inner_rows: int = Field(default=256, ge=2)
    first_order: bool = False
    explore: Literal["policy", "uniform"] = "uniform"


def return_regression(
    values: Float[Tensor, "*rows"], targets: Float[Tensor, "*rows"], mask: Bool[Tensor, "*rows"]
) -> Scalar:
    """Mean of (V(s) - G)^2 (MACAW, Mitchell et al., 2021)."""
    return _mean((values - targets).square(), mask)


def bootstrapped_return(
    returns: Float[Tensor, "*rows"], discounts: Float[Tensor, "*rows"], final_values: Float[Tensor, "*rows"]
) -> Float[Tensor, "*rows"]:
    """G_t + gamma^(T - t) V(s_T): the return to go, where a time limit is no end (MACAW).

    Args:
        returns: G_t, the sum over k < T - t of gamma^k r_{t+k}.
        discounts: gamma^(T - t), 0 where the task ended the episode.
        final_values: V(s_T).
    """
    return returns + discounts * final_values


def advantage_weights(
    advantages: Float[Tensor, "*lanes rows"],
    mask: Bool[Tensor, "*lanes rows"],
    *,
    temperature: float,
    largest: float,
) -> Float[Tensor, "*lanes rows"]:
    """How much actions weigh: w = min(exp(A' / temperature), largest) (MACAW).

    A' = (A - mean A) / std A over the rows of a lane, with the unbiased standard deviation. Deviation: the
    published code divides 0 by 0 where all advantages are equal; here their weights are 1.
    """
    real = torch.where(mask, advantages, 0.0)
    number = mask.sum(dim=-1, keepdim=True)
    centered = torch.where(mask, real - real.sum(dim=-1, keepdim=True) / number.clamp(min=1), 0.0)
    variance = centered.square().sum(dim=-1, keepdim=True) / (number - 1).clamp(min=1)
    normalized = centered / (variance.sqrt() + SMALLEST_STD)
    return (normalized / temperature).clamp(max=math.log(largest)).exp()


def gaussian_log_likelihood(
    actions: Float[Tensor, "*rows action"], means: Float[Tensor, "*rows action"], *, std: float
) -> Float[Tensor, "*rows"]:
    """Log density of N(mu, std^2): the sum of -(a - mu)^2 / (2 std^2) - log std - log(2 pi) / 2."""
    terms = -0.5 * ((actions - means) / std).square() - math.log(std) - 0.5 * math.log(2 * math.pi)
    return terms.sum(dim=-1)


def weighted_likelihood(
    log_likelihoods: Float[Tensor, "*rows"], weights: Float[Tensor, "*rows"], mask: Bool[Tensor, "*rows"]
) -> Scalar:
    """Mean of -w log pi(a | s) (advantage-weighted regression, Peng et al., 2019)."""
    return _mean(-weights * log_likelihoods, mask)


def _mean(values: Tensor, mask: Tensor) -> Scalar:
    """As `masked_mean`, within `vmap` too, where no mask can be asked whether all of it is True."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


@final
class InnerSettings(nn.Module):
    """The learnt parts of inner steps: rates and the head's weight, before softplus.

    Args:
        num_layers: of both networks, each with three tensors.
        config: gives the starts; softplus of the logarithm of a small number is nearly the number.
    """

    def __init__(self, num_layers: int, config: MacawConfig) -> None:
        super().__init__()
        start = torch.full((num_layers, 3), math.log(config.inner_learning_rate))
        self.value_rates, self.policy_rates = nn.Parameter(start.clone()), nn.Parameter(start)
        self.head_weight = nn.Parameter(torch.tensor(math.log(config.head_weight)))


@final
class MacawNetworks(nn.Module):
    """Value network, policy with advantage head, and the settings of inner steps."""

    def __init__(self, problem: Problem, config: MacawConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        states, actions = problem.observation_dim, problem.action_dim
        hidden, code = config.hidden, config.code
        self.scaling = Standardizer(problem.observation_mean, problem.observation_std)
        self.value = WeightPerceptron((states, *hidden, 1), code=code, generator=generator)
        self.policy = WeightPerceptron((states, *hidden, actions), code=code, generator=generator)
        self.head = Perceptron((hidden[-1] + actions, config.head_hidden, 1), generator=generator)
        self.inner = InnerSettings(len(self.value.layers), config)

    def values(self, weights: Weights, states: Float[Tensor, "*rows state"]) -> Float[Tensor, "*rows"]:
        """V(s)."""
        return self.value.run(weights, states)[0].squeeze(-1)

    def means(self, weights: Weights, states: Float[Tensor, "*rows state"]) -> Float[Tensor, "*rows action"]:
        """The most likely actions."""
        return torch.tanh(self.policy.run(weights, states)[0])

    def advantage_guesses(
        self, features: Float[Tensor, "*rows features"], actions: Float[Tensor, "*rows action"]
    ) -> Float[Tensor, "*rows"]:
        """h(s, a), of the policy's features."""
        guesses: Tensor = self.head(torch.cat([torch.relu(features), actions], dim=-1))
        return guesses.squeeze(-1)


@dataclass(frozen=True)
class LaneRows:
    """Transitions of every lane with what they returned.

    Attributes:
        states, final_states: (lanes, rows, observation_dim), standardised s_t and s_T.
        returns: (lanes, rows), G_t in units of the largest return.
        discounts: (lanes, rows), gamma^(T - t), 0 where the task ended the episode.
    """

    states: Float[Tensor, "lanes rows observation"]
    final_states: Float[Tensor, "lanes rows observation"]
    actions: Float[Tensor, "lanes rows action"]
    returns: Float[Tensor, "lanes rows"]
    discounts: Float[Tensor, "lanes rows"]
    mask: Bool[Tensor, "lanes rows"]


def read_rows(
    steps: Steps, scaling: Standardizer, *, largest_return: float, most: int | None = None
) -> LaneRows:
    """Steps as rows of lanes.

    Args:
        steps: with returns; transitions (lanes, n), or trajectories (lanes, n, steps).
        largest_return: unit of the returns.
        most: takes so many evenly spaced real rows of every lane, or all where there are fewer.
    """
    assert steps.returns_to_go is not None and steps.discounts_to_end is not None
    assert steps.final_observations is not None
    mask = steps.mask.flatten(1)
    values = [steps.observations, steps.final_observations, steps.actions]
    values += [steps.returns_to_go.unsqueeze(-1), steps.discounts_to_end.unsqueeze(-1)]
    table = torch.cat(values, dim=-1).flatten(1, -2)
    if most is not None:
        places, mask = evenly_spaced_rows(mask, most)
        table = table.gather(1, places.unsqueeze(-1).expand(-1, -1, table.shape[-1]))
    widths = [value.shape[-1] for value in values]
    states, final, actions, returns, discounts = table.split(widths, dim=-1)
    return LaneRows(
        scaling(states),
        scaling(final),
        actions,
        returns.squeeze(-1) / largest_return,
        discounts.squeeze(-1),
        mask,
    )


def evenly_spaced_rows(
    mask: Bool[Tensor, "lanes rows"], most: int
) -> tuple[Int64[Tensor, "lanes chosen"], Bool[Tensor, "lanes chosen"]]:
    """Places of at most so many real rows of every lane, evenly spaced in their order, and which are real."""
    order = torch.argsort((~mask).int(), dim=1, stable=True)  # real rows first
    numbers = mask.sum(dim=1, keepdim=True)
    taken = numbers.clamp(max=most)
    places = torch.arange(min(most, mask.shape[1]), device=mask.device).expand(len(mask), -1)
    chosen = torch.where(places < taken, places * numbers // taken.clamp(min=1), 0)
    return order.gather(1, chosen), places < taken


def largest_return(problem: Problem, settings: ActorCriticSettings) -> float:
    """The largest discounted sum of absolute rewards in an episode that the data's range allows; not 0."""
    rewards = problem.reward_range if settings.rewards == "stored" else problem.dense_reward_range
    assert rewards is not None, "the request takes dense rewards, so that they are loaded"
    lasting = sum(settings.gamma**step for step in range(problem.horizon))
    return max(map(abs, rewards)) * lasting or 1.0


@dataclass(frozen=True)
class Weighing:
    """Advantages of actions, in units of the largest return, and how much the actions weigh."""

    advantages: Float[Tensor, "lanes rows"]
    weights: Float[Tensor, "lanes rows"]


@dataclass(frozen=True)
class Adapted:
    """Both networks of every lane after the inner step.

    Attributes:
        value: phi'.
        target: (1 - target_step) phi + target_step phi', without gradient.
        policy: theta'.
    """

    value: Weights
    target: Weights
    policy: Weights


@final
class MacawLearner(Algorithm):
    """Inner steps of all lanes at once, and the outer losses that train what they start from."""

    networks: MacawNetworks

    def __init__(self, problem: Problem, settings: TrainingSettings, config: MacawConfig) -> None:
        networks = MacawNetworks(problem, config, generator=problem.generator(0))
        self._config, self._gamma = config, settings.actor_critic.gamma
        self._largest_return = largest_return(problem, settings.actor_critic)
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
        adapted = self.adapted(self.inner_rows(batch["context"]))
        value_loss, policy_loss = self.outer_losses(adapted, self.rows(batch["policy"]))
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

    def adapted(self, rows: LaneRows) -> Adapted:
        """Both networks after one inner step of every lane; the start, for a lane without rows."""
        value, target = self._adapted_value(rows)
        return Adapted(value, target, self._adapted_policy(rows, self.weights_of_rows(rows, value)))

    def _adapted_value(self, rows: LaneRows) -> tuple[Weights, Weights]:
        """The adapted value networks, and the networks of the outer targets."""
        network, rates = self.networks.value, functional.softplus(self.networks.inner.value_rates)

        def inner_loss(weights: Weights, states: Tensor, returns: Tensor, mask: Tensor) -> Tensor:
            return return_regression(self.networks.values(weights, states), returns, mask)

        gradients = vmap(grad(inner_loss), in_dims=(None, 0, 0, 0))(
            network(), rows.states, rows.returns, rows.mask
        )
        with torch.no_grad():  # (1 - k) phi + k phi' is phi after a step with k times the rates
            target = network.descended(gradients, self._config.target_step * rates)
        return network.descended(self._used(gradients), rates), target

    def _adapted_policy(self, rows: LaneRows, weighing: Weighing) -> Weights:
        """The adapted policies."""
        networks, sigma = self.networks, self._config.sigma
        head_weight = functional.softplus(networks.inner.head_weight)

        def inner_loss(
            weights: Weights, states: Tensor, actions: Tensor, advantages: Tensor, own: Tensor, mask: Tensor
        ) -> Tensor:
            outputs, features = networks.policy.run(weights, states)
            likelihoods = gaussian_log_likelihood(actions, torch.tanh(outputs), std=sigma)
            guesses = networks.advantage_guesses(features, actions)
            errors = return_regression(guesses, advantages, mask)
            return weighted_likelihood(likelihoods, own, mask) + head_weight * errors

        gradients = vmap(grad(inner_loss), in_dims=(None, 0, 0, 0, 0, 0))(
            networks.policy(),
            rows.states,
            rows.actions,
            weighing.advantages,
            weighing.weights,
            rows.mask,
        )
        rates = functional.softplus(networks.inner.policy_rates)
        return networks.policy.descended(self._used(gradients), rates)

    def _used(self, gradients: Weights) -> Weights:
        """Inner gradients, as constants if only first derivatives count."""
        return tuple(value.detach() for value in gradients) if self._config.first_order else gradients

    def weights_of_rows(self, rows: LaneRows, value: Weights) -> Weighing:
        """Advantages of the rows' actions under V_phi', and how much they weigh; without gradient."""
        with torch.no_grad():
            final = self.networks.values(value, rows.final_states)
            returns = bootstrapped_return(rows.returns, rows.discounts, final)
            advantages = returns - self.networks.values(value, rows.states)
            weights = advantage_weights(
                advantages,
                rows.mask,
                temperature=self._config.temperature,
                largest=self._config.weight_cap,
            )
        return Weighing(advantages, weights)

    def outer_losses(self, adapted: Adapted, rows: LaneRows) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Losses of V_phi' and of pi_theta', means over lanes of equally many rows."""
        with torch.no_grad():
            final = self.networks.values(adapted.target, rows.final_states)
            targets = bootstrapped_return(rows.returns, rows.discounts, final)
        values = self.networks.values(adapted.value, rows.states)
        means = self.networks.means(adapted.policy, rows.states)
        likelihoods = gaussian_log_likelihood(rows.actions, means, std=self._config.sigma)
        weights = self.weights_of_rows(rows, adapted.value).weights
        return (
            return_regression(values, targets, rows.mask),
            weighted_likelihood(likelihoods, weights, rows.mask),
        )

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        """The policy after one inner step on the trajectories of every lane."""
        steps = pad_trajectories(trajectories, self.problem, gamma=self._gamma)
        with torch.no_grad():  # `grad` differentiates all the same, and keeps nothing for second derivatives
            policy = self.adapted(self.inner_rows(steps)).policy

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
