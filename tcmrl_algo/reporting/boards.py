"""Boards: the results that may stand in one ranking, gathered from any number of experiments."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from tcmrl_algo.experiment.compact import compact
from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.reporting.returns import dataset_returns
from tcmrl_algo.reporting.sources import Source
from tcmrl_algo.settings.run import LOGGING_KEYS
from tcmrl_data import TcmrlError, canonical_json, open_dataset


@dataclass(frozen=True)
class Entry:
    """The runs of one method with one choice of settings.

    Attributes:
        label: name on the board; it names the experiment where one name has several settings.
        experiments: that contain the runs.
        runs: compact results, one per seed and fold.
    """

    label: str
    experiments: tuple[str, ...]
    runs: tuple[RunResult, ...]

    def under(self, protocol: str) -> list[RunResult]:
        """The runs that were evaluated by a protocol."""
        return [run for run in self.runs if protocol in run.evaluations]

    def finals(self, protocol: str) -> list[float]:
        """Returns under a protocol, means over test tasks, one per run."""
        return [run.evaluations[protocol]["mean_final"] for run in self.under(protocol)]


@dataclass(frozen=True)
class Board:
    """All results on one dataset and one kind of split, the only ones that are ranked together.

    Attributes:
        environment: name of the environment.
        root: of the dataset.
        folds: whether every task is a test task in one fold, instead of the dataset's own split.
        entries: the methods.
        stored: mean return of the stored episodes of the test tasks; None where no dataset and no report
            tells it.
    """

    environment: str
    root: str
    folds: bool
    entries: tuple[Entry, ...]
    stored: float | None

    @property
    def title(self) -> str:
        """Environment, beginning of the root, and kind of split."""
        return f"{self.environment}, dataset {self.root[:12]}{', in folds' if self.folds else ''}"

    @property
    def protocols(self) -> list[str]:
        """Protocols that some run was evaluated by."""
        found = (protocol for entry in self.entries for run in entry.runs for protocol in run.evaluations)
        return list(dict.fromkeys(found))

    def ranks(self, protocol: str) -> dict[str, float]:
        """Ranks by mean return from 1, by label; equal returns share the mean of their places.

        Methods that observe task parameters have no rank.
        """
        finals = {
            entry.label: fmean(entry.finals(protocol))
            for entry in self.entries
            if entry.under(protocol) and not entry.runs[0].privileged
        }
        values = list(finals.values())
        return {
            label: sum(other > value for other in values) + (values.count(value) + 1) / 2
            for label, value in finals.items()
        }


def gather(sources: Sequence[Source]) -> list[Board]:
    """The boards of some experiments: one per environment, dataset root and kind of split.

    A run that several experiments contain, with equal settings and seed, counts once, with the protocols of
    all of them. Equal settings under several names have the first one.
    """
    groups: dict[tuple[str, str, bool], dict[str, list[tuple[str, RunResult]]]] = {}
    for source in sources:
        for run in source.runs:
            result = compact(run.result)
            board = groups.setdefault((result.environment, result.root, result.fold is not None), {})
            board.setdefault(_settings(result), []).append((source.experiment.name, result))
    return [
        Board(environment, root, folds, _entries(list(group.values())), _stored(sources, environment, root))
        for (environment, root, folds), group in sorted(groups.items())
    ]


def _settings(result: RunResult) -> str:
    """Everything that distinguishes methods: algorithm, training, evaluation."""
    config = result.config.model_dump(mode="json")
    for key in (*LOGGING_KEYS, "threads", "protocol"):
        config["settings"]["run"].pop(key, None)
    return canonical_json([config, result.steps]).decode()


def _entries(groups: Sequence[Sequence[tuple[str, RunResult]]]) -> tuple[Entry, ...]:
    names = [found[0][1].label for found in groups]
    entries: list[Entry] = []
    for name, found in zip(names, groups, strict=True):
        label = name if names.count(name) == 1 else f"{name} ({found[0][0]})"
        same = sum(entry.label.partition(" #")[0] == label for entry in entries)
        experiments = tuple(dict.fromkeys(experiment for experiment, _ in found))
        runs = _merged(result for _, result in found)
        entries.append(Entry(label if not same else f"{label} #{same + 1}", experiments, runs))
    return tuple(entries)


def _merged(results: Iterable[RunResult]) -> tuple[RunResult, ...]:
    """One result per seed and fold, the first one, with the evaluations of the later ones that it lacks."""
    found: dict[tuple[int, int | None], RunResult] = {}
    for result in results:
        first = found.setdefault(result.pair, result)
        evaluations = first.evaluations | {
            protocol: evaluation
            for protocol, evaluation in result.evaluations.items()
            if protocol not in first.evaluations
        }
        found[result.pair] = first.model_copy(update={"evaluations": evaluations})
    return tuple(found[pair] for pair in sorted(found, key=str))


def _stored(sources: Sequence[Source], environment: str, root: str) -> float | None:
    for source in sources:
        kept = source.datasets.get(environment)
        if kept is not None and kept.root == root:
            return kept.test_return
    places = {
        run.result.dataset
        for source in sources
        for run in source.of(environment)
        if run.result.root == root and run.result.fold is None
    }
    for place in sorted(places):
        try:
            if (
                Path(place, "manifest.json").is_file()
                and (dataset := open_dataset(place)).manifest.root == root
            ):
                return dataset_returns(dataset).test_return
        except TcmrlError:
            continue  # a dataset that was changed since tells nothing of these runs
    return None
