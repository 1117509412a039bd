"""The `[training.actor_critic.iql]` table."""

from pydantic import BaseModel, ConfigDict, Field


class IqlSettings(BaseModel):
    """The `[training.actor_critic.iql]` table: implicit Q-learning (Kostrikov, Nair & Levine, 2021).

    Attributes:
        expectile: of min Q that V fits; 0.5 is the mean, 1 the largest (its paper: 0.7; 0.9 for AntMaze).
        inverse_temperature: beta, which multiplies the advantages (its paper: 3 for MuJoCo, 10 for AntMaze).
            Deviation: of advantages in units of their standard deviation over the batch.
        largest_weight: cap of exp(beta A) (its published code: 100).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    expectile: float = Field(default=0.7, gt=0, lt=1)
    inverse_temperature: float = Field(default=3.0, ge=0)
    largest_weight: float = Field(default=100.0, gt=0)
