"""The text, tables and figures of a report, computed from compact results alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.experiment.spec import folder_name
from tcmrl_algo.reporting import figures, sections
from tcmrl_algo.reporting.claims import Verdict, judge
from tcmrl_algo.reporting.contexts import embed
from tcmrl_algo.reporting.measuring import Contexts, Measured
from tcmrl_algo.reporting.scores import SCORES, known_scores
from tcmrl_algo.reporting.tables import Table

NOTE = """\
Returns are undiscounted sums of rewards after adaptation, averaged over the test tasks. Intervals are 95% \
intervals of the mean over runs by Student's t; with fewer than five runs, the values of all are printed. \
The column `interval covers` says over what they are taken. Seeds of one split share the dataset, the split \
and the test tasks: their interval shows the variance of training, and nothing of other tasks or data. \
With folds, every task of the dataset is a test task once, and the interval is over all pairs of seed and \
fold: it covers training on these splits, not tasks beyond the dataset. `other context` is the return of the \
same policy with the contexts of other tasks; the regret is the oracle's return minus the policy's; `best \
fixed` is the return of the best policy that acts the same in all tasks, fitted on the training tasks; the \
normalized score is 0 for uniform actions and 1 for the oracle or, without one, for the best behavior \
policy. A `(privileged)` method is a control that observes the task parameters."""
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
Returns of the adaptation episodes of a protocol in turn, means over test tasks and runs. The first episodes \
of `paper` act uniformly, those of the other protocols by stored or tried contexts; where the first stage is \
random, the protocol was run several times (`repeats` in the JSON documents), and all returns are means."""
BESIDE = """\
The paper has other data, another split of tasks, other training and its own protocol: the columns have \
the same unit, but are not comparable otherwise."""
TUNING = """\
Settings by which all methods of an algorithm were trained, where a method does not set another value; the \
score is the mean normalized return on held-out training tasks. Test tasks had no part in it."""
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


Draw = Callable[[Path], None]


@dataclass(frozen=True)
class Picture:
    """A figure's place in a report: the name of its file, and what it shows."""

    file: str
    caption: str


Block = str | Table | Picture


@final
@dataclass
class Page:
    """The text of a report, its tables, and its figures.

    Attributes:
        out: folder of the report; a figure that needs checkpoints is kept if it is there.
        blocks: paragraphs, headings, tables and figures in their order.
        tables: by file name; one CSV file each.
        figures: file names, with what draws them; None if an earlier report drew them.
    """

    out: Path
    blocks: list[Block] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: dict[str, Draw | None] = field(default_factory=dict)
    roots: set[str] = field(default_factory=set)

    def text(self, line: str) -> None:
        """Adds a paragraph or a heading."""
        self.blocks.append(line)

    def table(self, table: Table) -> None:
        """Adds a table, and its CSV file."""
        self.blocks.append(table)
        self.data(table)

    def data(self, table: Table) -> None:
        """Adds only the CSV file of a table."""
        self.tables.append(table)

    def figure(self, name: str, caption: str, draw: Draw | None) -> None:
        """Adds a figure; without `draw`, the one of an earlier report, if there is one."""
        file = f"{name}.png"
        if draw is not None or (self.out / file).is_file():
            self.blocks.append(Picture(file, caption))
            self.figures[file] = draw


def compose(measured: Sequence[tuple[str, Measured]], out: Path) -> tuple[Page, dict[str, list[Verdict]]]:
    """The page of a report and the verdicts, by experiment.

    Args:
        measured: the experiments under the names that their files and sections get.
        out: folder of the report.
    """
    page = Page(out)
    page.text(f"# Report: {', '.join(name for name, _ in measured)}")
    page.text(NOTE)
    judged = {name: judge(found.source) for name, found in measured}
    if len(judged) > 1 and any(judged.values()):
        page.text("## All claims")
        page.text(CLAIMS)
        page.table(sections.claims_table("claims", judged))
    for name, found in measured:
        _add_experiment(page, name, found, judged[name], alone=len(measured) == 1)
    return page, judged


def _add_experiment(
    page: Page, name: str, found: Measured, verdicts: Sequence[Verdict], *, alone: bool
) -> None:
    source = found.source
    page.text(f"## {source.experiment.title}")
    page.text(f"Experiment `{source.experiment.name}` (source: {source.experiment.source}).")
    if source.missing:
        page.text(
            f"Results are missing for {len(source.unfinished)} of its runs: {', '.join(source.missing)}."
        )
    if verdicts:
        page.text("### Claims")
        if alone:
            page.text(CLAIMS)
        page.table(sections.verdict_table(f"{name}-claims", verdicts))
    for environment in source.environments():
        _add_environment(page, f"{name}-{folder_name(environment)}", environment, found)


def _add_environment(page: Page, name: str, environment: str, found: Measured) -> None:
    results = found.source.results(environment)
    page.text(f"### {environment}")
    page.table(sections.setup_table(f"{name}-setup", results))
    stored = found.source.stored_return(environment)
    page.table(sections.final_table(f"{name}-returns", results, stored=stored))
    if known_scores(results, stored):
        page.text(SCORES)
    page.figure(
        f"{name}-returns", "final returns", lambda file: figures.draw_finals(file, environment, results)
    )
    if any(len(result.curve) > 1 for result in results):
        _add_curves(page, name, environment, results)
    adaptation = sections.adaptation_table(f"{name}-adaptation", results)
    if adaptation is not None:
        page.text("#### Episodes until adapted")
        page.text(ADAPTATION)
        page.figure(
            f"{name}-adaptation",
            "returns of adaptation episodes",
            lambda file: figures.draw_adaptation(file, environment, results),
        )
        page.data(adaptation)
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
    tuning = sections.tuning_table(f"{name}-tuning", results)
    if tuning is not None:
        page.text("#### Tuning")
        page.text(TUNING)
        page.table(tuning)
    if environment in found.unmeasured:
        reason = found.unmeasured[environment]
        page.text(f"Contexts, attention and the dataset's returns are omitted: {reason}.")
    else:
        _add_contexts(page, name, environment, results, found.contexts.get(environment))
        _add_dataset(page, name, environment, found)
    page.data(sections.digest_table(f"{name}-digests", results))
    page.text(f"[Digests of the runs' tensors]({name}-digests.csv).")


def _add_curves(page: Page, name: str, environment: str, results: Sequence[RunResult]) -> None:
    page.text("#### Learning curves")
    protocol = next(iter(results[0].evaluations))
    page.figure(
        f"{name}-curves",
        "learning curves",
        lambda file: figures.draw_curves(file, environment, results, protocol),
    )
    page.data(sections.curve_table(f"{name}-curves", results))


def _add_contexts(
    page: Page, name: str, environment: str, results: Sequence[RunResult], contexts: Contexts | None
) -> None:
    tasks = max(result.contexts.tasks for result in results if result.contexts is not None)
    page.text("#### Contexts")
    page.text(f"{tasks} tasks. {CONTEXTS}")
    if contexts is None or contexts.points:
        page.figure(f"{name}-tsne", "t-SNE of contexts", None if contexts is None else _embedding(contexts))
    page.table(sections.context_table(f"{name}-contexts", results))
    if contexts is not None and contexts.weights:
        weights = contexts.weights
        _add_attention(page, name, environment, results, lambda file: figures.draw_attention(file, weights))
    elif contexts is None and (page.out / f"{name}-attention.png").is_file():
        _add_attention(page, name, environment, results, None)


def _embedding(contexts: Contexts) -> Draw:
    def draw(file: Path) -> None:
        points = {method: embed(found) for method, found in contexts.points.items()}
        figures.draw_embeddings(file, points, contexts.labels, contexts.is_test)

    return draw


def _add_attention(
    page: Page, name: str, environment: str, results: Sequence[RunResult], draw: Draw | None
) -> None:
    page.text("#### Attention")
    page.text("Weight of a transition in its trajectory's context, times the steps; uniform attention is 1.")
    page.figure(f"{name}-attention", "attention along trajectories", draw)
    table = sections.attention_table(f"{name}-attention", environment, results)
    if table is None:
        page.text("No stored trajectory contains transitions both with and without reward.")
    else:
        page.text(ATTENTION)
        page.table(table)


def _add_dataset(page: Page, name: str, environment: str, found: Measured) -> None:
    returns = found.source.datasets[environment]
    if returns.root not in page.roots:
        page.roots.add(returns.root)
        page.text("#### Returns of the dataset")
        page.table(sections.dataset_table(f"{name}-dataset", returns))
