"""Tunings as rows of a table, `tuning.csv`: one row per trial, with its score on held-out training tasks."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_algo.experiment.config import override_texts
from tcmrl_algo.experiment.flat import read_table
from tcmrl_algo.experiment.results import Tuned
from tcmrl_algo.tuning.record import RECORD, Tuning, read_tuning

TUNING = "tuning.csv"


@dataclass(frozen=True)
class TrialRow:
    """A trial of a tuning.

    Attributes:
        tuning: name of its folder, `ENV-ALGO`, or another beginning that an experiment names.
        environment, root, profile, algorithm: what was tuned, and on what.
        steps, seeds, protocols: every trial was trained so long, with these seeds, and scored by these.
        held_out: the training tasks that trials were scored on.
        trial: number from 0; trial 0 takes the training table as it is.
        values: the trial's settings, as JSON.
        score: mean normalized return on the held-out tasks; None where training diverged.
        error: why it diverged.
        best: whether no other score is higher.
    """

    tuning: str
    environment: str
    root: str
    profile: str
    algorithm: str
    steps: int
    seeds: str
    protocols: str
    held_out: str
    trial: int
    values: str
    score: float | None
    error: str | None
    best: bool


def trial_rows(name: str, tuning: Tuning) -> list[TrialRow]:
    """The trials of a tuning that ended."""
    return [
        TrialRow(
            tuning=name,
            environment=tuning.environment,
            root=tuning.root,
            profile=tuning.profile,
            algorithm=tuning.algorithm,
            steps=tuning.steps,
            seeds=" ".join(map(str, tuning.seeds)),
            protocols=" ".join(tuning.protocols),
            held_out=" ".join(map(str, tuning.held_out)),
            trial=trial.number,
            values=json.dumps(trial.values),
            score=trial.score,
            error=trial.error,
            best=trial.number == tuning.best,
        )
        for trial in tuning.trials
        if trial.is_done
    ]


def read_trials(place: Path) -> dict[str, list[TrialRow]]:
    """The trials of all tunings by the name of the tuning: in a table, or in a folder of theirs.

    Raises:
        CheckpointError: the table is not one, or a record is damaged.
    """
    found: dict[str, list[TrialRow]] = {}
    if place.is_file():
        for row in read_table(TrialRow, place):
            found.setdefault(row.tuning, []).append(row)
        return found
    folders = sorted(file.parent for file in place.glob(f"*/{RECORD}"))
    return {folder.name: trial_rows(folder.name, read_tuning(folder)) for folder in folders}


def best_settings(trials: Sequence[TrialRow]) -> Tuned | None:
    """The settings of the best trial, and the effort; None if no trial ended well."""
    for row in trials:
        if row.best and row.score is not None:
            return Tuned(
                environment=row.environment,
                root=row.root,
                profile=row.profile,
                trials=len(trials),
                steps=row.steps,
                seeds=tuple(map(int, row.seeds.split())),
                score=row.score,
                overrides=tuple(override_texts(json.loads(row.values))),
            )
    return None
