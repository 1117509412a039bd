"""The `[training.run]` table."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

PROTOCOL_GROUP = "tcmrl.protocols"
"""The entry point group of protocols, which live in a room above this one."""


EVALUATION_KEYS = frozenset(
    {
        "protocol",
        "episodes",
        "random_episodes",
        "candidates",
        "repeats",
        "offline_trajectories",
        "final_episodes",
    }
)
"""Settings of `RunSettings` that only evaluation reads."""

LOGGING_KEYS = frozenset({"log_every", "checkpoint_every"})
"""Settings of `RunSettings` that change no tensor."""


class RunSettings(BaseModel):
    """The `[training.run]` table.

    Attributes:
        algorithm: a file of `tcmrl_algo/algorithms`.
        steps: training steps, and the length of all schedules.
        snapshots: which snapshots to learn from: `all`, `last`, `steps>=N`,
            `return>=Q` or `tier:NAME`.
        context_snapshots: which snapshots context and execution trajectories and windows come from, and
            stored contexts in evaluation; those of `snapshots` if left out. What a policy learns from is
            always of `snapshots`, also the trajectories of a method that requests nothing else (BOReL).
        threads: CPU threads of torch; results depend on it in their last bits.
        precision: in which hidden layers multiply; all else is float32. `bfloat16` is faster where the
            processor multiplies it in hardware, and changes results.
        log_every: steps between two lines of metrics.
        checkpoint_every: steps between two checkpoints.
        protocol: how to adapt to test tasks (paper, section 4.2: `paper`).
        episodes: adaptation episodes per test task, of all protocols and all methods.
        random_episodes: how many of them form the first stage: the method's exploration under `paper`, which
            is uniform actions unless it has one of its own, and tried contexts of training tasks under
            `idaq_literal` (published code: one setting for both). 0 begins `paper` with the prior of a
            method that needs no trajectories.
        candidates: how many training tasks are drawn for every episode of the first stage of `idaq_literal`,
            of which the one with the most distant context is tried.
        repeats: how many times a protocol with a random first stage is run, by independent seeds; results
            are means.
        offline_trajectories: stored trajectories in a context, under `offline` and of training tasks.
        final_episodes: episodes of the adapted policy that its final return averages over.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    algorithm: str = "tcmrl"
    steps: int = Field(default=100_000, ge=1)
    snapshots: str = "all"
    context_snapshots: str | None = None
    threads: int = Field(default=1, ge=1)
    precision: Literal["float32", "bfloat16"] = "float32"
    log_every: int = Field(default=100, ge=1)
    checkpoint_every: int = Field(default=5_000, ge=1)
    protocol: str = "paper"
    episodes: int = Field(default=10, ge=1)
    random_episodes: int = Field(default=5, ge=0)
    candidates: int = Field(default=5, ge=1)
    repeats: int = Field(default=5, ge=1)
    offline_trajectories: int = Field(default=4, ge=1)
    final_episodes: int = Field(default=1, ge=1)
