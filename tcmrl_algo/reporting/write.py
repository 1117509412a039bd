"""Writes a report as Markdown, with a CSV file per table and a PNG file per figure."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

import numpy as np

from tcmrl_algo.experiment.config import Metric, folder_name
from tcmrl_algo.reporting import figures, sections
from tcmrl_algo.reporting.claims import Verdict, judge, measure_result
from tcmrl_algo.reporting.contexts import Trained, TrainedContexts, TransitionWeights, embed
from tcmrl_algo.reporting.sources import FinishedRun, Source, read_sources
from tcmrl_algo.reporting.tables import Table
from tcmrl_data import TcmrlError
from tcmrl_data.foundation.disk import replace_file

ReportProgress = Callable[[str, int, int], None]

NOTE = """\
Returns are undiscounted sums of rewards after adaptation, averaged over the test tasks. Intervals are 95% \
bootstrap intervals of the mean across seeds; with fewer than five seeds, the values of all seeds are \
printed. All seeds share the dataset, its split and its test tasks, so intervals show only the variance of \
training; intervals of five seeds contain the true mean in about 84% of cases. `other context` is the \
return of the same policy with the contexts of other tasks; the regret is the oracle's return minus the \
policy's; the normalized score is 0 for uniform actions and 1 for the oracle or, without one, for the best \
behavior policy. A `(privileged)` method is a control that observes the task parameters."""
CLAIMS = """\
Differences are taken seed by seed, and positive differences support the claim. A claim is supported if \
the 95% interval of the mean difference (Student's t) is above 0, and contradicted if it is below 0. With \
fewer than five seeds there is no interval and no verdict. Verdicts are not corrected for the number of \
claims."""
BESIDE = """\
The paper has other data, another split of tasks, other training and its own protocol: the columns have \
the same unit, but are not comparable otherwise."""
COSTS = """\
Training time excludes evaluation; evaluation time covers all points of the learning curve and all \
protocols. Memory is that of the process or, on CUDA, of the tensors on the device. Runs that shared a \
machine are slower. The paper's numbers, if printed, are for 40,000 steps on one RTX 2080 Ti."""
CONTEXTS = """\
Every point is the t-SNE of the context of one stored trajectory, for the first seed of every method; \
triangles are test tasks. The table contains the mean distance between contexts of one task over that \
between contexts of two tasks, in the latent space."""
ATTENTION = """\
Only trajectories with both kinds of transitions count. The paper's weights are not relative: compare the \
ratios of the rows."""


@dataclass(frozen=True)
class WrittenReport:
    """Files and verdicts of a report.

    Attributes:
        report: the Markdown file.
        files: all files, including `report`.
        verdicts: verdicts on the claims of the experiments.
    """

    report: Path
    files: tuple[Path, ...]
    verdicts: tuple[Verdict, ...]


@final
@dataclass
class Page:
    """The text of the report so far, and the files of its tables and figures."""

    out: Path
    lines: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    datasets: set[str] = field(default_factory=set)

    def text(self, line: str) -> None:
        """Adds a paragraph or a heading."""
        self.lines.append(line)

    def table(self, table: Table) -> None:
        """Adds a table, and its CSV file."""
        self.text(table.markdown())
        self.data(table)

    def data(self, table: Table) -> None:
        """Adds only the CSV file of a table."""
        self.files.append(self.out / f"{table.name}.csv")
        replace_file(self.files[-1], table.csv().encode())

    def figure(self, name: str, caption: str) -> Path:
        """Adds a figure, and returns the file that the caller must draw."""
        self.files.append(self.out / f"{name}.png")
        self.text(f"![{caption}]({name}.png)")
        return self.files[-1]


def ignore(stage: str, done: int, total: int) -> None:
    """Ignores progress."""


def write_report(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    datasets: Sequence[str | Path] = (),
    report: ReportProgress = ignore,
) -> WrittenReport:
    """Writes a report on results folders of experiments and on run folders.

    Args:
        paths: the folders; all run folders are in one section.
        out: folder of the report, created if needed; files of an earlier report are replaced.
        datasets: folders of datasets that were moved after the training of the runs.
        report: called with the name of a stage, the amount done and the total amount.

    Raises:
        CheckpointError: not a results or run folder, no finished run in it, or a dataset of no run.

    Example:
        >>> write_report(["results/figure5"], "docs/results/figure5").verdicts  # doctest: +SKIP
    """
    sources = read_sources(
        [Path(path) for path in paths], report, datasets=[Path(folder) for folder in datasets]
    )
    head, page, trained = Page(Path(out)), Page(Path(out)), Trained()
    page.out.mkdir(parents=True, exist_ok=True)
    head.text("# Report")
    head.text(NOTE)
    judged: dict[str, list[Verdict]] = {}
    for number, source in enumerate(sources):
        name = source.experiment.name
        if any(earlier.experiment.name == name for earlier in sources[:number]):
            name = f"{name}-{number}"
        judged[name] = _write_source(page, source, name, trained, report, alone=len(sources) == 1)
    verdicts = tuple(itertools.chain.from_iterable(judged.values()))
    if verdicts and len(judged) > 1:
        head.text("## All claims")
        head.text(CLAIMS)
        head.table(sections.claims_table("claims", judged))
    file = page.out / "report.md"
    replace_file(file, ("\n\n".join([*head.lines, *page.lines]) + "\n").encode())
    return WrittenReport(file, (file, *head.files, *page.files), verdicts)


def _write_source(
    page: Page, source: Source, name: str, trained: Trained, report: ReportProgress, *, alone: bool
) -> list[Verdict]:
    experiment = source.experiment
    page.text(f"## {experiment.title}")
    page.text(f"Experiment `{experiment.name}` (source: {experiment.source}).")
    if source.missing:
        page.text(f"Results are missing for {len(source.missing)} of its runs, {', '.join(source.missing)}.")
    verdicts = _verdicts(source, trained)
    if verdicts:
        page.text("### Claims")
        if alone:
            page.text(CLAIMS)
        page.table(sections.verdict_table(f"{name}-claims", verdicts))
    environments = source.environments()
    for done, environment in enumerate(environments, start=1):
        runs = source.of(environment)
        _write_environment(page, f"{name}-{folder_name(environment)}", environment, runs, trained)
        report(f"report on {name}", done, len(environments))
    return verdicts


def _verdicts(source: Source, trained: Trained) -> list[Verdict]:
    def measure(run: FinishedRun, metric: Metric, protocol: str) -> float | None:
        if metric not in ("attention_zero", "attention_nonzero"):
            return measure_result(run.result, metric, protocol)
        try:
            weights = trained.contexts(run).weights
        except TcmrlError:  # the section on contexts prints the error
            return None
        found = getattr(weights, metric.removeprefix("attention_"), np.empty(0))
        return float(found.mean()) if len(found) else None

    protocol = source.experiment.protocols[0]
    return [
        judge(claim, environment, source.of(environment), protocol=protocol, measure=measure)
        for claim in source.experiment.claims
        for environment in source.environments()
    ]


def _write_environment(
    page: Page, name: str, environment: str, runs: Sequence[FinishedRun], trained: Trained
) -> None:
    results = [run.result for run in runs]
    page.text(f"### {environment}")
    page.table(sections.setup_table(f"{name}-setup", results))
    page.table(sections.final_table(f"{name}-returns", results))
    figures.draw_finals(page.figure(f"{name}-returns", "final returns"), environment, results)
    if any(len(result.curve) > 1 for result in results):
        page.text("#### Learning curves")
        protocol = next(iter(results[0].evaluations))
        figures.draw_curves(page.figure(f"{name}-curves", "learning curves"), environment, results, protocol)
        page.data(sections.curve_table(f"{name}-curves", results))
    published = sections.published_table(f"{name}-paper", environment, results)
    if published is not None:
        page.text("#### Numbers of the paper")
        page.text(BESIDE)
        page.table(published)
    costs = sections.cost_table(f"{name}-costs", environment, results)
    if costs is not None:
        page.text("#### Time and memory")
        page.text(COSTS)
        page.table(costs)
    try:
        _write_contexts(page, name, environment, runs, trained)
    except TcmrlError as error:
        page.text(f"Contexts, attention and the dataset's returns are omitted: {error}.")
    page.data(sections.digest_table(f"{name}-digests", results))
    page.text(f"[Digests of the runs' tensors]({name}-digests.csv).")


def _write_contexts(
    page: Page, name: str, environment: str, runs: Sequence[FinishedRun], trained: Trained
) -> None:
    stored = trained.stored(runs[0])
    found: dict[str, list[TrainedContexts]] = {}
    for run in runs:
        found.setdefault(run.result.label, []).append(trained.contexts(run))
    page.text("#### Contexts")
    page.text(f"{len(stored.tasks)} tasks. {CONTEXTS}")
    first = {method: trained_runs[0].contexts for method, trained_runs in found.items()}
    points = {method: embed(contexts) for method, contexts in first.items() if contexts is not None}
    if points:
        labels = {method: trained_runs[0].labels for method, trained_runs in found.items()}
        is_test = [task.split == "test" for task in stored.tasks]
        figures.draw_embeddings(page.figure(f"{name}-tsne", "t-SNE of contexts"), points, labels, is_test)
    ratios = [
        (method, [contexts.distance_ratio() for contexts in trained_runs])
        for method, trained_runs in found.items()
    ]
    page.table(sections.context_table(f"{name}-contexts", ratios))
    weights = {method: _weights(trained_runs) for method, trained_runs in found.items()}
    _write_attention(page, name, environment, weights)
    if runs[0].result.root not in page.datasets:
        page.datasets.add(runs[0].result.root)
        page.text("#### Returns of the dataset")
        page.table(sections.dataset_table(f"{name}-dataset", stored.dataset))


def _weights(contexts: Sequence[TrainedContexts]) -> list[TransitionWeights]:
    return [trained_run.weights for trained_run in contexts if trained_run.weights is not None]


def _write_attention(
    page: Page, name: str, environment: str, weights: dict[str, list[TransitionWeights]]
) -> None:
    with_attention = {method: run_weights for method, run_weights in weights.items() if run_weights}
    if not with_attention:
        return
    page.text("#### Attention")
    page.text("Weight of a transition in its trajectory's context, times the steps; uniform attention is 1.")
    first = {method: run_weights[0] for method, run_weights in with_attention.items()}
    figures.draw_attention(page.figure(f"{name}-attention", "attention along trajectories"), first)
    table = sections.attention_table(f"{name}-attention", environment, list(with_attention.items()))
    if table is None:
        page.text("No stored trajectory contains transitions both with and without reward.")
    else:
        page.text(ATTENTION)
        page.table(table)
