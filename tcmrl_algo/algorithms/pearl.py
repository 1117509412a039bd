"""PEARL in batch mode (Rakelly et al., 2019): a posterior over contexts, trained by what the critics miss.

Every transition gives a Gaussian factor, their product is q(z | c), and the encoder descends the losses of
both Q plus 0.1 KL(q || N(0, I)), summed over tasks and dimensions. V, the policy and targets see z detached.
The actor-critic is ours; with the recipe's behavior regularisation it is "Batch PEARL" of later papers.

A z is drawn from the prior in the first episodes of a protocol, of which there may be many (published code:
one or two), and then from the posterior whenever the context has grown.

Our inference: a draw from the posterior depends on the run's seed and on the number of trajectories alone, so
that adaptation is deterministic and a task's context does not depend on its neighbours. Final episodes, all
of which have contexts of one size, therefore share one standard normal draw, which other seeds draw anew. A
draw from the prior depends besides on the lane's place among those that are stepped together.

As in the published code, how much the divergence weighs depends on the scale of the rewards: the critics'
losses grow with its square. Where a profile divides `actor_critic.reward_scale` by n, its `kl_weight` is
divided by n squared, or is smaller by experiment; otherwise the posterior collapses to the prior.
"""

from collections.abc import Sequence
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Bool, Float, Int64
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from tcmrl_algo.algorithms.core.actor_critic.base import ActorCritic
from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextEncoder,
    ContextLearner,
    ContextLosses,
    policy_transitions,
)
from tcmrl_algo.algorithms.core.losses import gaussian_divergence
from tcmrl_algo.algorithms.core.method import (
    SHARED_SEARCH,
    Algorithm,
    Capabilities,
    Factors,
    Method,
    MethodConfig,
    Search,
)
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Controller, Steps, Trajectories, Trajectory

POSTERIOR_STREAM, PRIOR_STREAM = 2, 3
"""Of the draws at test, apart from those of training."""

SMALLEST_VARIANCE = 1e-7
"""Of a factor of a product, whose precision would be infinite below (published code of PEARL)."""


class PearlConfig(MethodConfig):
    """The `[training.pearl]` table.

    Attributes:
        latent: size of contexts (published code: 5).
        encoder_hidden: widths of the context encoder (published code: 200 x 3).
        kl_weight: of the divergence from the prior (published code: 0.1).
        prior_std: standard deviation of the prior (published code: 1; 0.05 in copies of FOCAL's line).
        test_context: a `sample` of the posterior (published code), or its `mean`.
    """

    latent: int = Field(default=5, ge=1)
    encoder_hidden: tuple[int, ...] = (200, 200, 200)
    kl_weight: float = Field(default=0.1, ge=0)
    prior_std: float = Field(default=1.0, gt=0)
    test_context: Literal["sample", "mean"] = "sample"


def product_of_gaussians(
    means: Float[Tensor, "lanes steps latent"],
    variances: Float[Tensor, "lanes steps latent"],
    mask: Bool[Tensor, "lanes steps"],
) -> tuple[Float[Tensor, "lanes latent"], Float[Tensor, "lanes latent"]]:
    """Mean and variance of prod_t N(mu_t, sigma_t^2), up to its scale (PEARL, Rakelly et al., 2019).

    sigma^2 = 1 / sum_t 1 / sigma_t^2, mu = sigma^2 sum_t mu_t / sigma_t^2. Padding has precision 0; without a
    real step the result is the prior N(0, I), which is no factor otherwise.
    """
    precisions = torch.where(mask.unsqueeze(-1), 1.0 / variances.clamp(min=SMALLEST_VARIANCE), 0.0)
    some = mask.any(dim=1, keepdim=True)
    precision = torch.where(some, precisions.sum(dim=1), 1.0)
    weighted = torch.where(mask.unsqueeze(-1), means * precisions, 0.0)
    return weighted.sum(dim=1) / precision, 1.0 / precision


@final
class PearlLearner(ContextLearner):
    """The encoder of factors."""

    def __init__(self, problem: Problem, config: PearlConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.latent, self._config, self._problem = config.latent, config, problem
        self.encoder = ContextEncoder(
            problem, latent=2 * config.latent, hidden=config.encoder_hidden, generator=generator
        )

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The divergence from the prior; the gradient of the critics comes through the drawn contexts."""
        mean, variance = self.posterior(batch["context"])
        prior_variance = torch.full_like(variance, self._config.prior_std**2)
        divergence = gaussian_divergence(mean, variance, torch.zeros_like(mean), prior_variance).sum()
        noise = torch.randn(mean.shape, generator=generator).to(mean.device)
        context = mean + variance.sqrt() * noise
        metrics = {
            "loss/divergence": divergence,
            "context/posterior_std": variance.sqrt().mean(),
            "context/spread": mean.std(dim=0).mean(),
        }
        return ContextLosses(self._config.kl_weight * divergence, context, metrics, critic_gradient=True)

    def posterior(self, steps: Steps) -> tuple[Float[Tensor, "lanes latent"], Float[Tensor, "lanes latent"]]:
        """Mean and variance of q(z | c) of every lane; the prior's, where a lane has no step."""
        (factors,) = self.encoder.unbounded(self.encoder.read(steps))
        means, free = factors.flatten(1, 2).chunk(2, dim=-1)
        mask = steps.mask.flatten(1, 2)
        mean, variance = product_of_gaussians(means, functional.softplus(free), mask)
        some = mask.any(dim=1, keepdim=True)
        return mean, torch.where(some, variance, self._config.prior_std**2)

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        mean, variance = self.posterior(steps)
        if self._config.test_context == "mean":
            return mean
        return mean + variance.sqrt() * self._noise(steps.mask.any(dim=-1).sum(dim=-1))

    def _noise(self, numbers: Int64[Tensor, " lanes"]) -> Float[Tensor, "lanes latent"]:
        """Standard normal draws, one for every number of trajectories."""
        draws = {
            number: torch.randn(self.latent, generator=self._problem.generator(number, POSTERIOR_STREAM))
            for number in set(numbers.tolist())
        }
        return torch.stack([draws[number] for number in numbers.tolist()]).to(numbers.device)

    def explore(self, actor_critic: ActorCritic, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        """The policy under a context from the prior, by number of trajectories and place of the lane."""
        generator = self._problem.generator(max(map(len, trajectories)), PRIOR_STREAM)
        # One by one: a larger draw would not begin with the numbers of a smaller one.
        noise = torch.stack([torch.randn(self.latent, generator=generator) for _ in trajectories])
        return actor_critic.controller(self._config.prior_std * noise.to(self._problem.device))


@final
class Pearl(Method[PearlConfig]):
    """The plug-in."""

    name = "pearl"
    Config = PearlConfig
    capabilities = Capabilities(explores=True, noisy_contexts=True, needs_trajectories=False)
    search: ClassVar[Search] = {**SHARED_SEARCH, "pearl.kl_weight": Factors(0.01, 100.0)}

    def batch_request(self, settings: TrainingSettings, config: PearlConfig) -> BatchRequest:
        """Transitions for the actor-critic, and trajectories of the same task for the posterior."""
        batch = settings.batch
        return BatchRequest(
            batch.tasks,
            {
                "policy": policy_transitions(settings),
                "context": Trajectories(batch.context_trajectories),
            },
        )

    def create(self, problem: Problem, settings: TrainingSettings, config: PearlConfig) -> Algorithm:
        learner = PearlLearner(problem, config, generator=problem.generator(0))
        return ContextAlgorithm(problem, settings, learner=learner)
