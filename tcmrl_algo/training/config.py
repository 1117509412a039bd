"""The `[training]` table of a recipe, resolved: what a run does, validated once."""

import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import nn

from tcmrl_algo.actor_critic.actor_critic import ActorCriticSettings
from tcmrl_algo.networks.optimizer import Adam
from tcmrl_data import BatchSizes, TcmrlError, TrainingError, apply_overrides, first_problem, plugin

ALGORITHMS = "tcmrl_algo.algorithms"
Table = TypeVar("Table", bound=BaseModel)
Protocol = Literal["paper", "offline", "idaq"]


class RunSettings(BaseModel):
    """The `[training.run]` table.

    Attributes:
        algorithm: a file of `tcmrl_algo/algorithms`.
        steps: training steps, and the length of all schedules.
        snapshots: which snapshots to learn from: `all`, `last`, `steps>=N` or `return>=Q`.
        context_snapshots: which snapshots context and execution trajectories and windows come from, and
            stored contexts in evaluation; those of `snapshots` if left out. The actor-critic's
            transitions are always those of `snapshots`.
        threads: CPU threads of torch; results depend on it in their last bits.
        precision: in which hidden layers multiply; all else is float32. `bfloat16` is faster where the
            processor multiplies it in hardware, and changes results.
        log_every: steps between two lines of metrics.
        checkpoint_every: steps between two checkpoints.
        protocol: how to adapt to test tasks (paper, section 4.2: `paper`).
        episodes: adaptation episodes per test task.
        random_episodes: how many of them act uniformly, under `paper`.
        offline_trajectories: stored trajectories that make one context, under `offline`.
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
    protocol: Protocol = "paper"
    episodes: int = Field(default=10, ge=1)
    random_episodes: int = Field(default=2, ge=1)
    offline_trajectories: int = Field(default=4, ge=1)
    final_episodes: int = Field(default=1, ge=1)


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

    def build(self, module: nn.Module, *, decay_steps: int) -> Adam:
        """Adam over the module, its rate falling over `decay_steps`."""
        return Adam(
            module,
            learning_rate=self.learning_rate,
            final_share=self.final_share,
            decay_steps=decay_steps,
            gradient_norm=self.gradient_norm,
        )


class TrainingSettings(BaseModel):
    """What all methods share. `batch` is the sampler's own table; K is its `window_length`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    run: RunSettings = RunSettings()
    batch: BatchSizes = BatchSizes(execution_trajectories=1)
    optimizer: OptimizerSettings = OptimizerSettings()
    actor_critic: ActorCriticSettings = ActorCriticSettings()


class TrainingConfig(BaseModel):
    """A resolved run: the shared settings and the chosen method's own table.

    Attributes:
        settings: the shared tables.
        method: the table named after the algorithm, as its module's `Config` dumps it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    settings: TrainingSettings
    method: dict[str, Any]


def resolve(
    table: Mapping[str, Any], *, place: str, algorithm: str | None = None, overrides: Sequence[str] = ()
) -> TrainingConfig:
    """The run that a recipe's training table asks for.

    Args:
        table: `[training]` of one profile.
        place: names the table's origin in errors.
        algorithm: instead of the table's `run.algorithm`.
        overrides: `section.key=value` texts, applied last.

    Raises:
        TrainingError: an unknown key or a wrong type.
        TcmrlError: no such algorithm.
    """
    tables = apply_overrides(table, overrides)
    run = tables.get("run", {})
    if algorithm is not None and isinstance(run, Mapping):
        tables["run"] = {**run, "algorithm": algorithm}
    shared = {name: tables.pop(name) for name in TrainingSettings.model_fields if name in tables}
    settings = validated(TrainingSettings, shared, place)
    kind: type[BaseModel] = plugin(ALGORITHMS, "algorithm", settings.run.algorithm).Config
    for name in sorted(tables):
        _check_method_table(name, place)
    method = validated(kind, tables.get(settings.run.algorithm, {}), f"{place}, [{settings.run.algorithm}]")
    return TrainingConfig(settings=settings, method=method.model_dump(mode="json"))


def _check_method_table(name: str, place: str) -> None:
    try:
        plugin(ALGORITHMS, "algorithm", name)
    except TcmrlError:
        known = ", ".join(TrainingSettings.model_fields)
        raise TrainingError(
            f"{place}: unknown table {name!r}; known are {known}, and one named after each algorithm"
        ) from None


def validated(kind: type[Table], values: Mapping[str, Any], place: str) -> Table:
    """The values as a settings object; strict, but for lists that stand for tuples.

    Raises:
        TrainingError: with the first complaint in one line.
    """
    try:
        return kind.model_validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as error:
        raise TrainingError(f"{place}: {first_problem(error)}") from None
