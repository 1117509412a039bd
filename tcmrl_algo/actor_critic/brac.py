"""Behavior regularisation by a dual critic (BRAC, FOCAL)."""

from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tcmrl_algo.actor_critic.rows import ConditionedRows
from tcmrl_algo.losses.actor_critic import dual_divergence, gradient_penalty
from tcmrl_algo.networks.optimizer import Adam
from tcmrl_algo.networks.perceptron import Perceptron, call_frozen
from tcmrl_algo.settings.brac import BracSettings


@final
class DualCritic(nn.Module):
    """Estimates KL(policy || behavior) and steers its weight alpha."""

    alpha: Tensor
    last_divergence: Tensor

    def __init__(self, settings: BracSettings, sizes: tuple[int, ...], *, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.network = Perceptron((*sizes, 1), generator=generator)
        self.optimizer = Adam(self.network.named_parameters(), learning_rate=settings.learning_rate)
        self.register_buffer("alpha", torch.tensor(settings.alpha))
        self.register_buffer("last_divergence", torch.tensor(0.0))

    def divergences(
        self, rows: ConditionedRows, acted: Float[Tensor, "rows inputs"]
    ) -> Float[Tensor, " rows"]:
        """The estimate at each state under a fixed dual critic; its gradient reaches the policy's actions."""
        behavior = torch.cat([rows.inputs, rows.actions], dim=-1)
        result = dual_divergence(
            call_frozen(self.network, behavior).squeeze(-1), call_frozen(self.network, acted).squeeze(-1)
        )
        self.last_divergence.copy_(result.detach().mean())
        return result

    def train_once(self, rows: ConditionedRows, actions: Tensor, mixture: Tensor) -> None:
        """One ascent step of the dual objective, with a penalty on its gradient between the two actions."""
        between = (mixture * rows.actions + (1.0 - mixture) * actions).requires_grad_()
        scores = self.network(torch.cat([rows.inputs, between], dim=-1))
        (gradients,) = torch.autograd.grad(scores.sum(), between, create_graph=True)
        behavior = self.network(torch.cat([rows.inputs, rows.actions], dim=-1)).squeeze(-1)
        policy = self.network(torch.cat([rows.inputs, actions], dim=-1)).squeeze(-1)
        loss = self.settings.penalty * gradient_penalty(gradients) - dual_divergence(behavior, policy).mean()
        self.optimizer.step(loss)

    def adapt_alpha(self) -> None:
        """Raises alpha while the divergence exceeds its target, lowers it below."""
        settings = self.settings
        change = settings.alpha_learning_rate * (self.last_divergence - settings.target)
        self.alpha.add_(change).clamp_(0.0, settings.largest_alpha)
