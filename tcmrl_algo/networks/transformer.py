"""Transitions that attend to each other: the blocks of FOCAL++'s encoder (Li et al., 2021).

Written beside the encoder class that the authors published, whose training code is not public. The padding of
a trajectory never influences its real steps, and no position is encoded: a trajectory is a set.
"""

from typing import Literal, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.networks.perceptron import linear

AttentionKind = Literal["both", "sequence", "batch", "none"]
TokenKind = Literal["steps", "literal"]
LAYER_NORM_EPSILON = 1e-6


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

    Args:
        hidden: width, a multiple of `heads`.
        heads: how many.
        tokens: `steps` lets the steps of a trajectory attend to each other. `literal` is the published
            code, which makes a sequence of every single transition: the softmax over one token is 1, so
            that nothing is mixed and an affine map is left.
        generator: draws the start.
    """

    def __init__(self, hidden: int, *, heads: int, tokens: TokenKind, generator: torch.Generator) -> None:
        super().__init__()
        self._heads, self._tokens = heads, tokens
        self.inputs = linear(hidden, 3 * hidden, generator)
        self.outputs = linear(hidden, hidden, generator)

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

    Args:
        hidden: width of x_t.
        reduction: W_1 has `hidden // reduction` outputs.
        generator: draws the start.
    """

    def __init__(self, hidden: int, *, reduction: int, generator: torch.Generator) -> None:
        super().__init__()
        narrow = max(hidden // reduction, 1)
        self.narrow = linear(hidden, narrow, generator)
        self.wide = linear(narrow, hidden, generator)

    def forward(self, values: Float[Tensor, "*rows hidden"]) -> Float[Tensor, "*rows 1"]:
        gates: Tensor = torch.sigmoid(self.wide(torch.tanh(self.narrow(values))))
        return gates.mean(dim=-1, keepdim=True)


@final
class TransformerBlock(nn.Module):
    """x + Drop(Mix(LN x)), then x + Drop(FF(LN x)), then Drop.

    Mix is attention over steps, or x_t g_t, or the sum of both (the published code's default of three ways
    to join them); FF is a perceptron with one hidden layer of four times the width and GELU. Deviation:
    LayerNorm divides by the biased standard deviation, the published code by the unbiased one.

    Args:
        hidden: width.
        heads: of the attention over steps.
        reduction: of the gate.
        attention: what Mix holds; `none` leaves out the first residual.
        tokens: as of `StepAttention`.
        dropout: share.
        generator: draws the start, which is the same whatever `attention` is.
    """

    def __init__(
        self,
        hidden: int,
        *,
        heads: int,
        reduction: int,
        attention: AttentionKind,
        tokens: TokenKind,
        dropout: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self._dropout = dropout
        self.norm = nn.LayerNorm(hidden, eps=LAYER_NORM_EPSILON)
        self.wide = linear(hidden, 4 * hidden, generator)
        self.narrow = linear(4 * hidden, hidden, generator)
        gate = TransitionGate(hidden, reduction=reduction, generator=generator)
        steps = StepAttention(hidden, heads=heads, tokens=tokens, generator=generator)
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
        """The block's output.

        Args:
            values: x, one trajectory per lane.
            mask: real steps.
            generator: draws dropout; None drops nothing.
        """
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
    """x_0 = tanh(Linear(inputs)), blocks, and z_t = tanh(Linear(x)) for every transition of a trajectory.

    Args:
        inputs: width of a transition.
        latent: size of z_t.
        hidden: width of the blocks.
        layers: number of blocks.
        heads, reduction, attention, tokens, dropout: as of `TransformerBlock`.
        generator: draws the start.
    """

    def __init__(
        self,
        inputs: int,
        latent: int,
        *,
        hidden: int,
        layers: int,
        heads: int,
        reduction: int,
        attention: AttentionKind,
        tokens: TokenKind,
        dropout: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.first = linear(inputs, hidden, generator)
        self.last = linear(hidden, latent, generator)
        self.blocks = nn.ModuleList(
            TransformerBlock(
                hidden,
                heads=heads,
                reduction=reduction,
                attention=attention,
                tokens=tokens,
                dropout=dropout,
                generator=generator,
            )
            for _ in range(layers)
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
