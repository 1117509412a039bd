"""What the actor-critic learns from: transitions beside the context of their task."""

from dataclasses import dataclass, fields

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class ConditionedRows:
    """Transitions of all tasks in one flat batch; states are standardised and followed by their context.

    Attributes:
        inputs: states and contexts, without gradient.
        critic_inputs: the same for Q, whose gradient may reach the contexts; without Q, for the policy.
        next_inputs: next states and their contexts, without gradient.
        actions: in [-1, 1].
        rewards: scaled.
        terminated: 1 where the task ended the episode.
    """

    inputs: Float[Tensor, "rows inputs"]
    critic_inputs: Float[Tensor, "rows inputs"]
    next_inputs: Float[Tensor, "rows inputs"]
    actions: Float[Tensor, "rows action"]
    rewards: Float[Tensor, " rows"]
    terminated: Float[Tensor, " rows"]

    def where(self, real: Bool[Tensor, " all_rows"]) -> "ConditionedRows":
        """The rows at which `real` is True."""
        return ConditionedRows(*(getattr(self, field.name)[real] for field in fields(self)))
