"""Joint updates of N independent SAC agents, equal to updates by Stable-Baselines3's SAC.

SAC: Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", 2018. A loss is the sum over tasks of
the mean over a task's batch, so an agent's gradient does not depend on other agents. Networks of equal shape
are evaluated and differentiated together by batched matrix products. Gradients are implemented by hand: an
update with autograd took 1.5 to 1.7 times as long (16 agents, 64 x 64). Tests compare them with autograd, and
a single agent with SB3.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import final

import torch
from torch import Tensor
from torch.optim import Adam

from tcmrl_data.behavior.base import LOG_STD_RANGE
from tcmrl_data.behavior.sac import SacSettings

SQUASH_EPSILON = 1e-6
"""Keeps the logarithm of 1 - tanh(u)^2 finite; the value of Stable-Baselines3."""

CRITICS = 2

PADDING = 64
"""Sizes of vectors are rounded up to a multiple of this. The remainder of a vectorized loop may round
differently, so without padding an agent's results would depend on its position in the group."""


@dataclass(frozen=True)
class ReplayBatch:
    """One batch of B transitions for each of N tasks: arrays (N, B, …).

    Attributes:
        terminated: (N, B), 1 if the task ended the episode, else 0; a time limit is 0.
    """

    observations: Tensor
    actions: Tensor
    next_observations: Tensor
    rewards: Tensor
    terminated: Tensor


@dataclass(frozen=True)
class PolicySample:
    """Actions a = tanh(u), u = mean + std * noise, of a squashed Gaussian.

    Attributes:
        actions: (..., action_dim).
        log_probs: (...), log density of the actions.
        scaled_noise: (..., action_dim), du / d log_std; 0 if log_std is clamped.
        unclamped: (..., action_dim), 1 if log_std lies within its range, else 0.
    """

    actions: Tensor
    log_probs: Tensor
    scaled_noise: Tensor
    unclamped: Tensor


def sample_policy(head: Tensor, noise: Tensor) -> PolicySample:
    """Samples actions, given the actor's outputs.

    log pi(a) = sum_i [-noise_i^2 / 2 - log std_i - log(2 pi) / 2 - log(1 - a_i^2 + epsilon)]

    Args:
        head: (..., 2 * action_dim), means, then log standard deviations.
        noise: (..., action_dim), standard normal.
    """
    mean, raw = head.chunk(2, dim=-1)
    log_std = raw.clamp(*LOG_STD_RANGE)
    scaled_noise = log_std.exp() * noise
    actions = torch.tanh(mean + scaled_noise)
    density = -0.5 * noise.square() - log_std - torch.log(1.0 - actions.square() + SQUASH_EPSILON)
    log_probs = density.sum(dim=-1) - 0.5 * math.log(2.0 * math.pi) * noise.shape[-1]
    unclamped = (raw == log_std).to(raw.dtype)
    return PolicySample(actions, log_probs, scaled_noise * unclamped, unclamped)


def head_gradient(sample: PolicySample, entropy: Tensor, action_gradient: Tensor) -> Tensor:
    """Gradient dL / d head of L = mean_B(entropy * log pi(a) - Q(a)), (N, B, 2 * action_dim).

    With s = 1 - a^2: dL/du = entropy * 2 a s / (s + epsilon) - dQ/da * s (over B), which is also dL/d mean;
    dL/d log_std = dL/du * std * noise - entropy (over B).

    Args:
        sample: (N, B) actions.
        entropy: entropy coefficients, (N, 1, 1).
        action_gradient: dQ/da, (N, B, action_dim).
    """
    batch_size = sample.actions.shape[1]
    slope = 1.0 - sample.actions.square()
    towards_mean = slope * (2.0 * entropy * sample.actions / (slope + SQUASH_EPSILON) - action_gradient)
    towards_log_std = towards_mean * sample.scaled_noise - entropy * sample.unclamped
    return torch.cat([towards_mean, towards_log_std], dim=-1) / batch_size


@dataclass(frozen=True)
class StackedLayer:
    """Views into a network's flat vectors: weights (S, outputs, inputs) and biases (S, 1, outputs)."""

    weight: Tensor
    bias: Tensor
    weight_gradient: Tensor
    bias_gradient: Tensor


@final
class StackedNetwork:
    """S fully connected ReLU networks of equal shape.

    All parameters are views into one flat vector and all gradients views into another, so that one optimizer
    call updates them. `widths` are the numbers of inputs, hidden units per layer, and outputs.
    """

    def __init__(self, num_networks: int, widths: Sequence[int], device: torch.device) -> None:
        self.num_networks, self.widths = num_networks, tuple(widths)
        shapes = [
            shape
            for inputs, outputs in pairwise(widths)
            for shape in ((num_networks, outputs, inputs), (num_networks, 1, outputs))
        ]
        self.parameters = padded_zeros(sum(_rounded_up(_size(shape)) for shape in shapes), device)
        self.gradient = torch.zeros_like(self.parameters)
        values, gradients = _views(self.parameters, shapes), _views(self.gradient, shapes)
        self.layers = [
            StackedLayer(*views)
            for views in zip(values[::2], values[1::2], gradients[::2], gradients[1::2], strict=True)
        ]

    def buffers(self, num_rows: int) -> list[Tensor]:
        """Buffers for the layers' outputs or for their gradients, of shapes (S, num_rows, width)."""
        shapes = [(self.num_networks, num_rows, width) for width in self.widths[1:]]
        return [torch.zeros(shape, device=self.parameters.device) for shape in shapes]

    def forward(self, inputs: Tensor, outputs: Sequence[Tensor]) -> Tensor:
        """Fills all layers' outputs for inputs (S, rows, widths[0]); returns the last layer's."""
        for layer, output in zip(self.layers, outputs, strict=True):
            torch.baddbmm(layer.bias, inputs, layer.weight.transpose(1, 2), out=output)
            if output is not outputs[-1]:
                output.relu_()
            inputs = output
        return inputs

    def propagate(self, outputs: Sequence[Tensor], deltas: Sequence[Tensor]) -> None:
        """Propagates the loss's gradient from the last layer to the first, after `forward`.

        The last of `deltas` holds dL / d outputs[-1]; the others receive the gradients with respect to the
        layers' outputs before the ReLU.
        """
        for index in range(len(self.layers) - 1, 0, -1):
            delta = deltas[index - 1]
            torch.bmm(deltas[index], self.layers[index].weight, out=delta)
            torch.ops.aten.threshold_backward.grad_input(delta, outputs[index - 1], 0, grad_input=delta)

    def fill_gradient(self, inputs: Tensor, outputs: Sequence[Tensor], deltas: Sequence[Tensor]) -> None:
        """Computes the parameters' gradient from the results of `forward` and `propagate`."""
        for layer, seen, delta in zip(self.layers, (inputs, *outputs), deltas, strict=False):
            torch.bmm(delta.transpose(1, 2), seen, out=layer.weight_gradient)
            torch.sum(delta, dim=1, keepdim=True, out=layer.bias_gradient)

    def input_gradient(self, deltas: Sequence[Tensor], first: int) -> Tensor:
        """Gradient dL / d inputs[..., first:], (S, rows, widths[0] - first)."""
        return torch.bmm(deltas[0], self.layers[0].weight[:, :, first:])


def padded_zeros(size: int, device: torch.device) -> Tensor:
    """A float32 vector of zeros with at least `size` elements, a multiple of PADDING."""
    return torch.zeros(_rounded_up(size), device=device)


def _views(flat: Tensor, shapes: Sequence[tuple[int, ...]]) -> list[Tensor]:
    """Consecutive views with the given shapes; all start at multiples of PADDING."""
    starts = [0]
    for shape in shapes:
        starts.append(starts[-1] + _rounded_up(_size(shape)))
    return [flat[start:][: _size(shape)].view(shape) for start, shape in zip(starts, shapes, strict=False)]


def _size(shape: tuple[int, ...]) -> int:
    return torch.Size(shape).numel()


def _rounded_up(size: int) -> int:
    return -(-size // PADDING) * PADDING


@final
class StackedSac:
    """N agents; an agent has an actor, two critics with targets, an entropy coefficient and Adam moments.

    Critic k of agent n is network k * N + n of `critics`.
    """

    def __init__(
        self,
        num_agents: int,
        observation_dim: int,
        action_dim: int,
        *,
        settings: SacSettings,
        device: torch.device,
    ) -> None:
        self.num_agents, self.settings, self.device = num_agents, settings, device
        self._observation_dim, self._action_dim = observation_dim, action_dim
        critic_widths = (observation_dim + action_dim, *settings.hidden, 1)
        self.actors = StackedNetwork(num_agents, (observation_dim, *settings.hidden, 2 * action_dim), device)
        self.critics = StackedNetwork(CRITICS * num_agents, critic_widths, device)
        self.targets = StackedNetwork(CRITICS * num_agents, critic_widths, device)
        # SB3 starts a learned coefficient, whose target is -action_dim, at 1
        initial = 0.0 if settings.entropy == "auto" else math.log(settings.entropy)
        self._log_entropy = padded_zeros(num_agents, device).fill_(initial)
        self._log_entropy_gradient = torch.zeros_like(self._log_entropy)
        learned = [(self._log_entropy, self._log_entropy_gradient)] if settings.entropy == "auto" else []
        self._critic_optimizer = self._adam([(self.critics.parameters, self.critics.gradient), *learned])
        self._actor_optimizer = self._adam([(self.actors.parameters, self.actors.gradient)])
        self._make_buffers(settings.batch_size)

    def _adam(self, vectors: Sequence[tuple[Tensor, Tensor]]) -> Adam:
        for vector, gradient in vectors:
            vector.grad = gradient
        optimizer = Adam([vector for vector, _ in vectors], lr=self.settings.learning_rate, fused=True)
        optimizer.step()  # creates the moments; changes nothing else, since gradients are zero
        for state in optimizer.state.values():
            state["step"].zero_()
        return optimizer

    def _make_buffers(self, batch_size: int) -> None:
        networks = CRITICS * self.num_agents
        self._actor_inputs = torch.zeros(
            (self.num_agents, 2 * batch_size, self._observation_dim), device=self.device
        )
        self._critic_inputs = torch.zeros(
            (networks, batch_size, self._observation_dim + self._action_dim), device=self.device
        )
        self._actor_outputs = self.actors.buffers(2 * batch_size)
        self._actor_deltas = self.actors.buffers(batch_size)
        self._critic_outputs = self.critics.buffers(batch_size)
        self._critic_deltas = self.critics.buffers(batch_size)
        self._acting = self.actors.buffers(1)

    @property
    def log_entropy(self) -> Tensor:
        """Logarithms of the entropy coefficients, (N,)."""
        return self._log_entropy[: self.num_agents]

    def initialize(self, agent: int, uniform: Callable[[tuple[int, ...]], Tensor]) -> None:
        """Initializes one agent's networks like torch's Linear, uniform within +-1 / sqrt(inputs).

        Args:
            uniform: draws uniform numbers from [-1, 1) in a given shape.
        """
        for network, stack in ((agent, self.actors), *self._critics_of(agent)):
            for layer in stack.layers:
                bound = 1.0 / math.sqrt(layer.weight.shape[2])
                for tensor in (layer.weight, layer.bias):
                    tensor[network] = bound * uniform(tuple(tensor.shape[1:])).to(self.device)
        self.targets.parameters.copy_(self.critics.parameters)

    def _critics_of(self, agent: int) -> list[tuple[int, StackedNetwork]]:
        return [(critic * self.num_agents + agent, self.critics) for critic in range(CRITICS)]

    def act(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Sampled actions (N, action_dim) for observations (N, observation_dim)."""
        head = self.actors.forward(observations[:, None], self._acting)[:, 0]
        return sample_policy(head, noise).actions

    def update(self, batch: ReplayBatch, noise: Tensor) -> None:
        """One gradient step of every agent.

        Args:
            noise: (N, 2B, action_dim) standard normal; B for observations, then B for next observations.
        """
        batch_size = self.settings.batch_size
        entropy = self.log_entropy.exp()[:, None]
        torch.cat([batch.observations, batch.next_observations], dim=1, out=self._actor_inputs)
        both = sample_policy(self.actors.forward(self._actor_inputs, self._actor_outputs), noise)
        now = PolicySample(
            both.actions[:, :batch_size],
            both.log_probs[:, :batch_size],
            both.scaled_noise[:, :batch_size],
            both.unclamped[:, :batch_size],
        )
        next_values = self._values(self.targets, batch.next_observations, both.actions[:, batch_size:])
        soft_values = next_values.amin(dim=0) - entropy * both.log_probs[:, batch_size:]
        goal = batch.rewards + (1.0 - batch.terminated) * self.settings.gamma * soft_values
        self._step_critics(batch, goal, now.log_probs)
        self._step_actors(batch.observations, now, entropy[:, :, None])
        self.targets.parameters.lerp_(self.critics.parameters, self.settings.tau)

    def _values(self, critics: StackedNetwork, observations: Tensor, actions: Tensor) -> Tensor:
        """Q values of both critics, (2, N, B); leaves inputs and layer outputs in the buffers."""
        halves = self._critic_inputs.view(CRITICS, self.num_agents, *self._critic_inputs.shape[1:])
        halves[..., : self._observation_dim] = observations
        halves[..., self._observation_dim :] = actions
        values = critics.forward(self._critic_inputs, self._critic_outputs)
        return values.view(CRITICS, self.num_agents, -1)

    def _step_critics(self, batch: ReplayBatch, goal: Tensor, log_probs: Tensor) -> None:
        """Minimizes sum_k mean_B((Q_k - goal)^2) / 2 and -log_entropy mean_B(log pi + target) by one step."""
        values = self._values(self.critics, batch.observations, batch.actions)
        self._critic_deltas[-1].view_as(values).copy_((values - goal) / goal.shape[1])
        self.critics.propagate(self._critic_outputs, self._critic_deltas)
        self.critics.fill_gradient(self._critic_inputs, self._critic_outputs, self._critic_deltas)
        self._log_entropy_gradient[: self.num_agents] = self._action_dim - log_probs.mean(dim=1)
        self._critic_optimizer.step()

    def _step_actors(self, observations: Tensor, sample: PolicySample, entropy: Tensor) -> None:
        """Minimizes mean_B(entropy * log pi - min_k Q_k) by one step, with the critics after their step."""
        batch_size = self.settings.batch_size
        values = self._values(self.critics, observations, sample.actions)
        smaller = self._critic_deltas[-1].view_as(values)
        torch.le(values[0], values[1], out=smaller[0])
        torch.sub(1.0, smaller[0], out=smaller[1])
        self.critics.propagate(self._critic_outputs, self._critic_deltas)
        gradient = self.critics.input_gradient(self._critic_deltas, self._observation_dim)
        action_gradient = gradient.view(CRITICS, *sample.actions.shape).sum(dim=0)
        self._actor_deltas[-1].copy_(head_gradient(sample, entropy, action_gradient))
        outputs = [output[:, :batch_size] for output in self._actor_outputs]
        self.actors.propagate(outputs, self._actor_deltas)
        self.actors.fill_gradient(self._actor_inputs[:, :batch_size], outputs, self._actor_deltas)
        self._actor_optimizer.step()

    def state(self) -> dict[str, Tensor]:
        """All tensors that updates change, by name; writing to them restores a state."""
        tensors = {
            "actors": self.actors.parameters,
            "critics": self.critics.parameters,
            "targets": self.targets.parameters,
            "log_entropy": self._log_entropy,
        }
        for name, optimizer in (("critic", self._critic_optimizer), ("actor", self._actor_optimizer)):
            for index, state in enumerate(optimizer.state.values()):
                tensors |= {f"adam.{name}.{index}.{key}": state[key] for key in sorted(state)}
        return tensors
