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
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextLearner,
    ContextLosses,
    read_steps,
    trajectory_request,
    transition_scaling,
)
from tcmrl_algo.algorithms.core.losses import info_nce
from tcmrl_algo.algorithms.core.method import SHARED_SEARCH, Algorithm, Factors, Method, MethodConfig, Search
from tcmrl_algo.algorithms.core.networks import follow, linear, mean_representation, momentum_copy
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps

LAYER_NORM_EPSILON = 1e-6


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
    attention: Literal["both", "sequence", "batch", "none"] = "both"
    tokens: Literal["steps", "literal"] = "steps"
    similarity: Literal["cosine", "dot"] = "cosine"
    temperature: float = Field(default=0.1, gt=0)
    momentum: float = Field(default=0.999, ge=0, le=1)

    @model_validator(mode="after")
    def _heads_divide(self) -> "FocalPlusConfig":
        if self.hidden % self.heads:
            raise ValueError(f"hidden, {self.hidden}, must be a multiple of heads, {self.heads}")
        return self


def dropout(
    values: Float[Tensor, "*shape"], share: float, generator: torch.Generator | None
) -> Float[Tensor, "*shape"]:
    """Sets a share of the values to 0 and scales the others up; without a generator, changes nothing."""
    if generator is None or share == 0.0:
        return values
    kept = torch.rand(values.shape, generator=generator).to(values.device) >= share
    return values * kept / (1.0 - share)


@final
class StepAttention(nn.Module):
    """Sequence-wise attention: several heads of softmax(Q K^T / sqrt(d)) V and a linear layer.

    Deviation: the published code also drops attention weights, which the fused product used here does not
    offer with a generator of one's own.

    The `tokens` that attend to each other are the `steps` of a trajectory. `literal` is the published code,
    which makes a sequence of every single transition: the softmax over one token is 1, so that nothing is
    mixed and an affine map is left.
    """

    def __init__(self, config: FocalPlusConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self._heads, self._tokens = config.heads, config.tokens
        self.inputs = linear(config.hidden, 3 * config.hidden, generator)
        self.outputs = linear(config.hidden, config.hidden, generator)

    def forward(
        self, values: Float[Tensor, "lanes steps hidden"], mask: Bool[Tensor, "lanes steps"]
    ) -> Float[Tensor, "lanes steps hidden"]:
        projected = self.inputs(values).unflatten(-1, (3, self._heads, -1))
        query, key, value = projected.permute(2, 0, 3, 1, 4)  # (lanes, heads, steps, width)
        if self._tokens == "steps":
            keys = mask | ~mask.any(dim=1, keepdim=True)  # keeps lanes that are padding alone free of NaN
            value = functional.scaled_dot_product_attention(query, key, value, keys[:, None, None])
        mixed: Tensor = self.outputs(value.transpose(1, 2).flatten(2))
        return mixed


@final
class TransitionGate(nn.Module):
    """Batch-wise attention: one weight per transition, g_t = mean of sigmoid(W_2 tanh(W_1 x_t)), in (0, 1).

    W_1 has `hidden // reduction` outputs.
    """

    def __init__(self, config: FocalPlusConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        narrow = max(config.hidden // config.reduction, 1)
        self.narrow = linear(config.hidden, narrow, generator)
        self.wide = linear(narrow, config.hidden, generator)

    def forward(self, values: Float[Tensor, "*rows hidden"]) -> Float[Tensor, "*rows 1"]:
        gates: Tensor = torch.sigmoid(self.wide(torch.tanh(self.narrow(values))))
        return gates.mean(dim=-1, keepdim=True)


@final
class TransformerBlock(nn.Module):
    """x + Drop(Mix(LN x)), then x + Drop(FF(LN x)), then Drop.

    Mix is attention over steps, or x_t g_t, or the sum of both (the published code's default of three ways
    to join them); FF is a perceptron with one hidden layer of four times the width and GELU. Deviation:
    LayerNorm divides by the biased standard deviation, the published code by the unbiased one. Without
    attention there is no first residual. The start is the same whatever `attention` is.
    """

    def __init__(self, config: FocalPlusConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        hidden, attention = config.hidden, config.attention
        self._dropout = config.dropout
        self.norm = nn.LayerNorm(hidden, eps=LAYER_NORM_EPSILON)
        self.wide = linear(hidden, 4 * hidden, generator)
        self.narrow = linear(4 * hidden, hidden, generator)
        gate = TransitionGate(config, generator=generator)
        steps = StepAttention(config, generator=generator)
        mixes = attention != "none"
        self.mix_norm = nn.LayerNorm(hidden, eps=LAYER_NORM_EPSILON) if mixes else None
        self.gate = gate if attention in ("both", "batch") else None
        self.steps = steps if attention in ("both", "sequence") else None

    def forward(
        self,
        values: Float[Tensor, "lanes steps hidden"],
        mask: Bool[Tensor, "lanes steps"],
        generator: torch.Generator | None,
    ) -> Float[Tensor, "lanes steps hidden"]:
        """The block's output for one trajectory per lane; `generator` draws dropout, None drops nothing."""
        if self.mix_norm is not None:
            mixed = self.mix(self.mix_norm(values), mask)
            values = values + dropout(mixed, self._dropout, generator)
        inner = functional.gelu(self.wide(self.norm(values)), approximate="tanh")
        inner = self.narrow(dropout(inner, self._dropout, generator))
        values = values + dropout(inner, self._dropout, generator)
        return dropout(values, self._dropout, generator)

    def mix(
        self, values: Float[Tensor, "lanes steps hidden"], mask: Bool[Tensor, "lanes steps"]
    ) -> Float[Tensor, "lanes steps hidden"]:
        """Attention over steps, plus gated values, as far as the block has them."""
        mixed = torch.zeros_like(values) if self.steps is None else self.steps(values, mask)
        return mixed if self.gate is None else mixed + values * self.gate(values)


@final
class TransitionTransformer(nn.Module):
    """x_0 = tanh(Linear(inputs)), blocks, and z_t = tanh(Linear(x)) for every transition of a trajectory."""

    def __init__(self, inputs: int, config: FocalPlusConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.first = linear(inputs, config.hidden, generator)
        self.last = linear(config.hidden, config.latent, generator)
        self.blocks = nn.ModuleList(
            TransformerBlock(config, generator=generator) for _ in range(config.layers)
        )

    def forward(
        self,
        inputs: Float[Tensor, "lanes steps inputs"],
        mask: Bool[Tensor, "lanes steps"],
        generator: torch.Generator | None = None,
    ) -> Float[Tensor, "lanes steps latent"]:
        """Representations of the steps of every lane's trajectory; `generator` as of `TransformerBlock`."""
        values = torch.tanh(self.first(inputs))
        for block in self.blocks:
            values = block(values, mask, generator)
        return torch.tanh(self.last(values))


@final
class AttentiveEncoder(nn.Module):
    """Standardised transitions into contexts; attention works within a trajectory, the mean over all."""

    def __init__(self, problem: Problem, config: FocalPlusConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.scaling = transition_scaling(problem)
        self.transformer = TransitionTransformer(len(self.scaling.mean), config, generator=generator)

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
        contrast = info_nce(queries, keys, mask, temperature=config.temperature)
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
