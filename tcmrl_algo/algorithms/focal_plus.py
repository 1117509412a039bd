"""FOCAL++ (Li et al., 2021, arXiv 2102.10774): attention within and over transitions, trained by contrast.

z_t = e(s_t, a_t, r_t, s_{t+1}; all steps of its trajectory), z = mean_t z_t, and

    L = -mean_i log( exp(z_i . k_i / tau) / sum_j exp(z_i . k_j / tau) ),

where z_i is the context of task i from one group of its trajectories, and k_i that from another group, by a
key encoder that follows the encoder by momentum. Attention weighs transitions that tell tasks apart: few if
rewards are sparse. The actor-critic and its behavior regularisation are ours, as for FOCAL.

The three variants of TCMRL's Table 3 are `attention` = `both` (the full method), `sequence` and `batch`.

Published are the paper and the class of the encoder, not its training code. Our inferences: the reading of
"sequence-wise" (`tokens`), tau, the cosine in place of the dot product (which drives tanh outputs to their
bounds), the momentum (MoCo's), smaller networks, and no dropout, because the actor-critic would learn from
contexts with noise that those at test time do not have.
"""

from typing import ClassVar, Literal, final

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.context_methods.encoding import read_steps, transition_scaling
from tcmrl_algo.context_methods.learner import ContextAlgorithm, ContextLearner, ContextLosses
from tcmrl_algo.context_methods.requests import trajectory_request
from tcmrl_algo.losses import context as losses
from tcmrl_algo.methods.base import Algorithm, Method, MethodConfig
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.methods.search import SHARED_SEARCH, Factors, Search
from tcmrl_algo.networks.attention import mean_representation
from tcmrl_algo.networks.momentum import follow, momentum_copy
from tcmrl_algo.networks.transformer import AttentionKind, TokenKind, TransitionTransformer
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps


class FocalPlusConfig(MethodConfig):
    """The `[training.focal_plus]` table. No weight: one loss alone trains the encoder, and Adam has no scale.

    Attributes:
        latent: size of representations and contexts (published code of TCMRL: 20).
        hidden: width of the encoder (ours; published class: 100).
        layers: number of its blocks (ours; published class: 6).
        heads: of the attention over steps, a divisor of `hidden` (ours; published class: 128).
        reduction: `hidden` over the inner width of the gate (published class: 16).
        dropout: share of dropped values in the encoder (ours; published class: 0.1).
        attention: `both`, over steps (`sequence`) or the gate alone (`batch`); `none` is a perceptron of the
            same width, for comparison.
        tokens: between which attention works: the `steps` of a trajectory, or `literal`, as in the published
            class, every transition by itself.
        similarity: `cosine` compares contexts of length 1, `dot` as they are.
        temperature: tau (ours).
        momentum: m in keys <- m keys + (1 - m) encoder after every step (MoCo: 0.999).
    """

    latent: int = Field(default=20, ge=1)
    hidden: int = Field(default=128, ge=1)
    layers: int = Field(default=2, ge=1)
    heads: int = Field(default=4, ge=1)
    reduction: int = Field(default=16, ge=1)
    dropout: float = Field(default=0.0, ge=0, lt=1)
    attention: AttentionKind = "both"
    tokens: TokenKind = "steps"
    similarity: Literal["cosine", "dot"] = "cosine"
    temperature: float = Field(default=0.1, gt=0)
    momentum: float = Field(default=0.999, ge=0, le=1)

    @model_validator(mode="after")
    def _heads_divide(self) -> "FocalPlusConfig":
        if self.hidden % self.heads:
            raise ValueError(f"hidden, {self.hidden}, must be a multiple of heads, {self.heads}")
        return self


@final
class AttentiveEncoder(nn.Module):
    """Standardised transitions into contexts; attention works within a trajectory, the mean over all."""

    def __init__(self, problem: Problem, config: FocalPlusConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.scaling = transition_scaling(problem)
        self.transformer = TransitionTransformer(
            len(self.scaling.mean),
            config.latent,
            hidden=config.hidden,
            layers=config.layers,
            heads=config.heads,
            reduction=config.reduction,
            attention=config.attention,
            tokens=config.tokens,
            dropout=config.dropout,
            generator=generator,
        )

    def forward(
        self, steps: Steps, generator: torch.Generator | None = None
    ) -> Float[Tensor, "lanes latent"]:
        """One context per lane; `generator` draws dropout, None drops nothing."""
        values = read_steps(steps, self.scaling)
        representations = self.transformer(
            values.inputs.flatten(0, 1), values.mask.flatten(0, 1), generator
        ).unflatten(0, values.mask.shape[:2])
        return mean_representation(representations.flatten(1, 2), values.mask.flatten(1, 2))


@final
class FocalPlusLearner(ContextLearner):
    """Encoder and key encoder."""

    def __init__(self, problem: Problem, config: FocalPlusConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.latent, self._config = config.latent, config
        self.encoder = AttentiveEncoder(problem, config, generator=generator)
        self.key_encoder = momentum_copy(self.encoder)

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """InfoNCE of context trajectories (queries) and execution trajectories (keys, without gradient)."""
        config, context = self._config, self.encoder(batch["context"], generator)
        with torch.no_grad():
            keys = self.key_encoder(batch["execution"], generator)
        queries = context
        if config.similarity == "cosine":
            queries, keys = functional.normalize(queries, dim=-1), functional.normalize(keys, dim=-1)
        mask = torch.ones(len(queries), dtype=torch.bool, device=queries.device)
        contrast = losses.info_nce(queries, keys, mask, temperature=config.temperature)
        metrics = {"loss/contrastive": contrast, "context/spread": context.std(dim=0).mean()}
        return ContextLosses(contrast, context, metrics)

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        result: Tensor = self.encoder(steps)
        return result

    def after_step(self, step: int) -> None:
        """The key encoder follows; it has no other training."""
        follow(self.key_encoder, self.encoder, step=1.0 - self._config.momentum)


@final
class FocalPlus(Method[FocalPlusConfig]):
    """The plug-in."""

    name = "focal_plus"
    Config = FocalPlusConfig
    search: ClassVar[Search] = {**SHARED_SEARCH, "focal_plus.temperature": Factors(0.1, 10.0)}

    def batch_request(self, settings: TrainingSettings, config: FocalPlusConfig) -> BatchRequest:
        """The `[training.batch]` table without windows."""
        return trajectory_request(settings)

    def create(self, problem: Problem, settings: TrainingSettings, config: FocalPlusConfig) -> Algorithm:
        learner = FocalPlusLearner(problem, config, generator=problem.generator(0))
        return ContextAlgorithm(problem, settings, learner=learner)
