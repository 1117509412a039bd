"""MACAW's layers, whose weights are linear functions of a code, and what gradient steps make of them."""

import itertools
from collections.abc import Sequence
from typing import final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tcmrl_algo.algorithms.core.networks import linear

LayerWeights = Float[Tensor, "... _"]
"""The matrix (inputs, outputs) and the bias of a layer, flattened side by side; of one lane or several."""


@final
class WeightLinear(nn.Module):
    """A layer y = x W + b whose weights are w = (W, b) = F z + f, with parameters F, z and f.

    One gradient step on the parameters changes W by a matrix of high rank (Mitchell et al., 2021).

    Args:
        code: size of z; its start is N(0, 1 / outputs^2) (published code).
    """

    def __init__(self, inputs: int, outputs: int, *, code: int, generator: torch.Generator) -> None:
        super().__init__()
        self.outputs = outputs
        self.code = nn.Parameter(torch.randn(code, generator=generator) / outputs)
        self.factors = linear(code, (inputs + 1) * outputs, generator)

    def forward(self) -> Float[Tensor, " weights"]:
        """The weights w."""
        weights: Tensor = self.factors(self.code)
        return weights

    def descended(
        self, gradients: Float[Tensor, "lanes weights"], rates: Float[Tensor, " 3"]
    ) -> Float[Tensor, "lanes weights"]:
        """The weights that every lane has after one gradient step of its own on z, F and f.

        A loss whose gradient by w is g has the gradients F^T g by z, g z^T by F and g by f. With rates
        (a, b, c) the step gives z' = z - a F^T g and, since g z^T has rank one,

            w' = (F - b g z^T) z' + f - c g = F z' + f - (c + b z^T z') g,

        so that no lane needs a copy of F, which is by far the largest tensor.

        Args:
            rates: of z, F and f.
        """
        code_rate, factor_rate, bias_rate = rates.unbind()
        codes = self.code - code_rate * (gradients @ self.factors.weight)
        along = bias_rate + factor_rate * (codes @ self.code)
        found: Tensor = self.factors(codes) - along.unsqueeze(-1) * gradients
        return found


def apply_layer(
    weights: LayerWeights, inputs: Float[Tensor, "*lanes rows inputs"], outputs: int
) -> Float[Tensor, "*lanes rows outputs"]:
    """The layer's x W + b for the rows of every lane, by the lane's weights."""
    matrix, bias = weights[..., :-outputs], weights[..., -outputs:]
    found: Tensor = inputs @ matrix.unflatten(-1, (-1, outputs)) + bias.unsqueeze(-2)
    return found


@final
class WeightPerceptron(nn.Module):
    """A ReLU perceptron of weight-linear layers, which is run with given weights.

    Args:
        code: size of every layer's code.

    Example:
        >>> network = WeightPerceptron((3, 8, 1), code=4, generator=torch.Generator())
        >>> outputs, features = network.run(network(), torch.zeros(5, 3))
        >>> tuple(outputs.shape), tuple(features.shape)
        ((5, 1), (5, 8))
    """

    def __init__(self, sizes: Sequence[int], *, code: int, generator: torch.Generator) -> None:
        super().__init__()
        self._layers = tuple(
            WeightLinear(inputs, outputs, code=code, generator=generator)
            for inputs, outputs in itertools.pairwise(sizes)
        )
        self.layers = nn.ModuleList(self._layers)

    def forward(self) -> tuple[LayerWeights, ...]:
        """The weights of all layers, without lanes."""
        return tuple(layer() for layer in self._layers)

    def descended(
        self, gradients: Sequence[LayerWeights], rates: Float[Tensor, "layers 3"]
    ) -> tuple[LayerWeights, ...]:
        """As of `WeightLinear.descended`, for all layers."""
        return tuple(
            layer.descended(gradient, rate)
            for layer, gradient, rate in zip(self._layers, gradients, rates, strict=True)
        )

    def run(
        self, weights: Sequence[LayerWeights], inputs: Float[Tensor, "*lanes rows inputs"]
    ) -> tuple[Float[Tensor, "*lanes rows outputs"], Float[Tensor, "*lanes rows features"]]:
        """The outputs, and what the last hidden layer gives before its ReLU."""
        values = features = inputs
        for place, (layer, own) in enumerate(zip(self._layers, weights, strict=True)):
            features = values
            values = apply_layer(own, torch.relu(values) if place else values, layer.outputs)
        return values, features


Weights = tuple[LayerWeights, ...]
"""Of all layers of a network; of every lane, or of the start."""
