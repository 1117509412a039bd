"""MACAW's inner step and the outer losses of what it gives, for all lanes at once."""

from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import grad, vmap
from torch.nn import functional

from tcmrl_algo.algorithms.macaw.config import MacawConfig
from tcmrl_algo.algorithms.macaw.networks import MacawNetworks, Weights
from tcmrl_algo.algorithms.macaw.rows import LaneRows
from tcmrl_algo.losses.advantage_regression import (
    advantage_weights,
    bootstrapped_return,
    gaussian_log_likelihood,
    return_regression,
    weighted_likelihood,
)


@dataclass(frozen=True)
class Weighing:
    """Advantages of actions, in units of the largest return, and how much the actions weigh.

    Attributes:
        advantages: (lanes, rows).
        weights: (lanes, rows), positive.
    """

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
class InnerStep:
    """One gradient step of every lane on its rows, through which the outer losses differentiate.

    Args:
        networks: what the steps start from.
        config: of the method.
    """

    def __init__(self, networks: MacawNetworks, config: MacawConfig) -> None:
        self.networks, self._config = networks, config

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
