"""CSRO (Gao et al., 2023): contexts without what the behavior policy alone explains.

FOCAL's encoder, with L = 10 L_distance + lambda L_club. L_club bounds the information that z_t holds about
(s_t, a_t) from above, by a network q(z | s, a) that an Adam of its own trains: a context shall tell the task,
not who collected it. At test the first episodes are collected without a prior context: see `random_share`,
and the protocol `non_prior`, under which every method can be evaluated.

A step trains q on detached z_t first; then its outputs, held fixed, give L_club, whose gradient reaches the
encoder through z_t alone. The actor-critic, ours as for FOCAL, sees detached contexts.

Deviations: the published meta-batch holds every task once, so that L_distance there only repels; `positives`
chooses between that and the equation, where contexts of a task attract by d^2, as in FOCAL's paper. The
published code squashes the variance of q together with its mean, by oversight, yet lambda was chosen with it:
if the variance is free to fall, L_club grows without bound as q learns, and lambda 25 made all contexts equal
on the point robot within 400 steps. See `variance`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.algorithms.core.actor_critic.base import ActorCritic
from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextEncoder,
    ContextLearner,
    ContextLosses,
    trajectory_request,
)
from tcmrl_algo.algorithms.core.losses import Scalar, distance_metric_loss, masked_mean
from tcmrl_algo.algorithms.core.method import (
    SHARED_SEARCH,
    Algorithm,
    Capabilities,
    Factors,
    Method,
    MethodConfig,
    Search,
)
from tcmrl_algo.algorithms.core.networks import Perceptron, mean_representation
from tcmrl_algo.algorithms.core.optimizer import Adam
from tcmrl_algo.algorithms.core.problem import Problem, pad_trajectories
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Controller, Steps, Trajectory, UniformController

SMALLEST_VARIANCE = 1e-4
"""Of q(z | s, a), so that its likelihood stays bounded."""


class CsroConfig(MethodConfig):
    """The `[training.csro]` table. The loss of q has no weight: it alone trains q, and Adam has no scale.

    Attributes:
        latent: size of representations and contexts (published code: 20; 40 for Walker).
        encoder_hidden: widths of the context encoder (published code: 200 x 3).
        club_hidden: widths of q(z | s, a) (published code: 200 x 3).
        club_learning_rate: of its Adam (published code: 3e-4).
        penalty: lambda (published code: 25; 10 for Half-Cheetah-Vel).
        distance_weight: of FOCAL's distance-metric loss (published code: 10).
        epsilon: bounds the repulsion of two tasks' contexts (published code: 0.1).
        positives: `trajectories` also draws the contexts of a task's trajectories together, as the equation
            does; `none` only repels the contexts of tasks, as the published code does.
        variance: `literal` squashes the variance of q to [0.31, 1.31] (published code); `softplus` leaves it
            free, and needs a much smaller `penalty`.
        random_share: share of `run.random_episodes` that act uniformly; in the others the policy acts under
            the context of those before (published code: half of the exploration). 1 collects as other
            methods do.
    """

    latent: int = Field(default=20, ge=1)
    encoder_hidden: tuple[int, ...] = (200, 200, 200)
    club_hidden: tuple[int, ...] = (200, 200, 200)
    club_learning_rate: float = Field(default=3e-4, gt=0)
    penalty: float = Field(default=25.0, ge=0)
    distance_weight: float = Field(default=10.0, ge=0)
    epsilon: float = Field(default=0.1, gt=0)
    positives: Literal["none", "trajectories"] = "trajectories"
    variance: Literal["softplus", "literal"] = "literal"
    random_share: float = Field(default=0.5, gt=0, le=1)


def club_likelihood(
    representations: Float[Tensor, "tasks steps latent"],
    mean: Float[Tensor, "tasks steps latent"],
    variance: Float[Tensor, "tasks steps latent"],
    mask: Bool[Tensor, "tasks steps"],
) -> Scalar:
    """Mean of (z - mu)^2 / (2 sigma^2) + log(sigma^2) / 2: what trains q(z | s, a) (CSRO, Gao et al., 2023).

    The constant of the Gaussian is left out.
    """
    terms = 0.5 * ((representations - mean).square() / variance + variance.log())
    return masked_mean(terms.mean(dim=-1), mask)


def club_penalty(
    representations: Float[Tensor, "tasks steps latent"],
    mean: Float[Tensor, "tasks steps latent"],
    variance: Float[Tensor, "tasks steps latent"],
    mask: Bool[Tensor, "tasks steps"],
) -> Scalar:
    """CSRO's bound of I(z; s, a): P - N, P = -mean_t (z_t - mu_t)^2 / sigma_t^2, N = the same over all pairs.

    N = -mean_ij (z_j - mu_i)^2 / sigma_i^2 over pairs of one task, i = j included. The published code expands
    all pairs; here mean_j (z_j - mu_i)^2 = Var_j(z_j) + (mean_j z_j - mu_i)^2, with the biased variance.
    As in that code there is no 1/2 and a mean over dimensions: the value is 2 / latent times CLUB's estimate
    (Cheng et al., 2020).

    Args:
        mean, variance: of q(z | s_t, a_t); hand them over without gradient.
    """
    real = mask.unsqueeze(-1)
    number = real.sum(dim=1, keepdim=True).clamp(min=1)
    center = torch.where(real, representations, 0.0).sum(dim=1, keepdim=True) / number
    spread = torch.where(real, (representations - center).square(), 0.0).sum(dim=1, keepdim=True) / number
    pairs = spread + (center - mean).square()
    return masked_mean(((pairs - (representations - mean).square()) / variance).mean(dim=-1), mask)


@final
class ClubNetwork(nn.Module):
    """q(z | s, a): a Gaussian with diagonal covariance."""

    def __init__(self, state_action: int, config: CsroConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self._literal = config.variance == "literal"
        sizes = (state_action, *config.club_hidden, 2 * config.latent)
        self.perceptron = Perceptron(sizes, generator=generator)

    def forward(
        self, state_actions: Float[Tensor, "tasks steps inputs"]
    ) -> tuple[Float[Tensor, "tasks steps latent"], Float[Tensor, "tasks steps latent"]]:
        """Mean, in [-1, 1] as representations are, and variance."""
        mean, free = self.perceptron(state_actions).chunk(2, dim=-1)
        if self._literal:
            return torch.tanh(mean), functional.softplus(torch.tanh(free))
        return torch.tanh(mean), functional.softplus(free) + SMALLEST_VARIANCE


@final
class CsroLearner(ContextLearner):
    """Encoder and mean, and q."""

    def __init__(
        self, problem: Problem, settings: TrainingSettings, config: CsroConfig, *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.latent, self._config, self._problem = config.latent, config, problem
        self._num_uniform = max(1, math.ceil(config.random_share * settings.run.random_episodes))
        self.encoder = ContextEncoder(
            problem, latent=config.latent, hidden=config.encoder_hidden, generator=generator
        )
        self.club = ClubNetwork(self.encoder.state_action, config, generator=generator)
        self._adam = Adam(self.club.named_parameters(), learning_rate=config.club_learning_rate)

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """Trains q, and returns the penalty under the new q and the distances."""
        config = self._config
        groups = [self.encoder.read(batch["context"]), self.encoder.read(batch["execution"])]
        representations = torch.cat(self.encoder(*groups), dim=1)
        mask = torch.cat([group.mask for group in groups], dim=1)
        state_actions = torch.cat([group.state_actions for group in groups], dim=1).flatten(1, 2)
        rows, real = representations.flatten(1, 2), mask.flatten(1, 2)
        mean, variance = self.club(state_actions)
        likelihood = club_likelihood(rows.detach(), mean, variance, real)
        self._adam.step(likelihood)
        with torch.no_grad():
            mean, variance = self.club(state_actions)
        penalty = club_penalty(rows, mean, variance, real)
        distance = self._distance(representations, mask)
        num_context = batch["context"].mask.shape[1]
        context = mean_representation(
            representations[:, :num_context].flatten(1, 2), mask[:, :num_context].flatten(1, 2)
        )
        metrics = {
            "loss/distance": distance,
            "loss/club_penalty": penalty,
            "loss/club_likelihood": likelihood,
            "context/spread": context.std(dim=0).mean(),
        }
        return ContextLosses(config.penalty * penalty + config.distance_weight * distance, context, metrics)

    def _distance(self, representations: Tensor, mask: Tensor) -> Tensor:
        """FOCAL's loss over the contexts of single trajectories, or of whole tasks."""
        if self._config.positives == "none":
            contexts = mean_representation(representations.flatten(1, 2), mask.flatten(1, 2)).unsqueeze(1)
        else:
            single = mean_representation(representations.flatten(0, 1), mask.flatten(0, 1))
            contexts = single.unflatten(0, mask.shape[:2])
        return distance_metric_loss(contexts, epsilon=self._config.epsilon)

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        (representations,) = self.encoder(self.encoder.read(steps))
        return mean_representation(representations.flatten(1, 2), steps.mask.flatten(1, 2))

    def explore(self, actor_critic: ActorCritic, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        """Uniform at first, then the policy under the context of all that was collected."""
        if min(map(len, trajectories)) < self._num_uniform:
            return UniformController()
        with torch.no_grad():
            return actor_critic.controller(self.context(pad_trajectories(trajectories, self._problem)))

    def optimizers(self) -> Mapping[str, Adam]:
        return {"club": self._adam}


@final
class Csro(Method[CsroConfig]):
    """The plug-in."""

    name = "csro"
    Config = CsroConfig
    capabilities = Capabilities(explores=True)
    search: ClassVar[Search] = {
        **SHARED_SEARCH,
        "csro.penalty": Factors(0.01, 10.0),
        "csro.distance_weight": Factors(0.01, 10.0),
    }

    def batch_request(self, settings: TrainingSettings, config: CsroConfig) -> BatchRequest:
        """The `[training.batch]` table without windows."""
        return trajectory_request(settings)

    def create(self, problem: Problem, settings: TrainingSettings, config: CsroConfig) -> Algorithm:
        learner = CsroLearner(problem, settings, config, generator=problem.generator(0))
        return ContextAlgorithm(problem, settings, learner=learner)
