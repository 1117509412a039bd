"""The offline actor-critic under every context-based method: two Q, V with a target, a Gaussian policy."""

import copy
from dataclasses import dataclass
from typing import Literal, final

import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from tcmrl_algo.losses.context import dual_divergence, gradient_penalty, policy_loss, q_loss, value_loss
from tcmrl_algo.methods.problem import Metrics, Problem
from tcmrl_algo.networks.optimizer import Adam
from tcmrl_algo.networks.perceptron import Perceptron, PerceptronEnsemble, Standardizer, call_frozen
from tcmrl_algo.networks.policy import GaussianPolicy, PolicySample
from tcmrl_data import Steps

LARGEST_Q = "actor_critic/largest_q"


class BracSettings(BaseModel):
    """The `[training.actor_critic.brac]` table: behavior regularisation by a dual KL estimate (BRAC, FOCAL).

    Attributes:
        mode: `off`; `policy` adds alpha D to the policy loss; `value` also subtracts alpha D(s) from the
            target of V(s) (published code: on for MuJoCo and Meta-World, off for the point robots; from the
            target of Q, with the D of the state before).
        alpha: start of the divergence's weight (published code: 50).
        largest_alpha: its bound (published code: 2e3; 1e4 for Hopper and Walker).
        alpha_learning_rate: step of alpha's dual descent (ours).
        target: divergence that alpha's dual descent aims at (published code: 0.05).
        learning_rate: of the dual critic (paper, F.2: 1e-4).
        steps: dual critic steps per training step (published code: 3).
        penalty: weight of the gradient penalty (published code: 5).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: Literal["off", "policy", "value"] = "off"
    alpha: float = Field(default=50.0, ge=0)
    largest_alpha: float = Field(default=2000.0, gt=0)
    alpha_learning_rate: float = Field(default=1.0, gt=0)
    target: float = Field(default=0.05, ge=0)
    learning_rate: float = Field(default=1e-4, gt=0)
    steps: int = Field(default=3, ge=1)
    penalty: float = Field(default=5.0, ge=0)


class ActorCriticSettings(BaseModel):
    """The `[training.actor_critic]` table.

    Attributes:
        hidden: widths of all networks here (published code: 256 x 3).
        gamma: discount factor (paper, F.2: 0.99; published code: 0.9 for the point robots).
        reward_scale: multiplies rewards (published code: 5; 100 for the point robots).
        entropy: alpha in front of log pi (published code: 1, beside rewards scaled by 5 or 100).
        tau: step of V's target towards V (published code: 0.005).
        mean_regularization: weight of the squared policy means (published code: 1e-3).
        std_regularization: weight of the squared policy log standard deviations (published code: 1e-3).
        log_std_range: bounds of the policy's log standard deviation (published code: [-20, 0]).
        clip_targets: hold V(s') within what the data's rewards allow (ours: critics trained on narrow data
            believe in states outside it).
        divergence_factor: training stops where some |Q| exceeds what the data's rewards allow this many times
            (ours; Q that diverges grows without end, so that the number hardly matters).
        brac: behavior regularisation.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    hidden: tuple[int, ...] = (256, 256, 256)
    gamma: float = Field(default=0.99, ge=0, lt=1)
    reward_scale: float = Field(default=5.0, gt=0)
    entropy: float = Field(default=1.0, ge=0)
    tau: float = Field(default=0.005, gt=0, le=1)
    mean_regularization: float = Field(default=1e-3, ge=0)
    std_regularization: float = Field(default=1e-3, ge=0)
    log_std_range: tuple[float, float] = (-20.0, 0.0)
    clip_targets: bool = True
    divergence_factor: float = Field(default=100.0, gt=1)
    brac: BracSettings = BracSettings()


@dataclass(frozen=True)
class Rows:
    """Transitions of all tasks in one flat batch; states are standardised and followed by their context."""

    inputs: Float[Tensor, "rows inputs"]
    next_inputs: Float[Tensor, "rows inputs"]
    actions: Float[Tensor, "rows action"]
    rewards: Float[Tensor, " rows"]
    terminated: Float[Tensor, " rows"]


def value_bounds(settings: ActorCriticSettings, problem: Problem) -> tuple[float, float]:
    """Lowest and highest V that rewards within the data's range can add up to.

    An episode may end after one step, or go on forever: time limits do not cut the sum. The highest V
    includes the largest entropy bonus; the lowest leaves out what a narrow policy's entropy takes away.
    """
    lowest, highest = (settings.reward_scale * each for each in problem.reward_range)
    most_steps = 1.0 / (1.0 - settings.gamma)
    bonus = settings.entropy * problem.action_dim * 0.6931471805599453  # ln 2: uniform in [-1, 1]
    return min(lowest, lowest * most_steps), max(highest + bonus, (highest + bonus) * most_steps)


@final
class ActorCritic(nn.Module):
    """Critics and policy conditioned on a context whose gradient they never touch.

    Args:
        settings: the resolved table.
        problem: sizes and moments of the data.
        latent: size of the context; 0 makes everything blind to the task.
        generator: draws the starts.
    """

    def __init__(
        self, settings: ActorCriticSettings, problem: Problem, *, latent: int, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.settings, self.latent, self.action_dim = settings, latent, problem.action_dim
        self.bounds = value_bounds(settings, problem)
        self.scaling = Standardizer(problem.observation_mean, problem.observation_std)
        inputs, hidden = problem.observation_dim + latent, settings.hidden
        with_action = (inputs + problem.action_dim, *hidden)
        self.critics = PerceptronEnsemble(2, with_action, generator=generator)
        self.value = Perceptron((inputs, *hidden, 1), generator=generator)
        self.target_value = copy.deepcopy(self.value).requires_grad_(False)
        self.policy = GaussianPolicy(
            inputs,
            problem.action_dim,
            hidden=hidden,
            log_std_range=settings.log_std_range,
            generator=generator,
        )
        self.brac: DualCritic | None = None
        if settings.brac.mode != "off":
            self.brac = DualCritic(settings.brac, with_action, generator=generator)

    def rows(self, steps: Steps, context: Float[Tensor, "tasks latent"]) -> Rows:
        """Flattens transitions (tasks, n) and gives each its task's context, detached."""
        num_rows = steps.rewards.numel()
        spread = context.detach().unsqueeze(1).expand(-1, steps.rewards.shape[1], -1).reshape(num_rows, -1)
        states = torch.stack([steps.observations, steps.next_observations]).reshape(2, num_rows, -1)
        inputs = torch.cat([self.scaling(states), spread.expand(2, -1, -1)], dim=-1)
        return Rows(
            inputs[0],
            inputs[1],
            steps.actions.reshape(num_rows, -1),
            steps.rewards.reshape(num_rows) * self.settings.reward_scale,
            steps.terminated.reshape(num_rows),
        )

    def losses(self, rows: Rows, generator: torch.Generator) -> tuple[Tensor, Metrics]:
        """The sum of all losses and its parts; each part trains its own network alone.

        Args:
            rows: transitions with their contexts.
            generator: draws the policy's actions.
        """
        settings = self.settings
        with torch.no_grad():
            next_values = self.target_value(rows.next_inputs).squeeze(-1)
            if settings.clip_targets:
                low, high = self.bounds  # a penalised V may lie below what rewards alone add up to
                next_values = next_values.clamp(None if settings.brac.mode == "value" else low, high)
        q_values = self.critics(torch.cat([rows.inputs, rows.actions], dim=-1))
        critic_loss = q_loss(q_values, rows.rewards, rows.terminated, next_values, gamma=settings.gamma)

        noise = torch.randn(rows.actions.shape, generator=generator).to(rows.actions.device)
        sample = self.policy.sample(rows.inputs, noise)
        acted = torch.cat([rows.inputs, sample.actions], dim=-1)
        acted_values = call_frozen(self.critics, acted).amin(dim=0)
        targets = acted_values - settings.entropy * sample.log_probabilities
        actor_loss = policy_loss(sample.log_probabilities, acted_values, entropy=settings.entropy)
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
        total = critic_loss + state_value_loss + actor_loss + self._regularization(sample)
        metrics |= {
            "loss/critic": critic_loss,
            "loss/value": state_value_loss,
            "loss/policy": actor_loss,
            "actor_critic/q": q_values.mean(),
            LARGEST_Q: q_values.abs().amax(),
            "actor_critic/policy_std": sample.log_std.exp().mean(),
        }
        return total, metrics

    def _regularization(self, sample: PolicySample) -> Tensor:
        return (
            self.settings.mean_regularization * sample.mean.square().mean()
            + self.settings.std_regularization * sample.log_std.square().mean()
        )

    def limits(self) -> dict[str, float]:
        """The |Q| that tells divergence; at least the factor itself, where rewards are next to nothing."""
        return {LARGEST_Q: self.settings.divergence_factor * max(1.0, *map(abs, self.bounds))}

    def optimizers(self) -> dict[str, Adam]:
        """Optimisers that this object steps itself, by name."""
        return {} if self.brac is None else {"dual": self.brac.optimizer}

    def train_dual(self, rows: Rows, generator: torch.Generator) -> None:
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
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.target_value.parameters()), list(self.value.parameters()), self.settings.tau
            )
            if self.brac is not None:
                self.brac.adapt_alpha()

    def act(
        self, observations: Float[Tensor, "lanes observation"], context: Float[Tensor, "lanes latent"]
    ) -> Float[Tensor, "lanes action"]:
        """The policy's most likely actions, without noise."""
        with torch.no_grad():
            mean, _ = self.policy(torch.cat([self.scaling(observations), context], dim=-1))
            return torch.tanh(mean)


@final
class DualCritic(nn.Module):
    """Estimates KL(policy || behavior) and steers its weight alpha."""

    alpha: Tensor
    last_divergence: Tensor

    def __init__(self, settings: BracSettings, sizes: tuple[int, ...], *, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.network = Perceptron((*sizes, 1), generator=generator)
        self.optimizer = Adam(self.network, learning_rate=settings.learning_rate)
        self.register_buffer("alpha", torch.tensor(settings.alpha))
        self.register_buffer("last_divergence", torch.tensor(0.0))

    def divergences(self, rows: Rows, acted: Float[Tensor, "rows inputs"]) -> Float[Tensor, " rows"]:
        """The estimate at each state under a fixed dual critic; its gradient reaches the policy's actions."""
        behavior = torch.cat([rows.inputs, rows.actions], dim=-1)
        result = dual_divergence(
            call_frozen(self.network, behavior).squeeze(-1), call_frozen(self.network, acted).squeeze(-1)
        )
        self.last_divergence.copy_(result.detach().mean())
        return result

    def train_once(self, rows: Rows, actions: Tensor, mixture: Tensor) -> None:
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
