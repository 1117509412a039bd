"""What the actor-critic learns from: transitions beside the context of their task."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class ConditionedRows:
    """Transitions of all tasks in one flat batch; states are standardised and followed by their context."""

    inputs: Float[Tensor, "rows inputs"]
    next_inputs: Float[Tensor, "rows inputs"]
    actions: Float[Tensor, "rows action"]
    rewards: Float[Tensor, " rows"]
    terminated: Float[Tensor, " rows"]
