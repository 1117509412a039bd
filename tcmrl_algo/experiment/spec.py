"""An experiment file, validated whole: what is compared, on what, and what is claimed of it."""

import importlib.resources
import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from tcmrl_data import CheckpointError, Profile, TrainingError
from tcmrl_data.foundation.plugins import unknown_name
from tcmrl_data.foundation.records import Frozen, leaves, parse_json, validate_table

Metric = Literal[
    "final",
    "curve",
    "regret",
    "normalized",
    "shuffled",
    "fixed",
    "training_seconds",
    "peak_memory",
    "context_ratio",
    "attention_zero",
    "attention_nonzero",
]
"""What a claim compares; `reporting.claims` says how a run gives them. `fixed` is the return of the best
policy that acts the same in all tasks, fitted on the training tasks."""

PAPER_PROTOCOLS = ("paper", "offline", "idaq")
"""By which the paper adapts, in its order; what an experiment evaluates by unless it says otherwise."""
LIKE = "like"
"""The key of a file that names another file, whose keys it takes where it has none."""


class EnvironmentChoice(Frozen):
    """One `[environments.NAME]` table.

    Attributes:
        dataset: its folder, unless another is given; `data/NAME` where unset.
        dataset_profile: the profile that its dataset is built with; any where unset.
        profile: whose training table to start from; the one the dataset was built with where unset.
        training: changes of that table, also of settings that were tuned.
        tuning: how the folders of its tunings begin, in a run with some: another environment, or any name;
            its own name where unset.
    """

    dataset: str | None = None
    dataset_profile: Profile | None = None
    profile: str | None = None
    training: dict[str, Any] = Field(default={})
    tuning: str | None = None


class MethodChoice(Frozen):
    """One `[methods.LABEL]` table.

    Attributes:
        training: changes of the training table, after those of the experiment and the environment.
        environments: in which the method is run; all of the experiment's where empty.
    """

    algorithm: str
    training: dict[str, Any] = Field(default={})
    environments: tuple[str, ...] = ()

    def runs_in(self, environment: str) -> bool:
        """Whether the method is run there."""
        return not self.environments or environment in self.environments


class Claim(Frozen):
    """One `[[claims]]` table: that one quantity is better than another, seed by seed.

    Attributes:
        better: label of the method that is said to be better.
        worse: label of the method that it is held against; may be the same, with another metric.
        metric: what is compared; a lower regret, time or memory is better, a higher anything else.
        against: what is taken from `worse`, where that is another metric.
        protocols: of evaluation, under each of which the claim is judged; all of the experiment's where
            empty. A metric that does not depend on the protocol is judged once.
        registered: the environment that decides a claim which was written before its runs, under the
            experiment's first protocol, by one uncorrected two-sided test. Everything else is exploratory.
    """

    text: str
    better: str
    worse: str
    metric: Metric = "final"
    against: Metric | None = None
    protocols: tuple[str, ...] = ()
    registered: str | None = None


class Experiment(Frozen):
    """A whole experiment file.

    Attributes:
        name: of its results folder.
        source: the figure or table of the paper that it stands for.
        seeds: every method is run with every seed.
        folds: into how many folds the tasks of a dataset are cut, each of which is the test split once; the
            dataset's own split where unset. Every method is run with every seed on every fold.
        methods: by label, in the order of tables and figures.
        training: changes of the training table that all runs share.
        protocols: by which trained runs are evaluated; learning curves are by the first.
        curve_points: evenly spaced steps at which a learning curve is evaluated.
    """

    schema_version: Literal[1] = Field(alias="schema")
    name: str = Field(pattern=r"^[a-z0-9_-]{1,64}$")
    title: str
    source: str
    seeds: tuple[int, ...] = Field(min_length=1)
    folds: int | None = Field(default=None, ge=2)
    environments: dict[str, EnvironmentChoice] = Field(min_length=1)
    methods: dict[str, MethodChoice] = Field(min_length=1)
    training: dict[str, Any] = Field(default={})
    protocols: tuple[str, ...] = Field(default=PAPER_PROTOCOLS, min_length=1)
    curve_points: int = Field(default=5, ge=1)
    claims: tuple[Claim, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> "Experiment":
        folders = [folder_name(label) for label in self.methods]
        for what, values in (("seeds", self.seeds), ("protocols", self.protocols), ("methods", folders)):
            if len(set(values)) < len(values) or "" in values:
                raise ValueError(f"{what} must be distinct names or numbers, got {list(values)}")
        for label, method in self.methods.items():
            if unknown := set(method.environments) - set(self.environments):
                known = ", ".join(self.environments)
                raise ValueError(f"method {label!r} names no environment {min(unknown)!r}; they are {known}")
        if min(self.seeds) < 0:
            raise ValueError(f"seeds must not be negative, got {list(self.seeds)}")
        for claim in self.claims:
            for label in (claim.better, claim.worse):
                if label not in self.methods:
                    known = ", ".join(map(repr, self.methods))
                    raise ValueError(f"claim {claim.text!r} names no method {label!r}; they are {known}")
            if claim.registered is not None and claim.registered not in self.environments:
                known = ", ".join(self.environments)
                raise ValueError(
                    f"claim {claim.text!r} is registered for {claim.registered!r}; environments are {known}"
                )
            for protocol in claim.protocols:
                if protocol not in self.protocols:
                    raise ValueError(
                        f"claim {claim.text!r}: protocol {protocol!r} is not evaluated; "
                        f"protocols are {', '.join(self.protocols)}"
                    )
        return self

    def overrides(self, environment: str, label: str) -> tuple[str, ...]:
        """What the file sets for a method in an environment, as the texts that `resolve` takes."""
        tables = (self.training, self.environments[environment].training, self.methods[label].training)
        return tuple(text for table in tables for text in override_texts(table))

    @property
    def fold_numbers(self) -> tuple[int | None, ...]:
        """The folds; (None,) for the dataset's own split."""
        return (None,) if self.folds is None else tuple(range(self.folds))

    def on(self, environments: Sequence[str]) -> "Experiment":
        """The experiment in these environments; in all of its own where none is named.

        Raises:
            TrainingError: it has no such environment.
        """
        unknown = [name for name in environments if name not in self.environments]
        if unknown:
            known = ", ".join(map(repr, self.environments))
            raise TrainingError(
                f"--environment {unknown[0]!r}: {self.name} has no such environment; they are {known}"
            )
        chosen = {name: choice for name, choice in self.environments.items() if name in environments}
        return self.model_copy(update={"environments": chosen}) if environments else self

    def at_profile(self, profile: Profile) -> "Experiment":
        """The same experiment with another profile's datasets and training tables.

        A number of training steps that the file sets belongs to the file's profile and is dropped.
        """
        environments = {
            name: choice.model_copy(
                update={
                    "profile": profile,
                    "dataset_profile": profile,
                    "training": _without_steps(choice.training),
                }
            )
            for name, choice in self.environments.items()
        }
        methods = {
            label: method.model_copy(update={"training": _without_steps(method.training)})
            for label, method in self.methods.items()
        }
        changes = {
            "environments": environments,
            "methods": methods,
            "training": _without_steps(self.training),
        }
        return self.model_copy(update=changes)

    def to_json(self) -> dict[str, Any]:
        """What `read_experiment` takes back."""
        return self.model_dump(mode="json", by_alias=True)


def load_experiment(name: str | Path) -> Experiment:
    """An experiment from a TOML file, or by the name of one that comes with the package.

    A file may say `like = "NAME"`, another experiment of the package or a TOML file beside it, from which it
    takes every top-level key that it leaves out. The experiment that is read holds them all.

    Raises:
        UnknownNameError: no experiment has such a name; says the nearest names.
        TrainingError: no such file, no TOML, an unknown key, a wrong type or a contradiction, or a file
            that is like one that is like another.

    Example:
        >>> load_experiment("table2").seeds
        (0, 1, 2, 3, 4)
    """
    return read_experiment(_tables(name), place=f"experiment {str(name)!r}")


def read_experiment(tables: Mapping[str, Any], *, place: str) -> Experiment:
    """An experiment from what its file holds.

    Raises:
        TrainingError: names the first problem and the place.
    """
    return validate_table(Experiment, tables, place=place, error=TrainingError)


def experiment_of(folder: Path) -> Experiment:
    """The experiment whose results a folder holds.

    Raises:
        CheckpointError: there is none, or its file is damaged.
        TrainingError: the file is of something else.
    """
    file, again = folder / "experiment.json", "run `tcmrl experiment` again to rewrite the file"
    try:
        tables = parse_json(file.read_bytes())
    except FileNotFoundError:
        raise CheckpointError(f"{folder} holds no results of `tcmrl experiment`") from None
    except ValueError as error:
        raise CheckpointError(f"{file}: {error}; {again}") from None
    if not isinstance(tables, dict):
        raise TrainingError(f"{file} is not an experiment; {again}")
    return read_experiment(tables, place=str(file))


def experiment_names() -> list[str]:
    """Experiments that come with the package."""
    names = [file.name for file in _shipped().iterdir()]
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def folder_name(text: str) -> str:
    """A label as part of a file name: `TCMRL w/o TCE` becomes `tcmrl-w-o-tce`, `A++` `a-plus-plus`."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower().replace("+", "-plus")).strip("-")


def run_id(environment: str, method: str, seed: int, fold: int | None = None) -> str:
    """Names a run's files in a results folder."""
    part = "" if fold is None else f"--fold{fold}"
    return f"{folder_name(environment)}--{folder_name(method)}--seed{seed}{part}"


def override_texts(table: Mapping[str, Any]) -> Iterator[str]:
    """Nested tables as the `section.key=value` texts that `resolve` takes; JSON values are TOML values."""
    return (f"{'.'.join(path)}={json.dumps(value)}" for path, value in leaves(table) if value != {})


def _without_steps(training: Mapping[str, Any]) -> dict[str, Any]:
    changes = dict(training)
    if isinstance(run := changes.get("run"), Mapping):
        changes["run"] = {key: value for key, value in run.items() if key != "steps"}
    return changes


def _tables(name: str | Path) -> dict[str, Any]:
    """The tables of an experiment file, with those of the file that it is like."""
    tables = _read_file(name)
    if LIKE not in tables:
        return tables
    model = tables.pop(LIKE)
    if not isinstance(model, str):
        raise TrainingError(f"experiment {str(name)!r}, {LIKE}: name one experiment, not {model!r}")
    shared = _read_file(Path(name).parent / model if model.endswith(".toml") else model)
    if LIKE in shared:
        raise TrainingError(
            f"experiment {str(name)!r}, {LIKE}: {model} is itself like {shared[LIKE]}; name that one"
        )
    return shared | tables


def _read_file(name: str | Path) -> dict[str, Any]:
    file: Path | Traversable = Path(name)
    if Path(name).suffix != ".toml":
        if name not in experiment_names():
            raise unknown_name("experiment", str(name), experiment_names())
        file = _shipped() / f"{name}.toml"
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, IsADirectoryError):
        raise TrainingError(
            f"no experiment file {name}; name a TOML file, or one that `tcmrl experiment --list` shows"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise TrainingError(f"{name} is no TOML file: {error}") from None


def _shipped() -> Traversable:
    return importlib.resources.files("tcmrl_manifests") / "experiments"
