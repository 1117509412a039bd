"""What the data predict of contexts, beside what learning gave: a table of committed documents."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import fmean

from tcmrl_algo.experiment.results import RunResult, by_method
from tcmrl_algo.reporting.sources import Source
from tcmrl_algo.reporting.tables import Cell, Table
from tcmrl_data import Worth

COLUMNS = (
    "dataset",
    "tasks, train and test",
    "worth, training tasks",
    "worth, test tasks",
    "rewarded steps, first and last stage",
    "visible in rewards",
    "visible in dynamics",
    "results",
    "protocol",
    "without context",
    "best with context",
    "learning gained",
)
BLIND = "no_context"
"""The method that adapts to nothing."""

TO_COME = ("to come", None, None, None, None)


def worth_table(worths: Mapping[str, Worth], sources: Iterable[tuple[str, Source]]) -> Table:
    """A row per dataset, and per experiment with results on it that has a learner without contexts.

    `learning gained` is the difference of the returns on unseen tasks, of the best method with a context and
    of the one without, as a share of the range from uniform actions to the reference (the oracle, else the
    best behavior policy) on the same tasks. Methods that see task parameters do not count.

    Args:
        worths: documents of `inspect worth --json`, by name of the dataset.
        sources: experiments with their results, by name of the folder.
    """
    found = list(sources)
    rows: list[tuple[Cell, ...]] = []
    for name, worth in worths.items():
        runs = [
            (folder, [run.result for run in source.runs if run.result.root == worth.root])
            for folder, source in found
        ]
        gains = [gain for folder, results in runs for gain in _gains(folder, results)]
        rows += [(*_prediction(name, worth), *gain) for gain in gains or [TO_COME]]
    return Table("worth", COLUMNS, tuple(rows))


def _prediction(name: str, worth: Worth) -> tuple[Cell, ...]:
    shares: dict[str, str] = {
        row.split: _percent(row.worth)
        + ("" if row.low is None or row.high is None else f" ({_percent(row.low)} to {_percent(row.high)})")
        for row in worth.splits
    }
    stages = [stage for stage in worth.stages if stage.split == "train"]
    ends = stages[:1] + stages[-1:]
    return (
        name,
        " + ".join(str(row.tasks) for row in worth.splits),
        shares.get("train"),
        shares.get("test"),
        _first_and_last([_percent(stage.rewarded) for stage in ends]),
        _first_and_last([_two_decimals(stage.reward) for stage in ends]),
        _first_and_last([_two_decimals(stage.dynamics) for stage in ends]),
    )


def _gains(folder: str, results: Sequence[RunResult]) -> Iterator[tuple[Cell, ...]]:
    """What learning gave, by protocol; nothing without a learner that has no contexts."""
    methods = by_method(run for run in results if not run.privileged)
    blind = [runs for runs in methods.values() if runs[0].algorithm == BLIND]
    others = {label: runs for label, runs in methods.items() if runs[0].algorithm != BLIND}
    if not blind or not others:
        return
    for protocol in blind[0][0].evaluations:
        without = _mean_final(blind[0], protocol)
        finals = {label: _mean_final(runs, protocol) for label, runs in others.items()}
        label = max(finals, key=finals.__getitem__)
        spans = [span for run in blind[0] if (span := _range(run, protocol))]
        gained = (finals[label] - without) / fmean(spans) if len(spans) == len(blind[0]) else None
        best = f"{finals[label]:.4g} ({label})"
        yield f"[{folder}](results/{folder}/report.md)", protocol, without, best, _percent(gained)


def _mean_final(runs: Sequence[RunResult], protocol: str) -> float:
    return fmean(run.evaluations[protocol]["mean_final"] for run in runs)


def _range(run: RunResult, protocol: str) -> float | None:
    """Mean over the test tasks of the reference return minus that of uniform actions; None where unknown."""
    tasks = [task for task in run.evaluations[protocol]["tasks"] if task["split"] == "test"]
    ends = [(task.get(task["reference"]), task["random"]) for task in tasks]
    known = [best - uniform for best, uniform in ends if best is not None and uniform is not None]
    return fmean(known) if known and len(known) == len(ends) else None


def _first_and_last(texts: Sequence[str]) -> str | None:
    return " → ".join(texts) if texts else None


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{share:.1%}"


def _two_decimals(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
