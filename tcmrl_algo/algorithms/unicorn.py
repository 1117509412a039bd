"""UNICORN (Li et al., 2024, arXiv 2402.02429): between what distances and what likelihoods maximise.

With X_b = (s, a) and X_t = (s', r), I(Z; X_t | X_b) <= I(Z; M) <= I(Z; X): a decoder of (s', r) maximises the
lower bound of what a context Z says about the task M, FOCAL's distances the upper one. Self-supervised:

    L = L_reconstruction + beta L_distance,

where z_t = tanh(e(s_t, a_t, r_t, s_{t+1}) + noise), z is the mean of the z_t, and two decoders give Gaussians
of s_{t+1} - s_t and of r_t from (z, s_t, a_t), for the steps that were encoded. Supervised (`sup`):
cross-entropy of the task, which a classifier reads from z. The actor-critic is ours and sees detached
contexts.

Deviations: the encoder reads no end of the episode, and the decoders' targets are standardised. Contexts of a
task attract by d^2, as in FOCAL's paper, and every task has several; in the published code a task is repeated
only where it is drawn twice. The code of
the supervised variant is not public: its classifier is ours, its encoder that of the other variant. Published
code adds noise at test too; here contexts are means over that noise, so that adaptation is deterministic.
"""

import math
from collections.abc import Sequence
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Bool, Float, Int64
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextEncoder,
    ContextLearner,
    ContextLosses,
    EncoderInputs,
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
    Metrics,
    Search,
)
from tcmrl_algo.algorithms.core.networks import Perceptron, held_between, mean_representation
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps

NOISE_LEVELS = 16
"""At how many equally likely values of the noise representations are averaged at test."""

LOG_VARIANCE_START = (-10.0, 0.5)
"""Bounds of the log variance before training (Chua et al., 2018, in the implementation of mbrl-lib)."""


class UnicornConfig(MethodConfig):
    """The `[training.unicorn]` table.

    Attributes:
        mode: `ss`, self-supervised by decoders and distances, or `sup`, supervised by the index of the task.
        latent: size of representations and contexts (published code: 5; 40 for Hopper, 32 for Walker).
        encoder_hidden: widths of the context encoder (published code: 64 x 2; 128 x 2 for Hopper, Walker).
        noise_variance: bounds of the learnt variance of the noise, whose start is 1 (published code).
        beta: weight of the distances, alpha / (1 - alpha) in the paper (published code: 0.15 for
            Half-Cheetah-Vel, 1.5 for Hopper, 0.7 for Walker).
        epsilon: bounds the repulsion of two tasks' contexts (published code: 0.1).
        decoder_hidden: widths of both decoders (published code: 64 x 2).
        bound_weight: of the distance between the bounds of the decoders' log variances (published code).
        reconstruction: which steps are decoded: of the encoded trajectories (`context`, published code), or
            of others of the task (`execution`, ours).
        classifier_hidden: widths of the classifier of `sup` (ours).
    """

    mode: Literal["ss", "sup"] = "ss"
    latent: int = Field(default=5, ge=1)
    encoder_hidden: tuple[int, ...] = (64, 64)
    noise_variance: tuple[float, float] = (0.1, 10.0)
    beta: float = Field(default=0.15, ge=0)
    epsilon: float = Field(default=0.1, gt=0)
    decoder_hidden: tuple[int, ...] = (64, 64)
    bound_weight: float = Field(default=0.01, ge=0)
    reconstruction: Literal["context", "execution"] = "context"
    classifier_hidden: tuple[int, ...] = (64, 64)


def gaussian_reconstruction(
    mean: Float[Tensor, "*rows outputs"],
    log_variance: Float[Tensor, "*rows outputs"],
    targets: Float[Tensor, "*rows outputs"],
    mask: Bool[Tensor, "*rows"],
) -> Scalar:
    """Mean of (x - mu)^2 exp(-log sigma^2) + log sigma^2: twice a Gaussian's -log p(x), without the constant.

    UNICORN's L_recon (Li et al., 2024), whose negative bounds I(z; s', r | s, a) from below up to a constant.
    """
    terms = (targets - mean).square() * (-log_variance).exp() + log_variance
    return masked_mean(terms.mean(dim=-1), mask)


def task_classification(logits: Float[Tensor, "tasks classes"], positions: Int64[Tensor, " tasks"]) -> Scalar:
    """Cross-entropy of the training task, -mean log p(task | z): UNICORN-SUP (Li et al., 2024).

    Args:
        positions: dense index of the task that a context comes from.
    """
    return functional.cross_entropy(logits, positions)


@final
class GaussianPerceptron(nn.Module):
    """Mean and log variance, the latter held between learnt bounds by softplus from either side."""

    def __init__(self, sizes: Sequence[int], *, generator: torch.Generator) -> None:
        super().__init__()
        *first, outputs = sizes
        self.perceptron = Perceptron((*first, 2 * outputs), generator=generator)
        low, high = LOG_VARIANCE_START
        self.lowest = nn.Parameter(torch.full((outputs,), low))
        self.highest = nn.Parameter(torch.full((outputs,), high))

    def forward(
        self, inputs: Float[Tensor, "*rows inputs"]
    ) -> tuple[Float[Tensor, "*rows outputs"], Float[Tensor, "*rows outputs"]]:
        mean, free = self.perceptron(inputs).chunk(2, dim=-1)
        return mean, held_between(free, self.lowest, self.highest)

    def width(self) -> Float[Tensor, ""]:
        """The sum over outputs of the distance between the bounds; a loss that keeps them close."""
        return (self.highest - self.lowest).sum()


@final
class UnicornLearner(ContextLearner):
    """Noisy encoder and mean, and the decoders or the classifier that train it."""

    def __init__(self, problem: Problem, config: UnicornConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.latent, self._config, self._problem = config.latent, config, problem
        self.encoder = ContextEncoder(
            problem, latent=config.latent, hidden=config.encoder_hidden, generator=generator
        )
        self.noise_log_variance = nn.Parameter(torch.zeros(config.latent))
        if config.mode == "sup":
            sizes = (config.latent, *config.classifier_hidden, len(problem.training_tasks))
            self.classifier = Perceptron(sizes, generator=generator)
        else:
            inputs = (config.latent + self.encoder.state_action, *config.decoder_hidden)
            self.reward_decoder = GaussianPerceptron((*inputs, 1), generator=generator)
            self.change_decoder = GaussianPerceptron((*inputs, problem.observation_dim), generator=generator)

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The terms of the variant; the distances are those of single trajectories' contexts."""
        groups = {name: self.encoder.read(batch[name]) for name in ("context", "execution")}
        free = self.encoder.unbounded(*groups.values())
        noise = [torch.randn(part.shape, generator=generator).to(part.device) for part in free]
        parts = [torch.tanh(part + self.noise_std() * drawn) for part, drawn in zip(free, noise, strict=True)]
        context = mean_representation(parts[0].flatten(1, 2), groups["context"].mask.flatten(1, 2))
        if self._config.mode == "sup":
            positions = self._problem.position(batch.task_indices)
            terms = {"classification": task_classification(self.classifier(context), positions)}
        else:
            terms = self._reconstruction(groups[self._config.reconstruction], context)
            if self._config.beta:
                mask = torch.cat([group.mask for group in groups.values()], dim=1)
                single = mean_representation(torch.cat(parts, dim=1).flatten(0, 1), mask.flatten(0, 1))
                contexts = single.unflatten(0, mask.shape[:2])
                terms["distance"] = distance_metric_loss(contexts, epsilon=self._config.epsilon)
        weights = {"distance": self._config.beta, "bounds": self._config.bound_weight}
        total = context.new_zeros(())
        for name, term in terms.items():
            total = total + weights.get(name, 1.0) * term
        metrics = {f"loss/{name}": term for name, term in terms.items()}
        metrics["context/spread"] = context.std(dim=0).mean()
        return ContextLosses(total, context, metrics)

    def noise_std(self) -> Float[Tensor, " latent"]:
        """Standard deviation of the noise in front of tanh."""
        low, high = (math.log(bound) for bound in self._config.noise_variance)
        return (0.5 * self.noise_log_variance.clamp(low, high)).exp()

    def _reconstruction(self, steps: EncoderInputs, context: Float[Tensor, "tasks latent"]) -> Metrics:
        """What the decoders lack in rewards and changes of state, and how far their bounds lie apart.

        They never read what they predict.
        """
        state_actions, mask = steps.state_actions.flatten(1, 2), steps.mask.flatten(1, 2)
        spread = context.unsqueeze(1).expand(-1, mask.shape[1], -1)
        inputs = torch.cat([spread, state_actions], dim=-1)
        outcomes = steps.outcomes.flatten(1, 2)
        reward, reward_log_variance = self.reward_decoder(inputs)
        change, change_log_variance = self.change_decoder(inputs)
        return {
            "reward": gaussian_reconstruction(reward, reward_log_variance, outcomes[..., :1], mask),
            "change": gaussian_reconstruction(change, change_log_variance, outcomes[..., 1:], mask),
            "bounds": self.reward_decoder.width() + self.change_decoder.width(),
        }

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        """The mean over steps and over the noise, by its quantiles."""
        (free,) = self.encoder.unbounded(self.encoder.read(steps))
        levels = (torch.arange(NOISE_LEVELS, device=free.device) + 0.5) / NOISE_LEVELS
        noise = self.noise_std().unsqueeze(-1) * torch.special.ndtri(levels)
        representations = torch.tanh(free.unsqueeze(-1) + noise).mean(dim=-1)
        return mean_representation(representations.flatten(1, 2), steps.mask.flatten(1, 2))


@final
class Unicorn(Method[UnicornConfig]):
    """The plug-in."""

    name = "unicorn"
    capabilities = Capabilities(noisy_contexts=True)
    Config = UnicornConfig
    search: ClassVar[Search] = {**SHARED_SEARCH, "unicorn.beta": Factors(0.1, 10.0)}

    def batch_request(self, settings: TrainingSettings, config: UnicornConfig) -> BatchRequest:
        """The `[training.batch]` table without windows."""
        return trajectory_request(settings)

    def create(self, problem: Problem, settings: TrainingSettings, config: UnicornConfig) -> Algorithm:
        learner = UnicornLearner(problem, config, generator=problem.generator(0))
        return ContextAlgorithm(problem, settings, learner=learner)
