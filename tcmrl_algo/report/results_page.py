"""A page of results, written from tables of rows by a template: no number in it is typed by hand.

The template is `README.md.jinja` beside the table, or else the one of this package, which has a board per
experiment and environment. `Numbers` are the names that a template may use.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import jinja2

from tcmrl_algo.experiment.results import Row, read_table
from tcmrl_algo.experiment.tunings import TABLE, TrialRow
from tcmrl_algo.report.figures import draw_board, draw_method_curves
from tcmrl_algo.report.rows import CURVES, WORTH, CurveRow, Pair, RunRow, WorthRow
from tcmrl_algo.report.statistics import holm, mean_interval, sign_probability
from tcmrl_data import TrainingError
from tcmrl_data.foundation.disk import make_folders, replace_file

PAGE = "README.md"
TEMPLATE = f"{PAGE}.jinja"
DEFAULT = "results.md.jinja"
BLIND = "no_context"
"""The method that adapts to nothing."""
DIGITS = 3


@dataclass(frozen=True)
class Difference:
    """Returns of one method minus those of another, run by run on the same data.

    Attributes:
        mean: of the differences.
        low, high: 95% interval by Student's t; None of one pair.
        pairs: number of runs.
        probability: two-sided p value against 0; None with fewer than five pairs.
    """

    mean: float
    low: float | None
    high: float | None
    pairs: int
    probability: float | None

    def __str__(self) -> str:
        return _with_interval(self.mean, self.low, self.high)


@dataclass
class Numbers:
    """What a template may ask of the tables. All means are over runs of means over test tasks.

    Attributes:
        rows, curves, trials, worths: of `runs.csv`, `curves.csv`, `tuning.csv` and `worth.csv`.
        pictures: what draws the pictures that the template asked for, by file name.
    """

    rows: Sequence[RunRow]
    curves: Sequence[CurveRow] = ()
    trials: Sequence[TrialRow] = ()
    worths: Sequence[WorthRow] = ()
    pictures: dict[str, Callable[[Path], None]] = field(default_factory=dict)

    def boards(self) -> list[tuple[str, str]]:
        """Every experiment and environment of the table."""
        return list(dict.fromkeys((row.experiment, row.environment) for row in self.rows))

    def runs(self, experiment: str, environment: str, method: str, protocol: str) -> list[RunRow]:
        """Rows of a method.

        Raises:
            TrainingError: there are none.
        """
        place = (experiment, environment, method, protocol)
        if place not in self._by_place:
            raise TrainingError(f"the table of runs holds none of {', '.join(place)}")
        return self._by_place[place]

    def values(
        self, experiment: str, environment: str, method: str, protocol: str, column: str = "final"
    ) -> list[float]:
        """A column of a method's rows.

        Raises:
            TrainingError: there are no rows, no such column, or an empty cell in it.
        """
        rows = self.runs(experiment, environment, method, protocol)
        found = [value for row in rows if (value := getattr(row, column, None)) is not None]
        if len(found) < len(rows):
            raise TrainingError(f"{experiment}, {environment}, {method}, {protocol} lacks {column!r}")
        return found

    def mean(
        self, experiment: str, environment: str, method: str, protocol: str, column: str = "final"
    ) -> float:
        """Mean of a column over a method's runs."""
        return fmean(self.values(experiment, environment, method, protocol, column))

    def interval(
        self, experiment: str, environment: str, method: str, protocol: str, column: str = "final"
    ) -> str:
        """The 95% interval of this mean by Student's t, as text."""
        low, high = mean_interval(
            self.values(experiment, environment, method, protocol, column), fewest=2
        ) or (
            None,
            None,
        )
        return "one run" if low is None else f"{number(low)} to {number(high)}"

    def difference(
        self,
        experiment: str,
        environment: str,
        protocol: str,
        method: str,
        other: str,
        column: str = "final",
        *,
        other_column: str = "",
        other_experiment: str = "",
    ) -> Difference:
        """A method's returns minus another's, over runs with the same data, fold and seed.

        Raises:
            TrainingError: no two runs share them.
        """
        left = {
            row.pair: getattr(row, column) for row in self.runs(experiment, environment, method, protocol)
        }
        right = {
            row.pair: getattr(row, other_column or column)
            for row in self.runs(other_experiment or experiment, environment, other, protocol)
        }
        return _paired(left, right, f"{experiment}, {environment}, {protocol}: {method} and {other}")

    def share(
        self, experiment: str, environment: str, method: str, protocol: str, of: str = "behavior"
    ) -> str:
        """A method's return divided by another column, run by run: the mean and its 95% interval, as text."""
        place = (experiment, environment, method, protocol)
        shares = [a / b for a, b in zip(self.values(*place), self.values(*place, of), strict=True)]
        low, high = mean_interval(shares, fewest=2) or (None, None)
        return _with_interval(fmean(shares), low, high)

    def curve_difference(self, experiment: str, environment: str, method: str, other: str) -> Difference:
        """As `difference`, of the means over the points of learning curves: how soon methods learn.

        Raises:
            TrainingError: no two curves share data, fold and seed.
        """
        finals: dict[str, dict[Pair, list[float]]] = {method: {}, other: {}}
        for row in self.curves:
            if (row.experiment, row.environment) == (experiment, environment) and row.method in finals:
                finals[row.method].setdefault(row.pair, []).append(row.final)
        left, right = (
            {pair: fmean(found) for pair, found in finals[name].items()} for name in (method, other)
        )
        return _paired(left, right, f"{experiment}, {environment}, curves: {method} and {other}")

    def score(self, tuning: str, trial: int | None = None) -> float:
        """Score of a trial on held-out training tasks; of the best one where none is named.

        Raises:
            TrainingError: there is none.
        """
        for row in self.trials:
            chosen = row.best if trial is None else row.trial == trial
            if row.tuning == tuning and chosen and row.score is not None:
                return row.score
        raise TrainingError(f"the table of tunings holds no score of {tuning}, trial {trial}")

    def worth(self, dataset: str, split: str = "train") -> WorthRow:
        """What `inspect worth` says of a dataset.

        Raises:
            TrainingError: nothing.
        """
        for row in self.worths:
            if (row.dataset, row.split) == (dataset, split):
                return row
        raise TrainingError(f"the table of worth holds nothing of {dataset}, {split}")

    def gained(self, experiment: str, environment: str, protocol: str) -> tuple[str, float]:
        """The best method with a context, and what it gains over the blind one, as a share of the range.

        The range is from uniform actions to the oracle or, without one, to the best behavior policy. Methods
        that observe task parameters do not count.

        Raises:
            TrainingError: no blind method, none with a context, or a range that is not known.
        """
        finals = {
            method: self.mean(experiment, environment, method, protocol)
            for method, runs in self.methods(experiment, environment).items()
            if not runs[0].privileged and any(row.protocol == protocol for row in runs)
        }
        blind = self.methods(experiment, environment, algorithm=BLIND)
        label, rows = next(iter(blind.items()), ("", []))
        without = finals.pop(label, None)
        best = None if not rows else rows[0].behavior if rows[0].oracle is None else rows[0].oracle
        if without is None or not finals or best is None or rows[0].random is None:
            raise TrainingError(
                f"{experiment}, {environment}, {protocol}: the gain by a context is not known"
            )
        method = max(finals, key=finals.__getitem__)
        return method, (finals[method] - without) / (best - rows[0].random)

    def methods(self, experiment: str, environment: str, *, algorithm: str = "") -> dict[str, list[RunRow]]:
        """The rows of an experiment by method; privileged ones last."""
        found: dict[str, list[RunRow]] = {}
        for row in self.rows:
            if (row.experiment, row.environment) == (experiment, environment) and (
                not algorithm or row.algorithm == algorithm
            ):
                found.setdefault(row.method, []).append(row)
        return dict(sorted(found.items(), key=lambda entry: entry[1][0].privileged))

    def board(
        self, experiment: str, environment: str, protocols: Sequence[str] = (), *, compared: str = ""
    ) -> str:
        """All methods of an experiment in an environment, with the returns that one compares them with.

        Methods whose policies had fewer steps than others' say so.

        Args:
            protocols: columns; all where empty. Methods are sorted by the first.
            compared: a method whose returns minus each other method's have a column, by the first protocol.

        Raises:
            TrainingError: no rows, or methods with different data: a comparison never crosses datasets.
        """
        methods = self.methods(experiment, environment)
        if not methods:
            raise TrainingError(f"the table of runs holds nothing of {experiment}, {environment}")
        if len({frozenset(row.root for row in rows) for rows in methods.values()}) > 1:
            raise TrainingError(f"{experiment}, {environment}: methods were trained on different datasets")
        everything = [row for rows in methods.values() for row in rows]
        protocols = list(protocols) or list(dict.fromkeys(row.protocol for row in everything))
        first = protocols[0]
        with_success = any(row.success is not None for row in everything)
        head = ["method", "runs", *(f"`{name}`" for name in protocols), f"another's context, `{first}`"]
        head += [f"success, `{first}`"] * with_success
        head += [f"{compared} minus it, `{first}`", "p"] * bool(compared) + ["ms a step"]
        lines = [
            [f"*{label}*", "", number(fmean(known)), *[""] * (len(head) - 3)]
            for label, known in _references([row for row in everything if row.protocol == first]).items()
        ]
        ranked = sorted(methods, key=lambda name: -self.mean(experiment, environment, name, first))
        against = self._against(experiment, environment, first, compared, ranked)
        for name in ranked:
            place = (experiment, environment, name)
            rows = self.runs(*place, first)
            label = f"{name} (privileged)" if rows[0].privileged else name
            if rows[0].policy_steps < max(row.policy_steps for row in everything):
                label += f" ({rows[0].policy_steps:,} steps for the policy)"
            cells = [label, str(len(rows))]
            cells += [
                f"{number(self.mean(*place, each))} ({self.interval(*place, each)})" for each in protocols
            ]
            cells.append("" if rows[0].algorithm == BLIND else number(self.mean(*place, first, "shuffled")))
            if with_success:
                cells.append(number(self.mean(*place, first, "success")))
            if compared:
                cells += against.get(name, ["", ""])
            speeds = [row.ms_per_step for row in rows if row.ms_per_step is not None]
            lines.append([*cells, number(fmean(speeds)) if speeds else ""])
        return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines))

    @cached_property
    def _by_place(self) -> dict[tuple[str, str, str, str], list[RunRow]]:
        found: dict[tuple[str, str, str, str], list[RunRow]] = {}
        for row in self.rows:
            place = (row.experiment, row.environment, row.method, row.protocol)
            found.setdefault(place, []).append(row)
        return found

    def _against(
        self, experiment: str, environment: str, protocol: str, compared: str, methods: Sequence[str]
    ) -> dict[str, list[str]]:
        """Cells of a method's returns minus the others', and p values after Holm's correction for them."""
        others = [name for name in methods if compared and name != compared]
        found = [self.difference(experiment, environment, protocol, compared, name) for name in others]
        known = [one.probability for one in found if one.probability is not None]
        adjusted = iter(holm(known))
        return {
            name: [str(one), "–" if one.probability is None else _p_text(next(adjusted))]
            for name, one in zip(others, found, strict=True)
        }

    def board_picture(self, file: str, experiment: str, environment: str, protocols: Sequence[str]) -> str:
        """The name of a picture of a board, which is drawn beside the page."""
        methods = sorted(
            self.methods(experiment, environment),
            key=lambda name: -self.mean(experiment, environment, name, protocols[0]),
        )
        board = {
            protocol: {name: self.values(experiment, environment, name, protocol) for name in methods}
            for protocol in protocols
        }
        self.pictures[file] = lambda place: draw_board(place, f"{environment}, {experiment}", board)
        return file

    def curve_picture(self, file: str, experiment: str, environment: str) -> str:
        """The name of a picture of learning curves, which is drawn beside the page."""
        points: dict[str, dict[int, list[float]]] = {}
        found = [row for row in self.curves if (row.experiment, row.environment) == (experiment, environment)]
        if not found:
            raise TrainingError(f"the table of curves holds nothing of {experiment}, {environment}")
        for row in found:
            points.setdefault(row.method, {}).setdefault(row.step, []).append(row.final)
        self.pictures[file] = lambda place: draw_method_curves(
            place, f"{environment}, {experiment}", points, found[0].protocol
        )
        return file


def read_numbers(file: Path) -> Numbers:
    """The table of runs, and those beside it as far as they are there.

    Raises:
        CheckpointError: one of them is not such a table.
    """
    return Numbers(
        read_table(RunRow, file),
        _beside(CurveRow, file, CURVES),
        _beside(TrialRow, file, TABLE),
        _beside(WorthRow, file, WORTH),
    )


def page_of(file: Path, numbers: Numbers) -> str:
    """The page of a table, by its template."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([file.parent, Path(__file__).parent]),
        undefined=jinja2.StrictUndefined,
        autoescape=False,  # the page is Markdown
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"digits": number, "percent": percent}
    try:
        return environment.select_template([TEMPLATE, DEFAULT]).render(_names(numbers))
    except jinja2.TemplateError as error:
        raise TrainingError(f"{file.parent / TEMPLATE}: {error}") from None


def write_results_page(file: str | Path, out: str | Path | None = None) -> list[Path]:
    """Writes the page of a table of runs, and its pictures; the files.

    Args:
        out: folder of the page; the table's own where None.

    Raises:
        CheckpointError: `file`, or a table beside it, is not one.
        TrainingError: the template asks for what the tables do not hold.
    """
    file = Path(file)
    folder = file.parent if out is None else Path(out)
    numbers = read_numbers(file)
    text = page_of(file, numbers)
    make_folders(folder)
    replace_file(folder / PAGE, text.encode())
    for name, draw in numbers.pictures.items():
        draw(folder / name)
    return [folder / PAGE, *(folder / name for name in numbers.pictures)]


def number(value: float | None, digits: int = DIGITS) -> str:
    """A number with so many significant digits, or decimals where it is below 1; `–` for None.

    Example:
        >>> number(-4.5687), number(3747.2), number(0.0512), number(-89.0)
        ('-4.57', '3,747', '0.051', '-89.0')
    """
    if value is None:
        return "–"
    whole = len(str(int(abs(value)))) if abs(value) >= 1 else 0
    return f"{value:,.{max(0, digits - whole)}f}"


def _with_interval(mean: float, low: float | None, high: float | None) -> str:
    return number(mean) + ("" if low is None else f" ({number(low)} to {number(high)})")


def percent(share: float | None, places: int = 0) -> str:
    """A share as a percentage; `–` for None."""
    return "–" if share is None else f"{100 * share:.{places}f}%"


def _p_text(probability: float) -> str:
    return "< 0.001" if probability < 0.001 else f"{probability:.3f}"


def _shown(value: Any) -> Any:
    return number(value) if isinstance(value, float) else value


def _paired(left: Mapping[Pair, float], right: Mapping[Pair, float], place: str) -> Difference:
    """The differences of values with the same data, fold and seed."""
    gains = [left[pair] - right[pair] for pair in left if pair in right]
    if not gains:
        raise TrainingError(f"{place} share no data, fold and seed")
    low, high = mean_interval(gains, fewest=2) or (None, None)
    return Difference(fmean(gains), low, high, len(gains), sign_probability(gains))


def _names(numbers: Numbers) -> dict[str, Any]:
    return {name: getattr(numbers, name) for name in dir(numbers) if not name.startswith("_")}


def _beside(kind: type[Row], file: Path, name: str) -> list[Row]:
    place = file.with_name(name)
    return read_table(kind, place) if place.exists() else []


def _references(rows: Sequence[RunRow]) -> dict[str, list[float]]:
    """Returns that methods are compared with, by the words for them; of all rows that know them."""
    labels = {
        "oracle": "controller that knows the task",
        "behavior": "each task's own best behavior policy",
        "fixed": "best policy that acts the same in all tasks",
        "random": "uniform actions",
    }
    found = {
        label: [value for row in rows if (value := getattr(row, column)) is not None]
        for column, label in labels.items()
    }
    return {label: values for label, values in found.items() if values}
