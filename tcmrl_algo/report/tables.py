"""Tables of a report, as Markdown and as CSV, one function each; `write.py` orders them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tcmrl_algo.experiment.results import RunResult, table_text
from tcmrl_algo.report.sources import DatasetReturns
from tcmrl_algo.report.statistics import Verdict, by_method, coverage, known_scores, summarize

Cell = str | float | int | None
PARTS = ("final", "shuffled", "regret", "normalized", "fixed")


@dataclass(frozen=True)
class Table:
    """A named table; None is a missing value."""

    name: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def markdown(self) -> str:
        """The table as Markdown, with four significant digits; columns of text are aligned left."""
        cells = zip(*self.rows, strict=True) if self.rows else [()] * len(self.columns)
        sides = [":---" if any(isinstance(cell, str) for cell in column) else "---:" for column in cells]
        lines = [self.columns, tuple(sides), *self.rows]
        return "\n".join(f"| {' | '.join(_text(cell) for cell in line)} |" for line in lines)

    def csv(self) -> str:
        """The table as CSV, with all digits."""
        return table_text([dict(zip(self.columns, row, strict=True)) for row in self.rows], self.columns)


def across_seeds(values: Sequence[float | None]) -> tuple[Cell, Cell, Cell]:
    """Mean, interquartile mean, and interval as text, or the values of all seeds if they are too few."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return None, None, None
    summary = summarize(known)
    return summary.mean, summary.iqm, interval_text(summary.values, summary.low, summary.high)


def interval_text(values: Sequence[float], low: float | None, high: float | None) -> str:
    """The 95% interval as text, or the values of all seeds if there is none."""
    if low is None or high is None:
        return "seeds: " + ", ".join(f"{value:.4g}" for value in values)
    return f"{low:.4g} to {high:.4g}"


def _text(cell: Cell) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, float):
        return f"{cell:,.0f}" if abs(cell) >= 10_000 else f"{cell:.4g}"
    return str(cell).replace("|", "\\|")


def final_table(name: str, results: Sequence[RunResult], *, stored: float | None = None) -> Table:
    """Returns, regrets and normalized scores by protocol and method, beside two controls.

    They are the method's own return with the contexts of other tasks, and that of the best fixed policy.
    Success rate and return over the dataset's have columns where they are known.

    Args:
        stored: mean return of the stored episodes of the test tasks.
    """
    rows: list[tuple[Cell, ...]] = []
    scores = known_scores(results, stored)
    for protocol in results[0].evaluations:
        for method, runs in by_method(results).items():
            found = [run.evaluations[protocol] for run in runs]
            values = {part: [evaluation.get(f"mean_{part}") for evaluation in found] for part in PARTS}
            others = [across_seeds(values[part])[0] for part in PARTS[1:]]
            others += [
                across_seeds([score(evaluation) for evaluation in found])[0] for score in scores.values()
            ]
            row = (protocol, method, len(runs), *across_seeds(values["final"]), *others)
            rows.append((*row, coverage(runs)))
    columns = ("protocol", "method", "runs", "return", "IQM", "95% interval", "other context")
    more = ("regret", "normalized", "best fixed", *scores, "interval covers")
    return Table(name, (*columns, *more), tuple(rows))


def curve_table(name: str, results: Sequence[RunResult]) -> Table:
    """Points of the learning curves, one row per run and step."""
    rows = tuple(
        (run.label, run.seed, run.fold, point.step, point.final, point.regret, point.shuffled)
        for run in results
        for point in run.curve
    )
    return Table(name, ("method", "seed", "fold", "step", "return", "regret", "other context"), rows)


def adaptation_table(name: str, results: Sequence[RunResult]) -> Table | None:
    """Returns of the adaptation episodes in turn, a row per run, protocol and episode; None without any."""
    rows = tuple(
        (protocol, run.label, run.seed, run.fold, episode, value)
        for run in results
        for protocol, evaluation in run.evaluations.items()
        for episode, value in enumerate(evaluation.get("adaptation_curve", []), start=1)
    )
    return Table(name, ("protocol", "method", "seed", "fold", "episode", "return"), rows) if rows else None


def claims_table(name: str, judged: Mapping[str, Sequence[Verdict]]) -> Table:
    """All verdicts: mean difference, its interval or the runs' differences, p value, and what they cover."""
    rows: list[tuple[Cell, ...]] = []
    for experiment, found in ((experiment, found) for experiment, all_ in judged.items() for found in all_):
        interval = interval_text(found.differences, found.low, found.high) if found.pairs else None
        what = (experiment, found.claim, found.environment, found.comparison, found.protocol)
        test = "registered" if found.is_registered else "exploratory"
        unequal = "; ".join(found.unequal) or None
        rows.append((*what, found.mean, interval, found.adjusted, test, found.verdict, unequal, found.covers))
    columns = (
        "experiment",
        "claim",
        "environment",
        "compared",
        "protocol",
        "mean difference",
        "95% interval",
    )
    more = ("p", "test", "verdict", "unequal settings", "interval covers")
    return Table(name, (*columns, *more), tuple(rows))


def registered_table(name: str, judged: Mapping[str, Sequence[Verdict]]) -> Table:
    """The verdict on every registered claim, with its effect size and interval."""
    rows: list[tuple[Cell, ...]] = [
        (
            found.verdict,
            found.claim,
            found.environment,
            found.effect,
            found.mean,
            interval_text(found.differences, found.low, found.high) if found.pairs else None,
            len(found.pairs),
        )
        for verdicts in judged.values()
        for found in verdicts
        if found.is_registered
    ]
    columns = ("verdict", "claim", "environment", "effect size", "mean difference", "95% interval", "pairs")
    return Table(name, columns, tuple(rows))


def cost_table(name: str, results: Sequence[RunResult]) -> Table | None:
    """Time and memory per method; None if no run was timed."""
    if all(result.training_seconds is None for result in results):
        return None
    rows: list[tuple[Cell, ...]] = []
    for method, runs in by_method(results).items():
        training, _, interval = across_seeds([run.training_seconds for run in runs])
        evaluation = across_seeds([run.evaluation_seconds for run in runs])[0]
        memory = across_seeds([None if run.peak_memory is None else run.peak_memory / 1e6 for run in runs])[0]
        pace = training / runs[0].steps * 1e3 if isinstance(training, float) else None
        rows.append((method, training, interval, pace, evaluation, memory))
    columns = ("method", "training s", "95% interval", "ms per step", "evaluation s", "peak MB")
    return Table(name, columns, tuple(rows))


def context_table(name: str, results: Sequence[RunResult]) -> Table:
    """How well contexts of single trajectories tell the tasks apart, by method.

    By the mean distance of contexts of one task over that of contexts of two tasks, and by the share of
    contexts that are nearest to the mean context of their own task.
    """
    rows: list[tuple[Cell, ...]] = []
    for method, runs in by_method(results).items():
        measured = [run.contexts for run in runs if run.contexts is not None]
        ratios = across_seeds([contexts.context_ratio for contexts in measured])[::2]
        accuracies = across_seeds([contexts.centroid_accuracy for contexts in measured])[::2]
        rows.append((method, len(measured), *ratios, *accuracies))
    columns = ("within / between tasks", "95% interval", "nearest to own centroid", "95% interval")
    return Table(name, ("method", "runs", *columns), tuple(rows))


def attention_table(name: str, results: Sequence[RunResult]) -> Table | None:
    """Relative weights of transitions with and without reward.

    None if no trajectory contains both kinds, or no method has attention.
    """
    rows: list[tuple[Cell, ...]] = []
    for kind in ("nonzero", "zero"):
        for method, runs in by_method(results).items():
            measured = [run.contexts for run in runs if run.contexts is not None]
            mean, _, interval = across_seeds([getattr(found, f"attention_{kind}") for found in measured])
            median = across_seeds([getattr(found, f"median_{kind}") for found in measured])[0]
            if mean is not None:
                rows.append((method, f"{kind} reward", mean, interval, median))
    columns = ("method", "transitions", "mean", "95% interval", "median")
    return Table(name, columns, tuple(rows)) if rows else None


def dataset_table(name: str, returns: DatasetReturns) -> Table:
    """Mean returns of the stored episodes over tasks, by snapshot (the paper's Table 8 is unknown to us)."""
    rows = tuple(
        ("all" if found.step is None else found.step, found.train, found.test) for found in returns.snapshots
    )
    return Table(name, ("snapshot", "training tasks", "test tasks"), rows)


def setup_table(name: str, results: Sequence[RunResult]) -> Table:
    """Inputs and settings that determine the results of the runs."""
    values: dict[str, list[Any]] = {
        "dataset root": [result.root for result in results],
        "training profile": [result.profile for result in results],
        "seeds": [result.seed for result in results],
        "folds": [result.fold for result in results if result.fold is not None] or ["the dataset's split"],
        "training steps": [result.steps for result in results],
        "device": [result.device for result in results],
        "threads per run": [result.threads for result in results],
        "versions": [
            ", ".join(f"{key} {value}" for key, value in result.versions.items()) for result in results
        ],
    }
    rows = tuple((key, ", ".join(dict.fromkeys(map(str, found)))) for key, found in values.items())
    return Table(name, ("property", "value"), rows)


def tuning_table(name: str, results: Sequence[RunResult]) -> Table | None:
    """Tuned settings by algorithm, and what it took to find them; None if nothing was tuned."""
    rows: dict[str, tuple[Cell, ...]] = {}
    for result in results:
        if (tuned := result.tuned) is not None:
            seeds = ", ".join(map(str, tuned.seeds))
            effort = (tuned.environment, tuned.root[:12], tuned.trials, tuned.steps, seeds)
            rows[result.algorithm] = (result.algorithm, *effort, tuned.score, " ".join(tuned.overrides))
    columns = ("algorithm", "tuned on", "root", "trials", "steps", "seeds", "best score", "settings")
    return Table(name, columns, tuple(rows.values())) if rows else None


def digest_table(name: str, results: Sequence[RunResult]) -> Table:
    """Digests of the runs' tensors, for comparison with a repetition."""
    rows = tuple((result.label, result.seed, result.fold, result.digest) for result in results)
    return Table(name, ("method", "seed", "fold", "sha256 of all tensors"), rows)
