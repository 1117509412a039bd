"""The `[training.optimizer]` table."""

from pydantic import BaseModel, ConfigDict, Field


class OptimizerSettings(BaseModel):
    """The `[training.optimizer]` table.

    Attributes:
        learning_rate: of Adam (paper, F.2: 3e-4).
        final_share: share of it left at the last step, reached linearly (paper: constant, 1).
        gradient_norm: bound of the gradient's norm; absent for none (paper: none).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    learning_rate: float = Field(default=3e-4, gt=0)
    final_share: float = Field(default=1.0, ge=0, le=1)
    gradient_norm: float | None = Field(default=None, gt=0)
