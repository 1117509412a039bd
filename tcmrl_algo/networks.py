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
        activation: between layers, not after the last.
        generator: draws the start.
    """

    def __init__(
        self, sizes: Sequence[int], *, generator: torch.Generator, activation: Activation = functional.relu
    ) -> None:
        super().__init__()
        self._activation = activation
        self.layers = nn.ModuleList(
            linear(inputs, outputs, generator) for inputs, outputs in itertools.pairwise(sizes)
        )

    def forward(self, inputs: Float[Tensor, "*rows inputs"]) -> Float[Tensor, "*rows outputs"]:
        for layer in self.layers[:-1]:
            inputs = self._activation(layer(inputs))
        result: Tensor = self.layers[-1](inputs)
        return result


@final
class PerceptronEnsemble(nn.Module):
    """Several ReLU perceptrons of one shape with one output each, evaluated in one batched product.

    Args:
        members: how many.
        sizes: width of input and hidden layers.
        generator: draws the start.
    """

    def __init__(self, members: int, sizes: Sequence[int], *, generator: torch.Generator) -> None:
        super().__init__()
        self.members = members
        widths = (*sizes, 1)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for inputs, outputs in itertools.pairwise(widths):
            bound = 1.0 / math.sqrt(inputs)
            for parameters, rows in ((self.weights, inputs), (self.biases, 1)):
                start = torch.empty(members, rows, outputs).uniform_(-bound, bound, generator=generator)
                parameters.append(nn.Parameter(start))

    def forward(self, inputs: Float[Tensor, "rows inputs"]) -> Float[Tensor, "members rows"]:
        values = inputs.expand(self.members, *inputs.shape)
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = torch.baddbmm(bias, functional.relu(values) if index else values, weight)
        return values.squeeze(-1)


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


@final
class ContextEncoder(nn.Module):
    """Eq. 1: c_t = e(s_t, a_t, r_t, s_{t+1}), in [-1, 1] per latent dimension.

    Deviation: the encoder reads s_{t+1} - s_t in place of s_{t+1}; the two carry the same information,
    and the difference keeps its scale where states move little in one step.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        latent: int,
        hidden: Sequence[int],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        sizes = (2 * observation_dim + action_dim + 1, *hidden, latent)
        self.perceptron = Perceptron(sizes, generator=generator)

    def forward(
        self,
        observations: Float[Tensor, "*rows observation"],
        actions: Float[Tensor, "*rows action"],
        rewards: Float[Tensor, "*rows"],
        changes: Float[Tensor, "*rows observation"],
    ) -> Float[Tensor, "*rows latent"]:
        """Representations of standardised transitions; `changes` are s_{t+1} - s_t."""
        inputs = torch.cat([observations, actions, rewards.unsqueeze(-1), changes], dim=-1)
        return torch.tanh(self.perceptron(inputs))


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
        self.perceptron = Perceptron((2 * latent, *hidden, 1), generator=generator, activation=torch.sigmoid)

    def forward(
        self, representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
    ) -> Attention:
        """Attention over each lane's real transitions, of which there must be at least one.

        c_mean = mean(c_1, ..., c_T); score_t = q(c_t, c_mean); w = softmax(score); c = sum_t w_t c_t.
        """
        real = mask.unsqueeze(-1)
        total = torch.where(real, representations, 0.0).sum(dim=1, keepdim=True)
        mean = total / real.sum(dim=1, keepdim=True)
        inputs = torch.cat([representations, mean.expand_as(representations)], dim=-1)
        scores = self.perceptron(inputs).squeeze(-1)
        weights = torch.softmax(torch.where(mask, scores, -torch.inf), dim=-1)
        context = torch.einsum("lt,ltd->ld", weights, torch.where(real, representations, 0.0))
        return Attention(representations, scores, weights, context, mask)


@final
class TransitionRewardEstimator(nn.Module):
    """r_hat(s, a, c) for one transition (dense rewards: Eq. 7 and 8)."""

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        latent: int,
        hidden: Sequence[int],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.perceptron = Perceptron((observation_dim + action_dim + latent, *hidden, 1), generator=generator)

    def forward(
        self,
        observations: Float[Tensor, "tasks trajectories steps observation"],
        actions: Float[Tensor, "tasks trajectories steps action"],
        mask: Bool[Tensor, "tasks trajectories steps"],
        context: Float[Tensor, "tasks latent"],
    ) -> Float[Tensor, "tasks trajectories steps"]:
        """Reward of every step under its task's context; values on padding mean nothing."""
        shape = (*observations.shape[:-1], context.shape[-1])
        spread = context[:, None, None].expand(shape)
        values: Tensor = self.perceptron(torch.cat([observations, actions, spread], dim=-1))
        return values.squeeze(-1)


@final
class TrajectoryRewardEstimator(nn.Module):
    """r_hat(s_1, a_1, ..., s_T, a_T, c): the return of a whole trajectory (sparse rewards: Eq. 17 and 18).

    Steps are laid side by side up to the horizon; steps an episode does not have are zeros.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        latent: int,
        horizon: int,
        hidden: Sequence[int],
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.horizon = horizon
        inputs = horizon * (observation_dim + action_dim) + latent
        self.perceptron = Perceptron((inputs, *hidden, 1), generator=generator)

    def forward(
        self,
        observations: Float[Tensor, "tasks trajectories steps observation"],
        actions: Float[Tensor, "tasks trajectories steps action"],
        mask: Bool[Tensor, "tasks trajectories steps"],
        context: Float[Tensor, "tasks latent"],
    ) -> Float[Tensor, "tasks trajectories"]:
        """Return of every trajectory under its task's context."""
        steps = torch.where(mask.unsqueeze(-1), torch.cat([observations, actions], dim=-1), 0.0)
        steps = functional.pad(steps, (0, 0, 0, self.horizon - steps.shape[2])).flatten(2)
        spread = context.unsqueeze(1).expand(*steps.shape[:2], -1)
        values: Tensor = self.perceptron(torch.cat([steps, spread], dim=-1))
        return values.squeeze(-1)
