"""Networks: context encoder, task characteristic extractor, reward estimators, critics.

Every network draws its start from a generator that is handed in; the global random state is never used.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

Activation = Callable[[Tensor], Tensor]
SMALLEST_SCALE = 1e-5
"""Input dimensions that vary less than this are constant: dividing by less would blow up rounding errors."""
LARGEST_INPUT = 10.0
"""Standardised inputs are clipped here, so that a state far from the data cannot drown all others."""


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A linear layer with weights and biases from U(-1/sqrt(inputs), 1/sqrt(inputs))."""
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, inputs, outputs)
    bound = 1.0 / math.sqrt(max(inputs, 1))
    for parameter in (layer.weight, layer.bias):
        nn.init.uniform_(parameter, -bound, bound, generator=generator)
    return layer


def call_frozen(module: nn.Module, *inputs: Tensor) -> Tensor:
    """The module's output with its parameters held fixed: gradients reach the inputs alone."""
    parameters = {name: each.detach() for name, each in module.named_parameters()}
    result: Tensor = torch.func.functional_call(module, parameters, inputs)
    return result


@final
class Perceptron(nn.Module):
    """Linear layers with an activation between them.

    Args:
        sizes: width of input, hidden layers and output; two entries make one linear layer.
        activation: between layers, not after the last; it may work in place, which spares a pass over memory.
        generator: draws the start.

    Attributes:
        hidden_dtype: in which the hidden layers multiply; parameters, the last layer and all losses stay
            float32. See `set_hidden_dtype`.
    """

    hidden_dtype: torch.dtype

    def __init__(
        self, sizes: Sequence[int], *, generator: torch.Generator, activation: Activation = torch.relu_
    ) -> None:
        super().__init__()
        self.hidden_dtype = torch.float32
        self._activation = activation
        self.layers = nn.ModuleList(
            linear(inputs, outputs, generator) for inputs, outputs in itertools.pairwise(sizes)
        )

    def forward(self, inputs: Float[Tensor, "*rows inputs"]) -> Float[Tensor, "*rows outputs"]:
        rows = inputs.reshape(-1, inputs.shape[-1])  # an activation in place on a view would copy gradients
        reduced = self.hidden_dtype is not torch.float32
        with torch.autocast(rows.device.type, self.hidden_dtype, enabled=reduced):
            for layer in self.layers[:-1]:
                rows = self._activation(layer(rows))
        outputs: Tensor = self.layers[-1](rows.to(inputs.dtype))
        return outputs.view(*inputs.shape[:-1], -1)


def set_hidden_dtype(module: nn.Module, dtype: torch.dtype) -> None:
    """Lets the hidden layers of all perceptrons in a module multiply in float32 or bfloat16."""
    for each in module.modules():
        if isinstance(each, Perceptron):
            each.hidden_dtype = dtype


@final
class PerceptronEnsemble(nn.Module):
    """Several ReLU perceptrons of one shape with one output each.

    One product per member and layer: on a CPU the batched product of all members is slower.

    Args:
        members: how many.
        sizes: width of input and hidden layers.
        generator: draws the start.
    """

    def __init__(self, members: int, sizes: Sequence[int], *, generator: torch.Generator) -> None:
        super().__init__()
        self.members = nn.ModuleList(Perceptron((*sizes, 1), generator=generator) for _ in range(members))

    def forward(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "members rows"]:
        return torch.cat([member(inputs) for member in self.members], dim=-1).T


@final
class Standardizer(nn.Module):
    """Subtracts a mean and divides by a scale, both kept as buffers and never trained.

    Args:
        mean: (dim,).
        std: (dim,); entries below SMALLEST_SCALE leave their dimension undivided.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, mean: Float[Tensor, " dim"], std: Float[Tensor, " dim"]) -> None:
        super().__init__()
        self.register_buffer("mean", mean.detach().clone())
        self.register_buffer("scale", torch.where(std < SMALLEST_SCALE, torch.ones_like(std), std))

    def forward(self, values: Float[Tensor, "*rows dim"]) -> Float[Tensor, "*rows dim"]:
        return ((values - self.mean) / self.scale).clamp(-LARGEST_INPUT, LARGEST_INPUT)


def mean_representation(
    representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
) -> Float[Tensor, "lanes latent"]:
    """Eq. 2: c_mean = mean(c_1, ..., c_T) over each lane's real steps; FOCAL's context."""
    real = mask.unsqueeze(-1)
    return torch.where(real, representations, 0.0).sum(dim=1) / real.sum(dim=1)


@dataclass(frozen=True)
class Attention:
    """What the extractor makes of the transitions of each lane.

    Attributes:
        representations: (lanes, steps, latent), c_t.
        scores: (lanes, steps), Eq. 3.
        weights: (lanes, steps), Eq. 4; 0 on padding, sums to 1.
        context: (lanes, latent), Eq. 5.
        mask: (lanes, steps) bool, real transitions.
    """

    representations: Float[Tensor, "lanes steps latent"]
    scores: Float[Tensor, "lanes steps"]
    weights: Float[Tensor, "lanes steps"]
    context: Float[Tensor, "lanes latent"]
    mask: Bool[Tensor, "lanes steps"]


@final
class TaskExtractor(nn.Module):
    """The task characteristic extractor, Eq. 2-5: scores transitions against their mean and aggregates them.

    Args:
        latent: size of a representation.
        hidden: widths of q's sigmoid layers (paper, F.2: 256); empty makes q linear, as in the code.
        generator: draws the start.
    """

    def __init__(self, latent: int, *, hidden: Sequence[int], generator: torch.Generator) -> None:
        super().__init__()
        self.perceptron = Perceptron((2 * latent, *hidden, 1), generator=generator, activation=torch.sigmoid_)

    def forward(
        self, representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
    ) -> Attention:
        """Attention over each lane's real transitions, of which there must be at least one.

        c_mean = mean(c_1, ..., c_T); score_t = q(c_t, c_mean); w = softmax(score); c = sum_t w_t c_t.
        """
        mean = mean_representation(representations, mask).unsqueeze(1)
        inputs = torch.cat([representations, mean.expand_as(representations)], dim=-1)
        scores = self.perceptron(inputs).squeeze(-1)
        weights = torch.softmax(torch.where(mask, scores, -torch.inf), dim=-1)
        context = torch.einsum("lt,ltd->ld", weights, torch.where(mask.unsqueeze(-1), representations, 0.0))
        return Attention(representations, scores, weights, context, mask)


def uniform_attention(
    representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
) -> Attention:
    """What remains of Eq. 2-5 without an extractor: equal weights, and with them the mean of Eq. 2."""
    weights = mask / mask.sum(dim=1, keepdim=True)
    context = mean_representation(representations, mask)
    return Attention(representations, torch.zeros_like(weights), weights, context, mask)


@final
class RewardEstimator(nn.Module):
    """r_hat(s, a, c), the reward of a transition, or r_hat(s_1, a_1, ..., c), the return of a trajectory.

    Args:
        inputs: width of what is estimated on: a transition's state and action (Eq. 7 and 8), or those of a
            whole trajectory `side_by_side` (Eq. 17 and 18).
        latent: size of the context.
        hidden: widths of the layers.
        generator: draws the start.
    """

    def __init__(
        self, inputs: int, *, latent: int, hidden: Sequence[int], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.perceptron = Perceptron((inputs + latent, *hidden, 1), generator=generator)

    def forward(
        self, inputs: Float[Tensor, "tasks rows inputs"], context: Float[Tensor, "tasks latent"]
    ) -> Float[Tensor, "tasks rows"]:
        """One estimate per row, under its task's context."""
        spread = context.unsqueeze(1).expand(-1, inputs.shape[1], -1)
        values: Tensor = self.perceptron(torch.cat([inputs, spread], dim=-1))
        return values.squeeze(-1)


def side_by_side(
    steps: Float[Tensor, "tasks trajectories steps inputs"],
    mask: Bool[Tensor, "tasks trajectories steps"],
    *,
    horizon: int,
) -> Float[Tensor, "tasks trajectories all_inputs"]:
    """The steps of a trajectory as one vector; steps that an episode does not have are zeros."""
    real = torch.where(mask.unsqueeze(-1), steps, 0.0)
    return functional.pad(real, (0, 0, 0, horizon - steps.shape[2])).flatten(2)
