"""Networks of two or more methods.

Every network draws its start from a generator that is handed in; the global random state is never used.
"""

import copy
import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TypeVar, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.algorithms.core.losses import where_real

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
    trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
    for parameter in trained:
        parameter.requires_grad_(False)
    try:
        result: Tensor = module(*inputs)
    finally:
        for parameter in trained:
            parameter.requires_grad_(True)
    return result


@final
class Perceptron(nn.Module):
    """Linear layers with an activation between them.

    Args:
        sizes: width of input, hidden layers and output; two entries make one linear layer.
        activation: between layers, not after the last; it may work in place, which spares a pass over memory.

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
        # An activation in place on a view would copy gradients.
        rows = inputs if inputs.ndim == 2 else inputs.reshape(-1, inputs.shape[-1])
        *hidden, last = self.layers
        reduced = self.hidden_dtype is not torch.float32
        with torch.autocast(rows.device.type, self.hidden_dtype) if reduced else nullcontext():
            for layer in hidden:
                rows = self._activation(layer(rows))
        outputs: Tensor = last(rows.to(inputs.dtype))
        return outputs if inputs.ndim == 2 else outputs.view(*inputs.shape[:-1], outputs.shape[-1])


def set_hidden_dtype(module: nn.Module, dtype: torch.dtype) -> None:
    """Lets the hidden layers of all perceptrons in a module multiply in float32 or bfloat16."""
    for part in module.modules():
        if isinstance(part, Perceptron):
            part.hidden_dtype = dtype


@final
class PerceptronEnsemble(nn.Module):
    """Several ReLU perceptrons of one shape, every one with a single output.

    One product per member and layer: on a CPU the batched product of all members is slower.

    Args:
        sizes: width of input and hidden layers.
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
        return (values - self.mean).div_(self.scale).clamp_(-LARGEST_INPUT, LARGEST_INPUT)


Network = TypeVar("Network", bound=nn.Module)


def momentum_copy(network: Network) -> Network:
    """A copy without gradients, so that no optimiser takes it; `follow` moves it."""
    return copy.deepcopy(network).requires_grad_(False)


def follow(copied: nn.Module, network: nn.Module, *, step: float) -> None:
    """Moves a momentum copy towards its network: copied + step (network - copied).

    Buffers are left alone; networks here keep only constants in them.
    """
    with torch.no_grad():
        torch._foreach_lerp_(list(copied.parameters()), list(network.parameters()), step)


LIKELIHOOD_LOG_STD = (-5.0, 2.0)
"""Bounds of the log standard deviation of `LikelihoodPolicy` (published code of IQL)."""


def held_between(free: Tensor, low: float | Tensor, high: float | Tensor) -> Tensor:
    """Values in [low, high] by softplus from either side: the identity between, never without a gradient."""
    below = high - functional.softplus(high - free)
    return low + functional.softplus(below - low)


@final
class LikelihoodPolicy(nn.Module):
    """A Gaussian with diagonal covariance around tanh of a perceptron, for fitting stored actions.

    As in the published code of IQL, the mean is squashed and the distribution is not, so that the likelihood
    of a stored action at -1 or 1 is finite; and one standard deviation per action dimension, 1 at first,
    serves all states. Deviation: `held_between` bounds its logarithm in place of a hard clamp.
    """

    def __init__(
        self, inputs: int, action_dim: int, *, hidden: Sequence[int], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.perceptron = Perceptron((inputs, *hidden, action_dim), generator=generator)
        self.free_log_std = nn.Parameter(torch.zeros(action_dim))

    def forward(
        self, inputs: Float[Tensor, "rows inputs"]
    ) -> tuple[Float[Tensor, "rows action"], Float[Tensor, " action"]]:
        """The mean, in (-1, 1), and the log standard deviation."""
        return self.most_likely(inputs), held_between(self.free_log_std, *LIKELIHOOD_LOG_STD)

    def most_likely(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "rows action"]:
        """The mean."""
        return torch.tanh(self.perceptron(inputs))


def mean_representation(
    representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
) -> Float[Tensor, "lanes latent"]:
    """Eq. 2: c_mean = mean(c_1, ..., c_T) over each lane's real steps; FOCAL's context."""
    real = mask.unsqueeze(-1)
    kept = where_real(real, representations, 0.0)
    return kept.sum(dim=1) / (mask.shape[1] if kept is representations else real.sum(dim=1))


def weighted_sum(
    weights: Float[Tensor, "lanes steps"], representations: Float[Tensor, "lanes steps latent"]
) -> Float[Tensor, "lanes latent"]:
    """sum_t w_t c_t (Eq. 5); weights are 0 on padding."""
    return torch.bmm(weights.unsqueeze(1), representations).squeeze(1)


@dataclass(frozen=True)
class Attention:
    """The extractor's output for the transitions of every lane.

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
