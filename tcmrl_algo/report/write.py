"""Writes a report: Markdown, HTML, CSV and PNG. The verdicts on registered claims come first."""

import base64
import html
import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from markdown_it import MarkdownIt
from markdown_it.token import Token
from markupsafe import Markup

from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.experiment.spec import folder_name
from tcmrl_algo.report import figures, tables
from tcmrl_algo.report.contexts import embed
from tcmrl_algo.report.rows import add_rows
from tcmrl_algo.report.sources import Contexts, Source, measured, natural_order, read_sources
from tcmrl_algo.report.statistics import SCORES, Verdict, judge, known_scores
from tcmrl_algo.report.tables import Table
from tcmrl_data.foundation.disk import make_folders, replace_file
from tcmrl_data.foundation.page import allowed_text, render_page

ReportProgress = Callable[[str, int, int], None]
"""Receives the name of a stage, the amount done and the total amount."""
Draw = Callable[[Path], None]

NOTE = """\
Returns are undiscounted sums of rewards after adaptation, averaged over the test tasks, under \
`offline_train` over training tasks. Intervals are 95% intervals of the mean over runs by Student's t; \
with fewer than five runs, the values of all are printed. The column `interval covers` says over what they \
are taken. Seeds of one split share the dataset, the split and the test tasks: their interval shows the \
variance of training, and nothing of other tasks or data. With folds, every task of the dataset is a test \
task once, and the interval is over all pairs of seed and fold: it covers training on these splits, not \
tasks beyond the dataset. `other context` is the return of the same policy with the contexts of other \
tasks; the regret is the oracle's return minus the policy's; `best fixed` is the return of the best policy \
that acts the same in all tasks, fitted on the training tasks; the normalized score is 0 for uniform \
actions and 1 for the oracle or, without one, for the best behavior policy. A `(privileged)` method is a \
control that observes the task parameters."""
CLAIMS = """\
Differences are taken run by run (same seed, same fold), and positive differences support the claim, which \
is judged under every protocol that it concerns. The 95% interval of the mean difference is by Student's t, \
for this comparison alone, and `p` is the p value of the same test. A `registered` test was named before its \
runs: it alone decides its claim, uncorrected. All others are `exploratory`, and their p values are after \
Holm's correction for all of them. Below 0.05 a claim is supported or contradicted, by the sign of the mean. \
With fewer than five runs there is no interval and no verdict. `unequal settings` are those that all methods \
share and in which the two compared differ, first and second: where a search found them, a difference may \
be theirs."""
ADAPTATION = """\
Returns of the adaptation episodes of a protocol in turn, means over tasks and runs. The first episodes \
of `paper` act uniformly, those of the other protocols by stored or tried contexts; where the first stage is \
random, the protocol was run several times (`repeats` in the JSON documents), and all returns are means."""
TUNING = """\
Settings by which all methods of an algorithm were trained, where a method does not set another value; the \
score is the mean normalized return on held-out training tasks. Test tasks had no part in it."""
COSTS = """\
Training time excludes evaluation; evaluation time covers all points of the learning curve and all \
protocols. Memory is that of the process or, on CUDA, of the tensors on the device. Runs that shared a \
machine are slower."""
CONTEXTS = """\
Every point is the t-SNE of the context of one stored trajectory, for the first seed of every method; \
triangles are test tasks. The table contains the mean distance between contexts of one task over that \
between contexts of two tasks, in the latent space."""
ATTENTION = """\
Only trajectories with both kinds of transitions count."""


@dataclass(frozen=True)
class WrittenReport:
    """Files and verdicts of a report."""

    report: Path
    files: tuple[Path, ...]
    verdicts: tuple[Verdict, ...]


@final
@dataclass
class Page:
    """The text of a report, its tables, and its figures.

    Attributes:
        out: folder of the report.
        blocks: Markdown paragraphs, headings, tables and figures in their order.
        tables: by file name; one CSV file each.
        figures: file names, with what draws them.
        roots: of datasets whose returns are on the page.
    """

    out: Path
    blocks: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: dict[str, Draw] = field(default_factory=dict)
    roots: set[str] = field(default_factory=set)

    def text(self, line: str) -> None:
        """Adds a paragraph or a heading."""
        self.blocks.append(line)

    def table(self, table: Table) -> None:
        """Adds a table, and its CSV file."""
        self.blocks.append(table.markdown())
        self.tables.append(table)

    def data(self, table: Table) -> None:
        """Adds only the CSV file of a table."""
        self.tables.append(table)

    def figure(self, name: str, caption: str, draw: Draw) -> None:
        """Adds a figure."""
        self.blocks.append(f"![{caption}]({name}.png)")
        self.figures[f"{name}.png"] = draw

    def markdown(self) -> str:
        """The content of `report.md`."""
        return "\n\n".join(self.blocks) + "\n"


def write_report(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    datasets: Sequence[str | Path] = (),
    rows: str | Path | None = None,
    report: ReportProgress | None = None,
) -> WrittenReport:
    """Writes a report on results folders of experiments.

    Args:
        paths: the folders; of a folder of results folders, all in it.
        out: folder of the report, created if needed; files of an earlier report are replaced.
        datasets: folders of datasets that were moved after the training of the runs.
        rows: a table, `runs.csv`, to which the runs of results folders are added.

    Raises:
        CheckpointError: not a results folder, no finished run in it, a dataset of no run, or `rows` is no
            table.

    Example:
        >>> write_report(["results/perspectives"], "reports/perspectives").verdicts  # doctest: +SKIP
    """
    out = Path(out)
    sources = measure_paths(paths, datasets=datasets, report=report)
    if rows is not None:
        add_rows(Path(rows), [source for _, source in sources])
    page, judged = compose(sources, out)
    make_folders(out)
    for done, (file, draw) in enumerate(page.figures.items(), start=1):
        draw(out / file)
        if report is not None:
            report("drawing figures", done, len(page.figures))
    for table in page.tables:
        replace_file(out / f"{table.name}.csv", table.csv().encode())
    replace_file(out / "report.md", page.markdown().encode())
    replace_file(out / "report.html", page_html(page).encode())
    names = ["report.md", "report.html", *(f"{table.name}.csv" for table in page.tables), *page.figures]
    verdicts = tuple(itertools.chain.from_iterable(judged.values()))
    return WrittenReport(out / "report.md", tuple(out / name for name in names), verdicts)


def measure_paths(
    paths: Sequence[str | Path],
    *,
    datasets: Sequence[str | Path] = (),
    report: ReportProgress | None = None,
) -> list[tuple[str, Source]]:
    """The experiments in folders, with what their checkpoints tell, by unique names in natural order."""
    sources = read_sources([Path(path) for path in paths], datasets=[Path(folder) for folder in datasets])
    sources.sort(key=lambda source: natural_order(source.experiment.name))
    found: list[tuple[str, Source]] = []
    for number, source in enumerate(sources):
        name = source.experiment.name
        if any(earlier.experiment.name == name for earlier in sources[:number]):
            name = f"{name}-{number}"
        found.append((name, measured(source)))
        if report is not None:
            report("measuring", number + 1, len(sources))
    return found


def compose(sources: Sequence[tuple[str, Source]], out: Path) -> tuple[Page, dict[str, list[Verdict]]]:
    """The page of a report and the verdicts, by experiment.

    Args:
        sources: the experiments under the names that their files and sections get.
    """
    page = Page(out)
    page.text(f"# Report: {', '.join(name for name, _ in sources)}")
    judged = {name: judge(source.experiment, source.runs) for name, source in sources}
    if any(judged.values()):
        page.text("## Verdicts")
        registered = tables.registered_table("verdicts", judged)
        if registered.rows:
            page.table(registered)
        else:
            page.text("No claim was registered before its runs, so that all verdicts are exploratory.")
        page.text("### All comparisons")
        page.text(CLAIMS)
        page.table(tables.claims_table("claims", judged))
    page.text("## How to read the numbers")
    page.text(NOTE)
    for name, source in sources:
        page.text(f"## {source.experiment.title}")
        page.text(f"Experiment `{source.experiment.name}` (source: {source.experiment.source}).")
        if source.missing:
            page.text(
                f"Results are missing for {len(source.unfinished)} of its runs: {', '.join(source.missing)}."
            )
        for environment in source.environments():
            _add_environment(page, f"{name}-{folder_name(environment)}", environment, source)
    return page, judged


def _add_environment(page: Page, name: str, environment: str, source: Source) -> None:
    results = source.results(environment)
    page.text(f"### {environment}")
    page.table(tables.setup_table(f"{name}-setup", results))
    stored = source.stored_return(environment)
    page.table(tables.final_table(f"{name}-returns", results, stored=stored))
    if known_scores(results, stored):
        page.text(SCORES)
    page.figure(
        f"{name}-returns", "final returns", lambda file: figures.draw_finals(file, environment, results)
    )
    if any(len(result.curve) > 1 for result in results):
        _add_curves(page, name, environment, results)
    adaptation = tables.adaptation_table(f"{name}-adaptation", results)
    if adaptation is not None:
        page.text("#### Episodes until adapted")
        page.text(ADAPTATION)
        page.figure(
            f"{name}-adaptation",
            "returns of adaptation episodes",
            lambda file: figures.draw_adaptation(file, environment, results),
        )
        page.data(adaptation)
    costs = tables.cost_table(f"{name}-costs", results)
    if costs is not None:
        page.text("#### Time and memory")
        page.text(COSTS)
        page.table(costs)
    tuning = tables.tuning_table(f"{name}-tuning", results)
    if tuning is not None:
        page.text("#### Tuning")
        page.text(TUNING)
        page.table(tuning)
    if environment in source.unmeasured:
        reason = source.unmeasured[environment]
        page.text(f"Contexts, attention and the dataset's returns are omitted: {reason}.")
    else:
        _add_contexts(page, name, environment, results, source.contexts[environment])
        _add_dataset(page, name, environment, source)
    page.data(tables.digest_table(f"{name}-digests", results))
    page.text(f"[Digests of the runs' tensors]({name}-digests.csv).")


def _add_curves(page: Page, name: str, environment: str, results: Sequence[RunResult]) -> None:
    page.text("#### Learning curves")
    protocol = next(iter(results[0].evaluations))
    page.figure(
        f"{name}-curves",
        "learning curves",
        lambda file: figures.draw_curves(file, environment, results, protocol),
    )
    page.data(tables.curve_table(f"{name}-curves", results))


def _add_contexts(
    page: Page, name: str, environment: str, results: Sequence[RunResult], contexts: Contexts
) -> None:
    tasks = max(result.contexts.tasks for result in results if result.contexts is not None)
    page.text("#### Contexts")
    page.text(f"{tasks} tasks. {CONTEXTS}")
    if contexts.points:
        page.figure(f"{name}-tsne", "t-SNE of contexts", _embedding(contexts))
    page.table(tables.context_table(f"{name}-contexts", results))
    if contexts.weights:
        _add_attention(page, name, environment, results, contexts)


def _embedding(contexts: Contexts) -> Draw:
    def draw(file: Path) -> None:
        points = {method: embed(found) for method, found in contexts.points.items()}
        figures.draw_embeddings(file, points, contexts.labels, contexts.is_test)

    return draw


def _add_attention(
    page: Page, name: str, environment: str, results: Sequence[RunResult], contexts: Contexts
) -> None:
    page.text("#### Attention")
    page.text("Weight of a transition in its trajectory's context, times the steps; uniform attention is 1.")
    page.figure(
        f"{name}-attention",
        "attention along trajectories",
        lambda file: figures.draw_attention(file, contexts.weights),
    )
    table = tables.attention_table(f"{name}-attention", results)
    if table is None:
        page.text("No stored trajectory contains transitions both with and without reward.")
    else:
        page.text(ATTENTION)
        page.table(table)


def _add_dataset(page: Page, name: str, environment: str, source: Source) -> None:
    returns = source.datasets[environment]
    if returns.root not in page.roots:
        page.roots.add(returns.root)
        page.text("#### Returns of the dataset")
        page.table(tables.dataset_table(f"{name}-dataset", returns))


def page_html(page: Page) -> str:
    """The content of `report.html`: the Markdown, with the figures of the page's folder in it."""
    markdown = MarkdownIt("zero").enable(["heading", "table", "backticks", "escape", "image", "link"])
    # Links may lead to files beside the report alone.
    setattr(markdown, "validateLink", lambda url: re.fullmatch(r"[\w.-]+", url) is not None)  # noqa: B010
    tokens = markdown.parse(allowed_text(page.markdown()))
    parts: list[tuple[str, list[Token]]] = [("", [])]
    for place, token in enumerate(tokens):
        if token.type == "heading_open" and token.tag in ("h1", "h2"):
            parts.append((tokens[place + 1].content.replace("`", ""), []))
        parts[-1][1].append(token)
        if token.type == "paragraph_open" and [child.type for child in tokens[place + 1].children or ()] == [
            "image"
        ]:
            token.hidden = tokens[place + 2].hidden = True
    rules = {"image": _image(page.out), "table_open": _table_open, "table_close": _table_close}
    for name, rule in rules.items():
        markdown.add_render_rule(name, rule)
    (title, above), *sections = [
        (heading, Markup(markdown.renderer.render(found[3:], markdown.options, {})))
        for heading, found in parts[1:]
    ]
    values = {"above": above, "parts": sections}
    return render_page("report.html.jinja", Path(__file__).parent, title=title, values=values)


def _image(folder: Path) -> Callable[..., str]:
    def render(renderer: Any, tokens: Sequence[Token], place: int, *_: Any) -> str:
        token = tokens[place]
        content = base64.b64encode((folder / str(token.attrGet("src"))).read_bytes()).decode("ascii")
        caption = html.escape(token.content)
        return (
            f'<figure class="picture"><img src="data:image/png;base64,{content}" alt="{caption}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )

    return render


def _table_open(renderer: Any, tokens: Sequence[Token], *_: Any) -> str:
    return '<div class="scroll" tabindex="0"><table>'


def _table_close(renderer: Any, tokens: Sequence[Token], *_: Any) -> str:
    return "</table></div>"
