"""`sac`: two Q, V with a target, and a squashed Gaussian policy that climbs Q, as in the published codes.

BRAC and cloning are options that hold the policy near the data.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.algorithms.core.actor_critic.base import (
    LARGEST_Q,
    ActorCritic,
    ConditionedRows,
    divergence_limits,
    value_bounds,
)
from tcmrl_algo.algorithms.core.losses import Scalar, q_loss
from tcmrl_algo.algorithms.core.method import Metrics
from tcmrl_algo.algorithms.core.networks import (
    Perceptron,
    PerceptronEnsemble,
    call_frozen,
    follow,
    held_between,
    momentum_copy,
)
from tcmrl_algo.algorithms.core.optimizer import Adam
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import BracSettings


def value_loss(values: Float[Tensor, " rows"], targets: Float[Tensor, " rows"]) -> Scalar:
    """Mean (V(s, c) - [min_k Q_k(s, a~pi, c) - alpha log pi(a|s, c)])^2; no gradient reaches the targets."""
    return functional.mse_loss(values, targets.detach())


def policy_loss(
    log_probabilities: Float[Tensor, " rows"],
    q_values: Float[Tensor, " rows"],
    *,
    entropy: float,
) -> Scalar:
    """Mean of alpha log pi(a|s, c) - min_k Q_k(s, a, c) over a ~ pi, reparameterised."""
    return (entropy * log_probabilities - q_values).mean()


def cloning_loss(
    acted: Float[Tensor, "rows action"],
    actions: Float[Tensor, "rows action"],
    q_values: Float[Tensor, " rows"],
) -> Scalar:
    """The mean of |Q| times the mean squared difference of the policy's and the stored actions.

    TD3+BC (Fujimoto & Gu, 2021, equations 3 and 4) divides Q by mean |Q| instead and multiplies it by 2.5: a
    weight of 1 / 2.5 = 0.4 here, up to the scale of the whole loss. No gradient reaches mean |Q|.
    """
    return q_values.detach().abs().mean() * functional.mse_loss(acted, actions)


def dual_divergence(
    behavior: Float[Tensor, " rows"], policy: Float[Tensor, " rows"]
) -> Float[Tensor, " rows"]:
    """BRAC's dual estimate of KL(pi || behavior) at each state: log softplus(c_p) - softplus(c_b) + 1.

    Args:
        behavior: dual critic at stored actions, c_b.
        policy: dual critic at the policy's actions, c_p. softplus(c) estimates pi / behavior.
    """
    ratio = functional.softplus(policy).clamp(min=1e-12)  # log of an underflowed ratio would be -inf
    return torch.log(ratio) - functional.softplus(behavior) + 1.0


def gradient_penalty(gradients: Float[Tensor, "rows inputs"]) -> Scalar:
    """Mean of max(|grad c| - 1, 0)^2 over points between behavior and policy actions.

    Deviation: the published code penalises the critic's output; this is the gradient's norm.
    """
    norms = (gradients.square().sum(dim=-1) + 1e-12).sqrt()
    return functional.relu(norms - 1.0).square().mean()


@dataclass(frozen=True)
class PolicyActions:
    """Actions drawn from the policy.

    Attributes:
        log_probabilities: (rows,), of the squashed actions.
        mean: (rows, action_dim), before squashing.
        log_std: (rows, action_dim), before squashing.
    """

    actions: Float[Tensor, "rows action"]
    log_probabilities: Float[Tensor, " rows"]
    mean: Float[Tensor, "rows action"]
    log_std: Float[Tensor, "rows action"]


@final
class PolicyNetwork(nn.Module):
    """A Gaussian with diagonal covariance, squashed by tanh.

    Log standard deviations are held in [log_std_min, log_std_max] by `held_between`.
    """

    def __init__(
        self,
        inputs: int,
        action_dim: int,
        *,
        hidden: Sequence[int],
        log_std_range: tuple[float, float],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.log_std_range = log_std_range
        self.perceptron = Perceptron((inputs, *hidden, 2 * action_dim), generator=generator)

    def forward(
        self, inputs: Float[Tensor, "rows inputs"]
    ) -> tuple[Float[Tensor, "rows action"], Float[Tensor, "rows action"]]:
        """Mean and log standard deviation before squashing."""
        mean, free = self.perceptron(inputs).chunk(2, dim=-1)
        return mean, held_between(free, *self.log_std_range)

    def most_likely(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "rows action"]:
        """The squashed mean."""
        return torch.tanh(self(inputs)[0])

    def sample(
        self, inputs: Float[Tensor, "rows inputs"], noise: Float[Tensor, "rows action"]
    ) -> PolicyActions:
        """Reparameterised actions from standard normal noise.

        log pi(a) = sum over dimensions of log N(u) - log(1 - tanh(u)^2), the latter as
        2 (log 2 - u - softplus(-2u)), which is exact for large |u|.
        """
        mean, log_std = self(inputs)
        free = mean + log_std.exp() * noise
        normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        squash = 2.0 * (math.log(2.0) - free - functional.softplus(-2.0 * free))
        return PolicyActions(torch.tanh(free), (normal - squash).sum(dim=-1), mean, log_std)


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


@final
class SoftActorCritic(ActorCritic):
    """Critics and policy conditioned on a context, which the critics alone may train, where asked."""

    def make_networks(self, problem: Problem, inputs: int, generator: torch.Generator) -> None:
        settings, hidden = self.settings, self.settings.hidden
        self.bounds = value_bounds(settings, problem)
        with_action = (inputs + problem.action_dim, *hidden)
        self.critics = PerceptronEnsemble(2, with_action, generator=generator)
        self.value = Perceptron((inputs, *hidden, 1), generator=generator)
        self.target_value = momentum_copy(self.value)
        self.policy = PolicyNetwork(
            inputs,
            problem.action_dim,
            hidden=hidden,
            log_std_range=settings.log_std_range,
            generator=generator,
        )
        self.brac: DualCritic | None = None
        if settings.brac.mode != "off":
            self.brac = DualCritic(settings.brac, with_action, generator=generator)

    def most_likely(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "rows action"]:
        return self.policy.most_likely(inputs)

    def losses(self, rows: ConditionedRows, generator: torch.Generator) -> tuple[Tensor, Metrics]:
        settings = self.settings
        with torch.no_grad():
            next_values = self.target_value(rows.next_inputs).squeeze(-1)
            if settings.clip_targets:
                low, high = self.bounds  # a penalised V may lie below what rewards alone add up to
                next_values = next_values.clamp(None if settings.brac.mode == "value" else low, high)
        q_values = self.critics(torch.cat([rows.critic_inputs, rows.actions], dim=-1))
        critic_loss = q_loss(q_values, rows.rewards, rows.terminated, next_values, gamma=settings.gamma)

        noise = torch.randn(rows.actions.shape, generator=generator).to(rows.actions.device)
        sample = self.policy.sample(rows.inputs, noise)
        acted = torch.cat([rows.inputs, sample.actions], dim=-1)
        acted_values = call_frozen(self.critics, acted).amin(dim=0)
        targets = acted_values - settings.entropy * sample.log_probabilities
        actor_loss = policy_loss(sample.log_probabilities, acted_values, entropy=settings.entropy)
        if settings.cloning > 0:
            actor_loss = actor_loss + settings.cloning * cloning_loss(
                sample.actions, rows.actions, acted_values
            )
        metrics: Metrics = {}
        if self.brac is not None:
            divergences = self.brac.divergences(rows, acted)
            actor_loss = actor_loss + self.brac.alpha * divergences.mean()
            if settings.brac.mode == "value":
                targets = targets - self.brac.alpha * divergences
            metrics = {
                "actor_critic/divergence": divergences.mean(),
                "actor_critic/brac_alpha": self.brac.alpha.clone(),
            }
        values = self.value(rows.inputs).squeeze(-1)
        state_value_loss = value_loss(values, targets)
        seen = q_values.detach()
        total = critic_loss + state_value_loss + actor_loss + self._regularization(sample)
        metrics |= {
            "loss/critic": critic_loss,
            "loss/value": state_value_loss,
            "loss/policy": actor_loss,
            "actor_critic/q": seen.mean(),
            LARGEST_Q: seen.abs().amax(),
            "actor_critic/policy_std": sample.log_std.detach().exp().mean(),
        }
        return total, metrics

    def _regularization(self, sample: PolicyActions) -> Tensor:
        return (
            self.settings.mean_regularization * sample.mean.square().mean()
            + self.settings.std_regularization * sample.log_std.square().mean()
        )

    def limits(self) -> dict[str, float]:
        return divergence_limits(self.settings, self.bounds)

    def optimizers(self) -> dict[str, Adam]:
        return {} if self.brac is None else {"dual": self.brac.optimizer}

    def train_dual(self, rows: ConditionedRows, generator: torch.Generator) -> None:
        """Trains BRAC's dual critic, where there is one, on the current policy; call before `losses`."""
        if self.brac is None:
            return
        for _ in range(self.settings.brac.steps):
            noise = torch.randn(rows.actions.shape, generator=generator).to(rows.actions.device)
            with torch.no_grad():
                actions = self.policy.sample(rows.inputs, noise).actions
            mixture = torch.rand(len(actions), 1, generator=generator).to(actions.device)
            self.brac.train_once(rows, actions, mixture)

    def after_step(self) -> None:
        """Moves V's target by tau towards V, and BRAC's alpha by one step of dual descent."""
        follow(self.target_value, self.value, step=self.settings.tau)
        if self.brac is not None:
            self.brac.adapt_alpha()
