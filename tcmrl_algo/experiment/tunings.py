"""Tunings: search spaces, `tuning.json`, rows of `tuning.csv`, and the settings that experiments take."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tcmrl_algo.algorithms.core.method import METHODS, Factors, Search, SettingValue
from tcmrl_algo.algorithms.core.settings import UNREAD, ActorCriticSettings, TrainingConfig
from tcmrl_algo.experiment.results import Tuned, read_table
from tcmrl_algo.experiment.spec import Experiment, override_texts
from tcmrl_data import Profile, TrainingError, apply_overrides
from tcmrl_data.foundation.records import Frozen, read_record

RECORD, TABLE = "tuning.json", "tuning.csv"
SIGNIFICANT_DIGITS = 3
"""Of values that a factor gives: more would only make overrides longer."""


class Dimension(Frozen):
    """One searched setting.

    Attributes:
        kind: `options` draws one of `options`; `factors` draws a factor from `low` to `high`.
        own: the training table's value, which the first trial takes.
        options: all of them; none for `factors`.
        low, high: range of the factor; None for `options`.
    """

    kind: Literal["options", "factors"]
    own: SettingValue
    options: tuple[SettingValue, ...] = ()
    low: float | None = None
    high: float | None = None

    @property
    def first(self) -> SettingValue:
        """What the first trial draws."""
        return self.own if self.kind == "options" else 1.0

    def value(self, drawn: SettingValue) -> SettingValue:
        """The setting's value where `drawn` was drawn."""
        if self.kind == "options":
            return drawn
        if drawn == self.first:
            return self.own
        return float(f"{float(self.own) * float(drawn):.{SIGNIFICANT_DIGITS}g}")


class TrialRun(Frozen):
    """A trial's run with one seed.

    Attributes:
        normalized: mean over the held-out tasks of the normalised return, by protocol.
        final: likewise of the return itself.
    """

    seed: int
    normalized: dict[str, float]
    final: dict[str, float]
    digest: str


class Trial(Frozen):
    """One choice of settings, trained once per seed.

    Attributes:
        number: from 0; trial 0 takes the training table as it is.
        drawn: what was drawn from the space.
        values: the settings that this gives.
        runs: one per seed, where the trial ended well.
        score: mean over its runs and protocols of the normalised return; None before the end, and where
            training diverged.
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


class Tuning(Frozen):
    """`tuning.json`: everything that tuning did and on what.

    Attributes:
        algorithm, environment, profile: what was tuned, from whose training table.
        root: of the dataset; its test tasks were not used.
        seeds: every trial was trained with each.
        protocols: by which trials were scored.
        training_tasks, held_out: the dataset's training tasks that trials were trained on, and scored on.
        space: what was searched, by setting.
        identity: everything that scores are a function of, beside code, device and threads.
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


@dataclass(frozen=True)
class TrialRow:
    """A trial of a tuning.

    Attributes:
        tuning: name of its folder, `ENV-ALGO`, or another beginning that an experiment names.
        environment, root, profile, algorithm: what was tuned, and on what.
        steps, seeds, protocols: every trial was trained so long, with these seeds, and scored by these.
        held_out: the training tasks that trials were scored on.
        trial: number from 0; trial 0 takes the training table as it is.
        score: mean normalized return on the held-out tasks; None where training diverged.
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


def _best_settings(trials: Sequence[TrialRow]) -> Tuned | None:
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


def tuned_settings(
    experiment: Experiment, place: str | Path, *, environments: Sequence[str] = (), only: Sequence[str] = ()
) -> dict[str, dict[str, Tuned]]:
    """The best settings of every environment and algorithm of an experiment.

    Args:
        experiment: whose environments may name the environment of which the settings are.
        place: folder of tunings, each in `ENV-ALGO`, where `tcmrl tune` puts it; or a table of them.
        environments: those that are wanted; all where empty.
        only: labels of the methods that must be tuned; all where empty. Of others, those that exist are read.
            A method of which the experiment itself sets all that is searched need not be tuned.

    Raises:
        CheckpointError: a record or the table is damaged.
        TrainingError: a method was not tuned, no trial of it ended well, or methods of an environment were
            tuned with unequal effort.
    """
    trials = read_trials(Path(place))
    found = {
        environment: {
            algorithm: _tuned(trials, name, place, algorithm)
            for algorithm in sorted({method.algorithm for method in experiment.methods.values()})
            for name in [f"{choice.tuning or environment}-{algorithm}"]
            if algorithm in wanted or name in trials
        }
        for environment, choice in experiment.environments.items()
        if not environments or environment in environments
        for wanted in [_open_to_search(experiment, environment, only)]
    }
    for environment, settings in found.items():
        efforts = [(name, (one.trials, one.steps, one.seeds, one.root)) for name, one in settings.items()]
        for name, effort in efforts[1:]:
            first, expected = efforts[0]
            if effort != expected:
                raise TrainingError(
                    f"{place}: {first} was tuned for {environment} by {_effort(settings[first])}, {name} by "
                    f"{_effort(settings[name])}; tune methods with equal effort to compare them"
                )
    return found


def space_on(config: TrainingConfig, search: Search) -> dict[str, Dimension]:
    """A method's search space around the values of a resolved training table.

    A factor of a number that is 0 changes nothing; such a setting is left out.

    Raises:
        TrainingError: a setting that the method does not have, or a factor of what is no number.
    """
    name = config.settings.run.algorithm
    table = config.settings.model_dump(mode="json") | {name: config.method}
    space = {}
    for key, what in search.items():
        own = _value_at(table, key, name)
        if not isinstance(what, Factors):
            options = what.values if own in what.values else (own, *what.values)
            space[key] = Dimension(kind="options", own=own, options=options)
        elif isinstance(own, bool | str) or own < 0:
            raise TrainingError(f"{name} searches factors of {key}, which is {own!r} and no positive number")
        elif own > 0:
            space[key] = Dimension(kind="factors", own=own, low=what.low, high=what.high)
    return space


def _value_at(table: Mapping[str, Any], key: str, algorithm: str) -> SettingValue:
    value: Any = table
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if not isinstance(value, bool | int | float | str):
        raise TrainingError(f"{algorithm} searches {key!r}, which is no setting with a single value")
    return value


def searched(search: Search, overrides: Sequence[str], *, kind: str | None = None) -> Search:
    """The search without what an override gives a value, or the chosen actor-critic does not read.

    Args:
        kind: of the actor-critic; the one that the overrides choose, else the default, where None.
    """
    chosen = apply_overrides({}, overrides).get("actor_critic", {})
    kind = kind or chosen.get("kind", ActorCriticSettings().kind)
    fixed = [f"{text.partition('=')[0].strip()}." for text in overrides]
    fixed += [f"actor_critic.{name}." for name in UNREAD[kind]]
    return {key: what for key, what in search.items() if not f"{key}.".startswith(tuple(fixed))}


def _open_to_search(experiment: Experiment, environment: str, only: Sequence[str]) -> set[str]:
    """The algorithms of methods of whose search the experiment leaves something open."""
    return {
        method.algorithm
        for label, method in experiment.methods.items()
        if not only or label in only
        if searched(METHODS.get(method.algorithm).search, experiment.overrides(environment, label))
    }


def _tuned(trials: Mapping[str, Sequence[TrialRow]], name: str, place: str | Path, algorithm: str) -> Tuned:
    if name not in trials:
        folder = "tuning" if Path(place).is_file() else place
        raise TrainingError(
            f"{place}: {name} holds no tuning; `tcmrl tune --algo {algorithm} --out {folder}/{name}` "
            "makes one"
        )
    found = _best_settings(trials[name])
    if found is None:
        raise TrainingError(f"{place}, {name}: no trial ended well")
    return found


def _effort(tuned: Tuned) -> str:
    seeds = f"{len(tuned.seeds)} seed{'s' * (len(tuned.seeds) != 1)}"
    return f"{tuned.trials} trials of {tuned.steps} steps with {seeds} on {tuned.root[:12]}"
