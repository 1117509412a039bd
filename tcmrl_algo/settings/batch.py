"""The `[training.batch]` table."""

from pydantic import BaseModel, ConfigDict, Field, PositiveInt


class BatchSettings(BaseModel):
    """The `[training.batch]` table; a method requests what it reads of it.

    Attributes:
        tasks: tasks per batch, drawn without replacement; all training tasks where there are fewer.
        transitions: transitions per task for the actor-critic.
        context_trajectories: context trajectories per task; one of these numbers is drawn for every batch.
        execution_trajectories: execution trajectories per task, never among the context ones. TCMRL
            estimates rewards on them: 16 tasks with one trajectory of 20 steps are 320 targets per step for
            Eq. 7 and 16 for Eq. 17, so that 20 trajectories give Eq. 17 as many (paper: not said).
        windows: windows of K steps per task, uniform over all valid windows; 0 for none.
        window_length: K.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    tasks: int = Field(default=16, ge=2)
    transitions: int = Field(default=256, ge=1)
    context_trajectories: tuple[PositiveInt, ...] = Field(default=(1,), min_length=1)
    execution_trajectories: int = Field(default=1, ge=1)
    windows: int = Field(default=0, ge=0)
    window_length: int = Field(default=2, ge=2)
