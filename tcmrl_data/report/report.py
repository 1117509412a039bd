"""The report on a dataset: one HTML file, to be read in a browser or printed."""

from pathlib import Path

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.disk import make_folders, replace_file
from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.page.markup import element
from tcmrl_data.page.page import MISSING_PLOTLY, Page
from tcmrl_data.report import figures, quality_figures, tables
from tcmrl_data.report.content import Content, Progress, measure
from tcmrl_data.report.verdicts import judge

INSPECT_RETURNS = element("code", "tcmrl-data inspect returns")

EPISODES = 20
"""Whole episodes of a report."""


def ignore(stage: str, done: int, total: int) -> None:
    """Ignores progress."""


def report_dataset(
    dataset: Dataset,
    out: str | Path,
    *,
    episodes: int = EPISODES,
    transfer: bool = False,
    strips: int = 0,
    is_interactive: bool = True,
    progress: Progress = ignore,
) -> Path:
    """Writes the report on a dataset and returns its file.

    The dataset is read part by part; memory does not grow with the number of parts.

    Args:
        dataset: the dataset; of an incomplete one, what is there.
        out: the HTML file, which is replaced if it exists.
        episodes: number of whole episodes to browse.
        transfer: let every last policy play in every task, and say what a context is worth; takes longer.
        strips: number of episodes to draw, by simulating them again; as many as can be drawn.
        is_interactive: draw figures with plotly.js if it is installed; pictures by matplotlib otherwise.
        progress: called with the stage, the amount done and the total.

    Raises:
        SelectionError: the dataset has no parts, or too few tasks for `transfer`.
        SnapshotError: a policy for `transfer` is missing.
        StoreError: a part is missing or damaged.

    Example:
        >>> report_dataset(open_dataset("data/point-robot"), "report.html")  # doctest: +SKIP
    """
    content = measure(dataset, browsed=episodes, transfer=transfer, strips=strips, progress=progress)
    page = compose(content, is_interactive=is_interactive)
    out = Path(out)
    make_folders(out.parent)
    replace_file(out, page.html().encode())
    return out


def compose(content: Content, *, is_interactive: bool = True) -> Page:
    """The page of a report."""
    manifest = content.dataset.manifest
    page = Page(
        f"{printable(manifest.label or manifest.name)}: what is in the dataset", is_interactive=is_interactive
    )
    page.add(
        element("p", f"{content.summary['description']} Root {content.summary['root'][:12]}.", kind="quiet")
    )
    page.add(element("ul", *(verdict.markup() for verdict in judge(content)), kind="verdicts"))
    if not page.is_interactive:
        page.add(element("p", MISSING_PLOTLY, kind="quiet"))
    _add_returns(page, content)
    _add_states(page, content)
    _add_quality(page, content)
    _add_transfer(page, content)
    _add_steps(page, content)
    _add_provenance(page, content)
    return page


def _add_returns(page: Page, content: Content) -> None:
    page.section("learning", "Learning curves")
    page.figure(figures.learning_curves(content))
    page.section("returns-by-snapshot", "Returns by snapshot")
    page.add(
        element("p", "Over the mean returns of the tasks of a split, as ", INSPECT_RETURNS, " prints them.")
    )
    page.add(tables.returns_table(content))
    page.figure(figures.returns_by_snapshot(content))


def _add_quality(page: Page, content: Content) -> None:
    page.section("tiers", "Scores and tiers")
    if any(task.snapshots and task.snapshots[0].tq is not None for task in content.quality.tasks):
        page.figure(quality_figures.scores(content))
    page.add(tables.tiers_table(content))
    page.section("reward-values", "Rewards")
    page.figure(quality_figures.silence(content))
    page.figure(quality_figures.rewards(content))
    page.section("state-coverage", "Coverage and overlap")
    page.figure(quality_figures.coverage(content))
    if len(content.coverage.overlap.tasks) > 1:
        page.figure(quality_figures.overlap(content))


def _add_transfer(page: Page, content: Content) -> None:
    if content.transfer is not None:
        page.section("cross-task-returns", "Policies in other tasks")
        page.figure(quality_figures.transfer(content.transfer))


def _add_states(page: Page, content: Content) -> None:
    left = content.summary["tasks"] - len(content.shown)
    page.section("states", "State visits")
    if left:
        page.add(
            element("p", f"{len(content.shown):,} evenly chosen tasks are shown, {left:,} others are not.")
        )
    page.figure(figures.state_visits(content))
    page.section("paths", "Trajectories")
    page.figure(figures.trajectories(content))


def _add_steps(page: Page, content: Content) -> None:
    page.section("action-values", "Actions and endings")
    page.figure(figures.action_histograms(content))
    page.add(tables.endings_table(content))
    page.section("browser", "Episodes")
    page.figure(figures.episode_browser(content))
    if content.strips is not None:
        for strip in content.strips.drawn:
            page.picture(strip.content, strip.caption)
        if content.strips.reason is not None:
            page.add(element("p", f"No more pictures of episodes: {content.strips.reason}.", kind="quiet"))


def _add_provenance(page: Page, content: Content) -> None:
    page.section("tasks", "Tasks")
    shift = tables.shift_table(content)
    if shift is not None:
        page.add(element("p", "Means over training and test tasks, and their difference."), shift)
    page.add(tables.tasks_table(content))
    page.section("provenance", "Provenance", tables.provenance_table(content), tables.runs_table(content))
    page.add(tables.recipe_text(content))
