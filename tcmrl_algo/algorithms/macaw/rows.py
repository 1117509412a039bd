"""What MACAW's losses read: transitions of every lane, with what followed them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.networks.perceptron import Standardizer
from tcmrl_algo.settings.actor_critic import ActorCriticSettings
from tcmrl_data import Steps


@dataclass(frozen=True)
class LaneRows:
    """Transitions of every lane with what they returned.

    Attributes:
        states, final_states: (lanes, rows, observation_dim), standardised s_t and s_T.
        actions: (lanes, rows, action_dim).
        returns: (lanes, rows), G_t in units of the largest return.
        discounts: (lanes, rows), gamma^(T - t), 0 where the task ended the episode.
        mask: (lanes, rows) bool, real transitions.
    """

    states: Float[Tensor, "lanes rows observation"]
    final_states: Float[Tensor, "lanes rows observation"]
    actions: Float[Tensor, "lanes rows action"]
    returns: Float[Tensor, "lanes rows"]
    discounts: Float[Tensor, "lanes rows"]
    mask: Bool[Tensor, "lanes rows"]


def read_rows(
    steps: Steps, scaling: Standardizer, *, largest_return: float, most: int | None = None
) -> LaneRows:
    """Steps as rows of lanes.

    Args:
        steps: with returns; transitions (lanes, n), or trajectories (lanes, n, steps).
        scaling: of observations.
        largest_return: unit of the returns.
        most: takes so many evenly spaced real rows of every lane, or all where there are fewer.
    """
    assert steps.returns_to_go is not None and steps.discounts_to_end is not None
    assert steps.final_observations is not None
    mask = steps.mask.flatten(1)
    values = [steps.observations, steps.final_observations, steps.actions]
    values += [steps.returns_to_go.unsqueeze(-1), steps.discounts_to_end.unsqueeze(-1)]
    table = torch.cat(values, dim=-1).flatten(1, -2)
    if most is not None:
        places, mask = evenly_spaced_rows(mask, most)
        table = table.gather(1, places.unsqueeze(-1).expand(-1, -1, table.shape[-1]))
    widths = [value.shape[-1] for value in values]
    states, final, actions, returns, discounts = table.split(widths, dim=-1)
    return LaneRows(
        scaling(states),
        scaling(final),
        actions,
        returns.squeeze(-1) / largest_return,
        discounts.squeeze(-1),
        mask,
    )


def evenly_spaced_rows(
    mask: Bool[Tensor, "lanes rows"], most: int
) -> tuple[Int64[Tensor, "lanes chosen"], Bool[Tensor, "lanes chosen"]]:
    """Places of at most so many real rows of every lane, evenly spaced in their order, and which are real."""
    order = torch.argsort((~mask).int(), dim=1, stable=True)  # real rows first
    numbers = mask.sum(dim=1, keepdim=True)
    taken = numbers.clamp(max=most)
    places = torch.arange(min(most, mask.shape[1]), device=mask.device).expand(len(mask), -1)
    chosen = torch.where(places < taken, places * numbers // taken.clamp(min=1), 0)
    return order.gather(1, chosen), places < taken


def largest_return(problem: Problem, settings: ActorCriticSettings) -> float:
    """The largest discounted sum of absolute rewards in an episode that the data's range allows; not 0."""
    rewards = problem.reward_range if settings.rewards == "stored" else problem.dense_reward_range
    assert rewards is not None, "the request takes dense rewards, so that they are loaded"
    lasting = sum(settings.gamma**step for step in range(problem.horizon))
    return max(map(abs, rewards)) * lasting or 1.0
