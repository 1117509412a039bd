"""Writes a report: Markdown, with every table as CSV and every figure as PNG beside it."""

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
Returns are undiscounted sums of rewards after adaptation to the test tasks, means over them. An interval is \
the 95% bootstrap interval of the mean across seeds; fewer than five seeds are printed themselves. All seeds \
share a dataset, its split and its test tasks: intervals tell of training alone, and of five seeds they hold \
the true mean in some 84% of cases. \
`other context` is the same policy under other tasks' contexts; regret is what is missing to the oracle; a \
normalized score of 0 is uniform actions, 1 the oracle or, without one, the best behavior policy."""
CLAIMS = """\
Differences seed by seed, turned so that positive speaks for the claim: supported where the 95% interval of \
their mean, by Student's t, lies above 0, contradicted where below. Under five seeds there is no interval \
and no verdict. Each claim is judged alone, without a correction for their number."""
BESIDE = """\
The paper's data, split of tasks and training differ from these, and its score is of its own protocol: the \
columns share a unit, no more."""
COSTS = """\
Training alone; evaluation is all points of the learning curve and all protocols. Memory is the process's, \
or on CUDA that of tensors on the device. Runs that shared a machine were slower for it. The paper's, where \
they stand beside ours, are of 40,000 steps on one RTX 2080 Ti."""
CONTEXTS = """\
Each point is the context of one stored trajectory, by t-SNE, of each method's first seed; triangles are \
test tasks. The table holds the mean distance between contexts of one task over that between contexts of \
two, in the latent space itself."""
ATTENTION = """\
Trajectories with both kinds of transitions only. The paper's weights are not relative: compare the ratio of \
the rows."""


@dataclass(frozen=True)
class WrittenReport:
    """What was written.

    Attributes:
        report: the Markdown file.
        files: everything, `report` included.
        verdicts: on the experiments' claims.
    """

    report: Path
    files: tuple[Path, ...]
    verdicts: tuple[Verdict, ...]


@final
@dataclass
class Page:
    """The text as it grows, and the files beside it."""

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
        """Adds the CSV file of a table that is too long to read."""
        self.files.append(self.out / f"{table.name}.csv")
        replace_file(self.files[-1], table.csv().encode())

    def figure(self, name: str, caption: str) -> Path:
        """Adds a figure; the file is the caller's to draw."""
        self.files.append(self.out / f"{name}.png")
        self.text(f"![{caption}]({name}.png)")
        return self.files[-1]


def ignore(stage: str, done: int, total: int) -> None:
    """Reports nothing."""


def write_report(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    datasets: Sequence[str | Path] = (),
    report: ReportProgress = ignore,
) -> WrittenReport:
    """Writes a report on results folders of experiments, and on run folders.

    Args:
        paths: the folders; all run folders together make one section.
        out: folder of the report, made here; files of an earlier report are replaced.
        datasets: folders of datasets that have moved since the runs were trained on them.
        report: called with a stage, and how much of it is done and to do.

    Raises:
        CheckpointError: a folder is of neither kind or holds nothing finished, or a dataset is of no run.

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
        if any(each.experiment.name == name for each in sources[:number]):
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
        page.text(f"Not among its results: {len(source.missing)} of its runs, {', '.join(source.missing)}.")
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
        except TcmrlError:  # said where the section on attention is left out
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
    results = [each.result for each in runs]
    page.text(f"### {environment}")
    page.table(sections.setup_table(f"{name}-setup", results))
    page.table(sections.final_table(f"{name}-returns", results))
    figures.draw_finals(page.figure(f"{name}-returns", "final returns"), environment, results)
    if any(len(each.curve) > 1 for each in results):
        page.text("#### Learning curves")
        protocol = next(iter(results[0].evaluations))
        figures.draw_curves(page.figure(f"{name}-curves", "learning curves"), environment, results, protocol)
        page.data(sections.curve_table(f"{name}-curves", results))
    published = sections.published_table(f"{name}-paper", environment, results)
    if published is not None:
        page.text("#### Beside the paper")
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
        page.text(f"Contexts, attention and the dataset's returns are left out: {error}.")
    page.data(sections.digest_table(f"{name}-digests", results))
    page.text(f"Digests of the runs' tensors are in [{name}-digests.csv]({name}-digests.csv).")


def _write_contexts(
    page: Page, name: str, environment: str, runs: Sequence[FinishedRun], trained: Trained
) -> None:
    stored = trained.stored(runs[0])
    found: dict[str, list[TrainedContexts]] = {}
    for run in runs:
        found.setdefault(run.result.method, []).append(trained.contexts(run))
    page.text("#### Contexts")
    page.text(f"Of {len(stored.tasks)} tasks. {CONTEXTS}")
    first = {method: each[0].contexts for method, each in found.items()}
    points = {method: embed(each) for method, each in first.items() if each is not None}
    if points:
        labels = {method: each[0].labels for method, each in found.items()}
        is_test = [task.split == "test" for task in stored.tasks]
        figures.draw_embeddings(page.figure(f"{name}-tsne", "t-SNE of contexts"), points, labels, is_test)
    ratios = [(method, [each.distance_ratio() for each in all_]) for method, all_ in found.items()]
    page.table(sections.context_table(f"{name}-contexts", ratios))
    _write_attention(page, name, environment, {method: _weights(each) for method, each in found.items()})
    if runs[0].result.root not in page.datasets:
        page.datasets.add(runs[0].result.root)
        page.text("#### Returns of the dataset")
        page.table(sections.dataset_table(f"{name}-dataset", stored.dataset))


def _weights(contexts: Sequence[TrainedContexts]) -> list[TransitionWeights]:
    return [each.weights for each in contexts if each.weights is not None]


def _write_attention(
    page: Page, name: str, environment: str, weights: dict[str, list[TransitionWeights]]
) -> None:
    with_attention = {method: each for method, each in weights.items() if each}
    if not with_attention:
        return
    page.text("#### Attention")
    page.text("A transition's weight in the context of its trajectory, times the steps: even attention is 1.")
    first = {method: each[0] for method, each in with_attention.items()}
    figures.draw_attention(page.figure(f"{name}-attention", "attention along trajectories"), first)
    table = sections.attention_table(f"{name}-attention", environment, list(with_attention.items()))
    if table is None:
        page.text("No stored trajectory holds transitions both with and without reward.")
    else:
        page.text(ATTENTION)
        page.table(table)
