"""BOReL's networks: a recurrent belief over tasks, and decoders that train it."""

from typing import NamedTuple, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from tcmrl_algo.algorithms.borel.config import BorelConfig
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.networks.perceptron import Perceptron, Standardizer, linear
from tcmrl_algo.networks.recurrent import recurrent


class Beliefs(NamedTuple):
    """Gaussians over the task variable.

    Attributes:
        means: (..., belief).
        log_variances: (..., belief).
    """

    means: Tensor
    log_variances: Tensor

    @property
    def context(self) -> Tensor:
        """(..., 2 belief), what the policy reads: means and log variances."""
        return torch.cat(self, dim=-1)


class StepValues(NamedTuple):
    """Standardised values of steps.

    Attributes:
        states, next_states: (..., observation_dim).
        actions: (..., action_dim).
        rewards: (..., 1).
        changes: (..., observation_dim), s_{t+1} - s_t in their own units.
    """

    states: Tensor
    actions: Tensor
    rewards: Tensor
    next_states: Tensor
    changes: Tensor


@final
class StepReader(nn.Module):
    """Standardises steps by the moments of the data."""

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        self.states = Standardizer(problem.observation_mean, problem.observation_std)
        self.actions = Standardizer(problem.action_mean, problem.action_std)
        self.rewards = Standardizer(torch.tensor([problem.reward_mean]), torch.tensor([problem.reward_std]))
        self.changes = Standardizer(problem.change_mean, problem.change_std)

    def forward(
        self,
        states: Float[Tensor, "*steps observation"],
        actions: Float[Tensor, "*steps action"],
        rewards: Float[Tensor, "*steps"],
        next_states: Float[Tensor, "*steps observation"],
    ) -> StepValues:
        return StepValues(
            self.states(states),
            self.actions(actions),
            self.rewards(rewards.unsqueeze(-1)),
            self.states(next_states),
            self.changes(next_states - states),
        )


@final
class BeliefEncoder(nn.Module):
    """Filters a belief: a GRU over embeddings of a_t, s_{t+1} and r_t, and linear heads on its state."""

    def __init__(self, problem: Problem, config: BorelConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        widths = (config.action_embedding, config.state_embedding, config.reward_embedding)
        self.actions = linear(problem.action_dim, widths[0], generator)
        self.states = linear(problem.observation_dim, widths[1], generator)
        self.rewards = linear(1, widths[2], generator)
        self.recurrence = recurrent(sum(widths), config.recurrent_hidden, generator)
        self.heads = linear(config.recurrent_hidden, 2 * config.belief, generator)

    def start(self, lanes: int) -> Float[Tensor, "lanes hidden"]:
        """The state of the GRU before the first step."""
        return self.heads.weight.new_zeros(lanes, self.recurrence.hidden_size)

    def states_along(self, values: StepValues) -> Float[Tensor, "lanes beliefs hidden"]:
        """States of the GRU before the first step and after every step, by one pass over (lanes, steps)."""
        start = self.start(len(values.actions))
        if not values.actions.shape[1]:
            return start.unsqueeze(1)
        found, _ = self.recurrence(self._inputs(values), start.unsqueeze(0))
        return torch.cat([start.unsqueeze(1), found], dim=1)

    def following(
        self, hidden: Float[Tensor, "lanes hidden"], values: StepValues, active: Bool[Tensor, " lanes"]
    ) -> Float[Tensor, "lanes hidden"]:
        """States after one step of every lane; those of other than active lanes stay."""
        step = StepValues(*(value.unsqueeze(1) for value in values))
        found, _ = self.recurrence(self._inputs(step), hidden.unsqueeze(0))
        return torch.where(active.unsqueeze(-1), found.squeeze(1), hidden)

    def beliefs(self, hidden: Float[Tensor, "*lanes hidden"]) -> Beliefs:
        """The beliefs that states of the GRU hold."""
        return Beliefs(*self.heads(hidden).chunk(2, dim=-1))

    def _inputs(self, values: StepValues) -> Tensor:
        parts = (self.actions(values.actions), self.states(values.next_states), self.rewards(values.rewards))
        return torch.cat([torch.relu(part) for part in parts], dim=-1)


@final
class BeliefDecoder(nn.Module):
    """Predicts rewards, and changes of the state where asked, from a task variable z and the step.

    The reward's decoder reads z, s_{t+1}, s_t and a_t; the one of changes does not read s_{t+1}.
    """

    def __init__(self, problem: Problem, config: BorelConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        state, action, hidden = config.state_embedding, config.action_embedding, config.decoder_hidden
        self.states = linear(problem.observation_dim, state, generator)
        self.next_states = linear(problem.observation_dim, state, generator)
        self.actions = linear(problem.action_dim, action, generator)
        sizes = (config.belief + 2 * state + action, *hidden, 1)
        self.reward = Perceptron(sizes, generator=generator)
        self.change: Perceptron | None = None
        if config.decode_state:
            sizes = (config.belief + state + action, *hidden, problem.observation_dim)
            self.change = Perceptron(sizes, generator=generator)

    def forward(
        self, variables: Float[Tensor, "lanes draws belief"], values: StepValues
    ) -> Float[Tensor, "lanes draws steps outputs"]:
        """What every drawn z predicts of every step of its lane."""
        states, actions = torch.relu(self.states(values.states)), torch.relu(self.actions(values.actions))
        parts = [torch.cat([states, actions, torch.relu(self.next_states(values.next_states))], dim=-1)]
        decoders = [self.reward]
        if self.change is not None:
            decoders.append(self.change)
            parts.append(torch.cat([states, actions], dim=-1))
        shape = (*variables.shape[:2], values.actions.shape[1])
        spread = variables.unsqueeze(2).expand(*shape, -1)
        found = [
            decoder(torch.cat([spread, part.unsqueeze(1).expand(*shape, -1)], dim=-1))
            for decoder, part in zip(decoders, parts, strict=True)
        ]
        return torch.cat(found, dim=-1)

    def targets(self, values: StepValues) -> Float[Tensor, "lanes steps outputs"]:
        """What `forward` predicts."""
        return values.rewards if self.change is None else torch.cat([values.rewards, values.changes], dim=-1)
