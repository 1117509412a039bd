"""Perceptrons, ensembles of them, and the standardisation of their inputs.

Every network draws its start from a generator that is handed in; the global random state is never used.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

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
    parameters = {name: parameter.detach() for name, parameter in module.named_parameters()}
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
        return outputs.view(*inputs.shape[:-1], outputs.shape[-1])


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
