"""What tuning leaves: one JSON document with the space, all trials and the best one."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from tcmrl_algo.algorithms.core.method import SettingValue
from tcmrl_algo.experiment.config import override_texts
from tcmrl_algo.tuning.space import Dimension
from tcmrl_data import Profile
from tcmrl_data.foundation.records import read_record

RECORD = "tuning.json"


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TrialRun(_Record):
    """A trial's run with one seed.

    Attributes:
        seed: of the run.
        normalized: mean over the held-out tasks of the normalised return, by protocol.
        final: likewise of the return itself.
        digest: sha256 over the run's tensors.
    """

    seed: int
    normalized: dict[str, float]
    final: dict[str, float]
    digest: str


class Trial(_Record):
    """One choice of settings, trained once per seed.

    Attributes:
        number: from 0; trial 0 takes the training table as it is.
        drawn: what was drawn from the space.
        values: the settings that this gives.
        runs: one per seed, where the trial ended well.
        score: mean over its runs and protocols of the normalised return; None before the end, and where
            training diverged.
        error: why it diverged.
    """

    number: int
    drawn: dict[str, SettingValue]
    values: dict[str, SettingValue]
    runs: tuple[TrialRun, ...] = ()
    score: float | None = None
    error: str | None = None

    @property
    def is_done(self) -> bool:
        """Whether it ended, well or in divergence."""
        return self.score is not None or self.error is not None

    @property
    def overrides(self) -> tuple[str, ...]:
        """The settings as texts that `tcmrl train --set` takes."""
        return tuple(override_texts(self.values))


class Tuning(_Record):
    """`tuning.json`: everything that tuning did and on what.

    Attributes:
        algorithm, environment, profile: what was tuned, from whose training table.
        root: of the dataset; its test tasks were not used.
        seed: of the proposals.
        seeds: every trial was trained with each.
        steps: of training.
        protocols: by which trials were scored.
        training_tasks, held_out: the dataset's training tasks that trials were trained on, and scored on.
        space: what was searched, by setting.
        identity: everything that scores are a function of, beside code, device and threads.
        versions: packages that results depend on.
        trials: in the order of their numbers.
        best: number of the trial with the highest score, the first one of equals; None without any.
    """

    schema_version: Literal[1] = 1
    algorithm: str
    environment: str
    profile: Profile
    root: str
    seed: int
    seeds: tuple[int, ...]
    steps: int
    protocols: tuple[str, ...]
    training_tasks: tuple[int, ...]
    held_out: tuple[int, ...]
    space: dict[str, Dimension]
    identity: dict[str, Any]
    versions: dict[str, str]
    trials: tuple[Trial, ...] = ()
    best: int | None = None

    @property
    def best_trial(self) -> Trial | None:
        """The trial with the highest score."""
        return None if self.best is None else self.trials[self.best]

    def with_trials(self, trials: Iterable[Trial]) -> "Tuning":
        """The record with these trials in place of those of their numbers, or added."""
        merged = {trial.number: trial for trial in (*self.trials, *trials)}
        ordered = tuple(merged[number] for number in sorted(merged))
        scores = {trial.number: trial.score for trial in ordered if trial.score is not None}
        best = max(scores, key=lambda number: (scores[number], -number)) if scores else None
        return self.model_copy(update={"trials": ordered, "best": best})


def read_tuning(folder: str | Path) -> Tuning:
    """What `tcmrl tune` left in a folder.

    Raises:
        CheckpointError: nothing, or another file.

    Example:
        >>> read_tuning("tuning/point-robot-tcmrl").best_trial.overrides  # doctest: +SKIP
    """
    return read_record(Tuning, Path(folder) / RECORD)
