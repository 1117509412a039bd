"""The leaderboard: every method on every environment under every protocol, and at what cost."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

from tcmrl_algo.experiment.results import RunResult, coverage, success_rate
from tcmrl_algo.reporting.boards import Board, Entry, gather
from tcmrl_algo.reporting.compose import Page
from tcmrl_algo.reporting.fairness import unequal_settings
from tcmrl_algo.reporting.figures import draw_boards
from tcmrl_algo.reporting.scores import SCORES, known_scores, over_dataset
from tcmrl_algo.reporting.sources import Source, read_sources
from tcmrl_algo.reporting.tables import Cell, Table, across_seeds
from tcmrl_algo.reporting.write import ReportProgress, WrittenReport, ignore, page_text
from tcmrl_data import canonical_json, parse_json
from tcmrl_data.foundation.disk import make_folders, replace_file

NAME = "leaderboard"
RECORD = f"{NAME}.json"
"""Which folders a leaderboard was made of, relative to its own, so that it can be made again."""
BASELINE = "focal"
COSTS = ("ms per step", "over FOCAL", "peak MB")
BUDGET = frozenset({"run.steps", "run.episodes", "run.random_episodes", "run.repeats"})
"""Settings that have columns of their own."""
EFFORT_COLUMNS = ("steps", "profile", "episodes", "random", "repeats", *COSTS, "tuned", "experiments")
NOTE = """\
Returns are undiscounted, after adaptation, means over test tasks and runs; behind them stands the 95% \
bootstrap interval over runs, or, with fewer than five runs, the values of all. Only results on one dataset \
(equal roots) and one kind of split are ranked together. Ranks are by mean return, 1 is best, and equal \
returns share a rank; where intervals overlap, a rank says little. Mean ranks are over the boards that rank \
the same methods, and `ranked` says over how many boards and protocols: mean ranks over different ones do \
not compare. Where half of the episodes are random, `paper` and `non_prior` are one procedure for every \
method that explores by uniform actions, and count twice. `(privileged)` methods observe the task parameters \
and have no rank. FOCAL under `idaq_literal` is IDAQ."""
EFFORT = """\
Milliseconds per training step, also relative to FOCAL's on the same dataset, and the most memory of the \
process or, on CUDA, of the device; runs that shared a machine are slower. Episodes are those of adaptation, \
of which the random ones form the first stage of `paper` and `idaq_literal`. `tuned` says by how many trials \
of how many steps, and on which environment's training tasks, settings were found; `–` stands for those of \
the recipe or the experiment."""


def write_leaderboard(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    datasets: Sequence[str | Path] = (),
    report: ReportProgress = ignore,
) -> WrittenReport:
    """Writes a leaderboard of all results in folders: `leaderboard.md`, its tables as CSV, and a figure.

    Compact results that are committed and the full ones that they were made of give the same leaderboard.

    Args:
        paths: results folders, earlier reports, folders of these, or run folders.
        out: folder of the leaderboard, created if needed.
        datasets: folders of datasets that were moved after the training of the runs.
        report: called with the name of a stage, the amount done and the total amount.

    Raises:
        CheckpointError: as `write_report`.

    Example:
        >>> write_leaderboard(["docs/results"], "leaderboard").report  # doctest: +SKIP
    """
    out = Path(out)
    sources = read_sources([Path(path) for path in paths], report, datasets=[Path(path) for path in datasets])
    page = leaderboard(sources, out)
    make_folders(out)
    for file, draw in page.figures.items():
        if draw is not None:
            draw(out / file)
    for table in page.tables:
        replace_file(out / f"{table.name}.csv", table.csv().encode())
    folders = [os.path.relpath(Path(path).resolve(), out.resolve()) for path in paths]
    replace_file(out / RECORD, canonical_json({"folders": folders}) + b"\n")
    replace_file(out / f"{NAME}.md", page_text(page).encode())
    names = [f"{NAME}.md", RECORD, *(f"{table.name}.csv" for table in page.tables), *page.figures]
    return WrittenReport(out / f"{NAME}.md", tuple(out / name for name in names), ())


def listed_folders(record: Path) -> list[Path]:
    """The folders that a `leaderboard.json` names."""
    return [record.parent / folder for folder in parse_json(record.read_bytes())["folders"]]


def leaderboard(sources: Sequence[Source], out: Path) -> Page:
    """The page of a leaderboard; `out` is its folder."""
    boards, page = gather(sources), Page(out)
    page.text("# Leaderboard")
    page.text(NOTE)
    missing = [
        f"`{source.experiment.name}` lacks {len(source.unfinished)}"
        for source in sources
        if source.unfinished
    ]
    if missing:
        page.text(f"Runs are missing: {', '.join(missing)}.")
    groups = [group for group in alike(boards) if len(group) > 1]
    for number, group in enumerate(groups, start=1):
        page.text(f"Over {', '.join(board.title for board in group)}:")
        page.table(ranks_table(f"{NAME}-ranks{f'-{number}' if len(groups) > 1 else ''}", group))
    page.figure(NAME, "returns by method, protocol and dataset", _drawing(boards))
    for board in boards:
        page.text(f"## {board.title}")
        others = sum(other.environment == board.environment for other in boards) - 1
        if others:
            page.text(
                f"There are results on {others} more datasets or splits of {board.environment}, ranked apart."
            )
        page.text(returns_table(board).markdown())
        scores = _scores(board)
        if scores is not None:
            page.text(SCORES)
            page.text(scores.markdown())
        page.text(_effort(board).markdown())
        page.text(_differences(board))
    page.text(EFFORT)
    page.data(all_table(NAME, boards))
    return page


def alike(boards: Sequence[Board]) -> list[list[Board]]:
    """The boards in groups that rank the same methods, the most methods first."""
    groups: dict[frozenset[str], list[Board]] = {}
    for board in boards:
        ranked = frozenset(label for protocol in board.protocols for label in board.ranks(protocol))
        groups.setdefault(ranked, []).append(board)
    return [groups[ranked] for ranked in sorted(groups, key=len, reverse=True)]


def ranks_table(name: str, boards: Sequence[Board]) -> Table:
    """Mean rank of every method, over all boards and by protocol."""
    protocols = list(dict.fromkeys(protocol for board in boards for protocol in board.protocols))
    found: dict[str, dict[str, list[float]]] = {}
    for board in boards:
        for protocol in board.protocols:
            for label, rank in board.ranks(protocol).items():
                found.setdefault(label, {}).setdefault(protocol, []).append(rank)
    total = sum(len(board.protocols) for board in boards)
    rows: list[tuple[Cell, ...]] = []
    for label, ranks in found.items():
        every = [rank for values in ranks.values() for rank in values]
        means = [fmean(ranks[protocol]) if protocol in ranks else None for protocol in protocols]
        rows.append((label, fmean(every), f"{len(every)} of {total}", *means))
    rows.sort(key=lambda row: (row[1], row[0]))
    return Table(name, ("method", "mean rank", "ranked", *protocols), tuple(rows))


def all_table(name: str, boards: Sequence[Board]) -> Table:
    """A row per dataset, protocol and method, with everything that the page says of them."""
    rows = []
    for board in boards:
        pace = _pace(board)
        for protocol in board.protocols:
            ranks = board.ranks(protocol)
            for entry in board.entries:
                if runs := entry.under(protocol):
                    rows.append(
                        (
                            board.environment,
                            board.root,
                            protocol,
                            *_row(entry, runs, protocol, board, ranks, pace),
                        )
                    )
    columns = ("environment", "root", "protocol", "method", "rank", "runs", "return", "IQM", "95% interval")
    more = ("regret", "other context", "success", "over dataset", *EFFORT_COLUMNS, "interval covers")
    return Table(name, (*columns, *more), tuple(rows))


def _row(
    entry: Entry,
    runs: list[RunResult],
    protocol: str,
    board: Board,
    ranks: dict[str, float],
    pace: float | None,
) -> tuple[Cell, ...]:
    documents = [run.evaluations[protocol] for run in runs]
    regret, other = (
        _mean([found.get(f"mean_{part}") for found in documents]) for part in ("regret", "shuffled")
    )
    share = _mean([over_dataset(found, board.stored) for found in documents])
    success = _mean([success_rate(found) for found in documents])
    found = (entry.label, ranks.get(entry.label), len(runs), *across_seeds(entry.finals(protocol)))
    return (*found, regret, other, success, share, *_effort_of(entry, pace), coverage(runs))


def returns_table(board: Board) -> Table:
    """Returns with intervals, a column per protocol, the best mean rank first."""
    ranks = {protocol: board.ranks(protocol) for protocol in board.protocols}
    rows: list[tuple[Cell, ...]] = []
    for entry in board.entries:
        own = [found[entry.label] for found in ranks.values() if entry.label in found]
        cells = [_with_interval(entry.finals(protocol)) for protocol in board.protocols]
        rows.append((entry.label, len(entry.runs), fmean(own) if own else None, *cells))
    rows.sort(key=lambda row: (row[2] is None, row[2] or 0.0, str(row[0])))
    return Table("", ("method", "runs", "mean rank", *board.protocols), tuple(rows))


def _scores(board: Board) -> Table | None:
    """Success rates and returns over the dataset's; None where neither is known."""
    scores = known_scores([run for entry in board.entries for run in entry.runs], board.stored)
    rows = tuple(
        (
            entry.label,
            score,
            *(
                _mean([measure(run.evaluations[protocol]) for run in entry.under(protocol)])
                for protocol in board.protocols
            ),
        )
        for score, measure in scores.items()
        for entry in board.entries
    )
    return Table("", ("method", "score", *board.protocols), rows) if rows else None


def _effort(board: Board) -> Table:
    pace = _pace(board)
    rows = tuple((entry.label, *_effort_of(entry, pace)) for entry in board.entries)
    return Table("", ("method", *EFFORT_COLUMNS), rows)


def _effort_of(entry: Entry, pace: float | None) -> tuple[Cell, ...]:
    first = entry.runs[0]
    settings, tuned = first.config.settings.run, first.tuned
    own = _milliseconds(entry)
    memory = _mean([None if run.peak_memory is None else run.peak_memory / 1e6 for run in entry.runs])
    found = (
        None if tuned is None else f"{tuned.trials} × {tuned.steps} on {tuned.environment} {tuned.root[:12]}"
    )
    budget = (first.steps, first.profile, settings.episodes, settings.random_episodes, settings.repeats)
    over = own / pace if own is not None and pace is not None else None
    return (*budget, own, over, memory, found, ", ".join(entry.experiments))


def _differences(board: Board) -> str:
    """Budgets and shared settings that the methods of a board do not have in common."""
    columns = ("steps", "episodes", "random", "repeats", "tuned")
    table = _effort(board)
    places = [table.columns.index(column) for column in columns]
    unequal = [
        column
        for column, place in zip(columns, places, strict=True)
        if len({row[place] for row in table.rows}) > 1
    ]
    runs = [entry.runs[0] for entry in board.entries]
    settings = {key: None for run in runs[1:] for key in unequal_settings(runs[0], run)}
    unequal += [f"`{key}`" for key in settings if key not in BUDGET]
    if not unequal:
        return "Budgets and tuning are equal for all methods of this board."
    return f"**Not equal on this board: {', '.join(unequal)}.** Compare with care."


def _pace(board: Board) -> float | None:
    """Milliseconds per step of the first FOCAL on a board."""
    found = [entry for entry in board.entries if entry.runs[0].algorithm == BASELINE]
    return _milliseconds(found[0]) if found else None


def _milliseconds(entry: Entry) -> float | None:
    return _mean(
        [
            None if run.training_seconds is None else run.training_seconds / run.steps * 1e3
            for run in entry.runs
        ]
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known and len(known) == len(values) else None


def _with_interval(finals: Sequence[float]) -> str | None:
    if not finals:
        return None
    mean, _, interval = across_seeds(finals)
    return f"{mean:.4g} ({interval})"


def _drawing(boards: Sequence[Board]) -> Callable[[Path], None]:
    panels: dict[str, dict[str, dict[str, list[float]]]] = {
        board.title: {
            protocol: {
                entry.label: entry.finals(protocol) for entry in board.entries if entry.under(protocol)
            }
            for protocol in board.protocols
        }
        for board in boards
    }
    return lambda file: draw_boards(file, panels)
