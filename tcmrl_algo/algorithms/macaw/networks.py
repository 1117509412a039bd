"""MACAW's networks, and the learnt settings of its inner steps."""

import math
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tcmrl_algo.algorithms.macaw.config import MacawConfig
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.networks.perceptron import Perceptron, Standardizer
from tcmrl_algo.networks.weight_linear import LayerWeights, WeightPerceptron

Weights = tuple[LayerWeights, ...]
"""Of all layers of a network; of every lane, or of the start."""


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
        states, actions, hidden, code = (
            problem.observation_dim,
            problem.action_dim,
            config.hidden,
            config.code,
        )
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
