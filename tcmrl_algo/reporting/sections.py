"""Tables of a report, one per function; `write.py` orders them."""

import importlib.resources
import tomllib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tcmrl_algo.experiment.results import RunResult, by_method
from tcmrl_algo.reporting.claims import Verdict
from tcmrl_algo.reporting.contexts import TransitionWeights
from tcmrl_algo.reporting.tables import Cell, Table, across_seeds, interval_text
from tcmrl_data import Dataset, return_table

PAPER_COSTS = ("paper: training s", "paper: MB")
PAPER_ATTENTION = ("paper: mean", "paper: median")
PARTS = ("final", "shuffled", "regret", "normalized")


def final_table(name: str, results: Sequence[RunResult]) -> Table:
    """Return, return with the contexts of other tasks, regret and normalized score by protocol and method."""
    rows: list[tuple[Cell, ...]] = []
    for protocol in results[0].evaluations:
        for method, runs in by_method(results).items():
            values = {part: [run.evaluations[protocol][f"mean_{part}"] for run in runs] for part in PARTS}
            others = (across_seeds(values[part])[0] for part in PARTS[1:])
            rows.append((protocol, method, len(runs), *across_seeds(values["final"]), *others))
    columns = ("protocol", "method", "seeds", "return", "IQM", "95% interval", "other context")
    return Table(name, (*columns, "regret", "normalized"), tuple(rows))


def curve_table(name: str, results: Sequence[RunResult]) -> Table:
    """Points of the learning curves, one row per run and step."""
    rows = tuple(
        (run.label, run.seed, point.step, point.final, point.regret, point.shuffled)
        for run in results
        for point in run.curve
    )
    return Table(name, ("method", "seed", "step", "return", "regret", "other context"), rows)


def verdict_table(name: str, verdicts: Sequence[Verdict]) -> Table:
    """Claims with the mean difference, its interval or the seeds' differences, and the verdict."""
    rows: list[tuple[Cell, ...]] = []
    for found in verdicts:
        interval = interval_text(found.differences, found.low, found.high) if found.seeds else None
        numbers = (len(found.seeds), found.mean, interval)
        rows.append((found.claim, found.environment, found.comparison, *numbers, found.verdict))
    columns = ("claim", "environment", "compared", "seeds", "mean difference", "95% interval", "verdict")
    return Table(name, columns, tuple(rows))


def claims_table(name: str, judged: Mapping[str, Sequence[Verdict]]) -> Table:
    """The verdicts on several experiments in one table."""
    tables = {experiment: verdict_table(name, verdicts) for experiment, verdicts in judged.items()}
    rows = tuple((experiment, *row) for experiment, table in tables.items() for row in table.rows)
    return Table(name, ("experiment", *next(iter(tables.values())).columns), rows)


def published_table(name: str, environment: str, results: Sequence[RunResult]) -> Table | None:
    """Scores of the paper's Table 2 and our returns, matched by the name of the method.

    None if the units differ, or if the paper has none of our methods.
    """
    scores, ours = published()["returns"].get(environment, {}), by_method(results)
    if not scores.keys() & ours.keys():
        return None
    protocols = list(results[0].evaluations)
    rows: list[tuple[Cell, ...]] = []
    for method in dict.fromkeys((*scores, *ours)):
        cells: list[Cell] = []
        for protocol in protocols:
            finals = [run.evaluations[protocol]["mean_final"] for run in ours.get(method, [])]
            cells += across_seeds(finals)[::2]
        rows.append((method, _plus_minus(scores.get(method)), *cells))
    columns = [f"ours, {protocol}{part}" for protocol in protocols for part in ("", ": 95% interval")]
    return Table(name, ("method", "paper, Table 2", *columns), tuple(rows))


def cost_table(name: str, environment: str, results: Sequence[RunResult]) -> Table | None:
    """Time and memory per method, with those of the paper's Tables 6 and 7; None if no run was timed."""
    if all(result.training_seconds is None for result in results):
        return None
    costs = published()["costs"].get(environment, {})
    rows: list[tuple[Cell, ...]] = []
    for method, runs in by_method(results).items():
        training, _, interval = across_seeds([run.training_seconds for run in runs])
        evaluation = across_seeds([run.evaluation_seconds for run in runs])[0]
        memory = across_seeds([None if run.peak_memory is None else run.peak_memory / 1e6 for run in runs])[0]
        pace = training / runs[0].steps * 1e3 if isinstance(training, float) else None
        printed = costs.get(method, (None, None)) if costs else ()
        rows.append((method, training, interval, pace, evaluation, memory, *printed))
    columns = ("method", "training s", "95% interval", "ms per step", "evaluation s", "peak MB")
    return Table(name, (*columns, *(PAPER_COSTS if costs else ())), tuple(rows))


def context_table(name: str, ratios: Sequence[tuple[str, Sequence[float | None]]]) -> Table:
    """Mean distance of contexts of one task over that of contexts of two tasks, by method."""
    rows = tuple((method, len(values), *across_seeds(values)[::2]) for method, values in ratios)
    return Table(name, ("method", "seeds", "within / between tasks", "95% interval"), rows)


def attention_table(
    name: str, environment: str, weights: Sequence[tuple[str, Sequence[TransitionWeights]]]
) -> Table | None:
    """Relative weights of transitions with and without reward, with those of the paper's Table 5.

    None if no trajectory contains both kinds.
    """
    printed = published()["attention"].get(environment, {})
    rows: list[tuple[Cell, ...]] = []
    for kind in ("nonzero", "zero"):
        for method, runs in weights:
            found = [getattr(run_weights, kind) for run_weights in runs]
            if any(len(values) == 0 for values in found):
                continue
            mean, _, interval = across_seeds([float(values.mean()) for values in found])
            median = across_seeds([float(np.median(values)) for values in found])[0]
            rows.append((method, f"{kind} reward", mean, interval, median, *printed.get(kind, ())))
    columns = ("method", "transitions", "mean", "95% interval", "median")
    return Table(name, (*columns, *(PAPER_ATTENTION if printed else ())), tuple(rows)) if rows else None


def dataset_table(name: str, dataset: Dataset) -> Table:
    """Mean returns of the stored episodes over tasks, by snapshot (the paper's Table 8 is unknown to us)."""
    tasks = return_table(dataset)["tasks"]
    steps = sorted({found["step"] for task in tasks for found in task["snapshots"]})
    rows: list[tuple[Cell, ...]] = []
    for step in (*steps, None):
        cells = [_mean_return(tasks, split, step) for split in ("train", "test")]
        rows.append(("all" if step is None else step, *cells))
    return Table(name, ("snapshot", "training tasks", "test tasks"), tuple(rows))


def setup_table(name: str, results: Sequence[RunResult]) -> Table:
    """Inputs and settings that determine the results of the runs."""
    values: dict[str, list[Any]] = {
        "dataset root": [result.root for result in results],
        "training profile": [result.profile for result in results],
        "seeds": [result.seed for result in results],
        "training steps": [result.steps for result in results],
        "device": [result.device for result in results],
        "threads per run": [result.threads for result in results],
        "versions": [
            ", ".join(f"{key} {value}" for key, value in result.versions.items()) for result in results
        ],
    }
    rows = tuple((key, ", ".join(dict.fromkeys(map(str, found)))) for key, found in values.items())
    return Table(name, ("property", "value"), rows)


def digest_table(name: str, results: Sequence[RunResult]) -> Table:
    """Digests of the runs' tensors, for comparison with a repetition."""
    rows = tuple((result.label, result.seed, result.digest) for result in results)
    return Table(name, ("method", "seed", "sha256 of all tensors"), rows)


def published() -> dict[str, Any]:
    """Numbers of the paper that reports print beside ours."""
    file = importlib.resources.files("tcmrl_manifests") / "published.toml"
    return tomllib.loads(file.read_text(encoding="utf-8"))


def _mean_return(tasks: Sequence[dict[str, Any]], split: str, step: int | None) -> float | None:
    means = [
        found["mean"]
        for task in tasks
        if task["split"] == split
        for found in task["snapshots"]
        if step in (None, found["step"])
    ]
    return float(np.mean(means)) if means else None


def _plus_minus(score: Sequence[float] | None) -> str | None:
    return None if score is None else " ± ".join(f"{number:g}" for number in score)
