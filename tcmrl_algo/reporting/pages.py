"""Pages whose numbers are recomputed from committed results.

A page marks what was measured. The marks are comments, which Markdown does not show:

    -4.67<!-- = figure4_point_robot; point-robot; idaq; TCMRL; final -->

is one number, with as many decimals as stand there, and

    <!-- returns figure4_point_robot -->
    <!-- end -->

is a whole table; `<!-- boards FOLDER -->` ranks the methods of a report as a leaderboard does, and
`<!-- worth FOLDER -->` is the table of the documents of `inspect worth --json` in a folder beside all
reports. Folders are those of reports below one root, such as `docs/results`. The keys of a number are
folder, environment, protocol, method and a quantity (`final`, `shuffled`, `regret`, `normalized`, `fixed`,
`success`, `over dataset`, and `low` or `high`, the ends of the 95% interval of `final`); or folder,
environment, protocol, `claim N` and one of `mean`, `low`, `high`, `p` (N counts the claims of the experiment
from 1); or a JSON file and the keys into it, and last, if needed, a factor such as `* 1000`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any, final

from tcmrl_algo.experiment.aggregate import summarize
from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.reporting import sections
from tcmrl_algo.reporting.boards import gather
from tcmrl_algo.reporting.claims import Verdict, judge
from tcmrl_algo.reporting.leaderboard import returns_table
from tcmrl_algo.reporting.scores import known_scores
from tcmrl_algo.reporting.sources import Source, read_sources
from tcmrl_algo.reporting.worth import worth_table
from tcmrl_data import TrainingError, Worth, parse_json

NUMBER = re.compile(r"(?P<shown>[-−+]?\d[\d,]*(?:\.\d+)?)<!-- = (?P<key>[^>]*?) -->")
BLOCK = re.compile(r"<!-- (?P<kind>\w+) (?P<folder>\S+) -->\n(?P<shown>.*?)<!-- end -->", re.DOTALL)
UNMARKED = re.compile(r"(?<![\w.])[-−+]?\d[\d,]*\.\d+(?![\w.]*\d)")
NOT_PROSE = re.compile(r"```.*?```|`[^`\n]*`|\]\([^)]*\)|<!--.*?-->", re.DOTALL)
FACTOR = "* "


@final
class Pages:
    """Rewrites pages; every report is read once.

    Args:
        root: folder of the reports.
        blocks: more kinds of tables; what each makes of a folder or file below the root.
    """

    def __init__(self, root: Path, blocks: "Mapping[str, Block] | None" = None) -> None:
        self._root = root
        self._blocks = {**BLOCKS, **(blocks or {})}
        self.source = cache(self._read_source)
        self.document = cache(self._read_document)

    def rewritten(self, text: str) -> str:
        """A page with every marked number and table as the results give them.

        Raises:
            TcmrlError: a mark names no result; the message quotes the mark.
        """
        blocks = BLOCK.sub(self._block, text)
        return NUMBER.sub(lambda match: _number(match, self), blocks)

    def worths(self, folder: str) -> dict[str, Worth]:
        """The documents of `tcmrl-data inspect worth --json` in a folder, by name."""
        files = sorted((self._root / folder).glob("*.json"))
        return {file.stem: Worth.model_validate_json(file.read_bytes()) for file in files}

    def reports(self) -> list[tuple[str, Source]]:
        """All reports with their folders' names."""
        folders = sorted(file.parent.name for file in self._root.glob("*/report.md"))
        return [(folder, self.source(folder)) for folder in folders]

    def _block(self, match: "re.Match[str]") -> str:
        kind, folder = match["kind"], match["folder"]
        if kind not in self._blocks:
            known = ", ".join(self._blocks)
            raise TrainingError(f"{match[0].splitlines()[0]}: no such table; there are {known}")
        return f"<!-- {kind} {folder} -->\n{self._blocks[kind](self, folder)}\n<!-- end -->"

    def _read_source(self, folder: str) -> Source:
        (source,) = read_sources([self._root / folder], lambda stage, done, total: None)
        return source

    def _read_document(self, file: str) -> Any:
        data = (self._root / file).read_bytes()
        try:
            return parse_json(data)
        except ValueError:  # a document per line
            return [parse_json(line) for line in data.splitlines()]


def unmarked_numbers(text: str) -> list[str]:
    """Decimal numbers in the prose and tables of a page that no mark recomputes.

    Code, link targets and recomputed tables do not count, nor does a number without decimals.
    """
    prose = NUMBER.sub("", BLOCK.sub("", text))
    return UNMARKED.findall(NOT_PROSE.sub("", prose))


def _returns(pages: Pages, folder: str) -> str:
    parts, source = [], pages.source(folder)
    for environment in source.environments():
        stored = source.stored_return(environment)
        table = sections.final_table("returns", source.results(environment), stored=stored)
        parts.append(f"On {environment}:\n\n{table.markdown()}")
    return "\n" + "\n\n".join(parts) + "\n"


def _claims(pages: Pages, folder: str) -> str:
    return f"\n{sections.verdict_table('claims', judge(pages.source(folder))).markdown()}\n"


def _boards(pages: Pages, folder: str) -> str:
    boards = gather([pages.source(folder)])
    parts = [f"On {board.environment}:\n\n{returns_table(board).markdown()}" for board in boards]
    return "\n" + "\n\n".join(parts) + "\n"


def _worth(pages: Pages, folder: str) -> str:
    return f"\n{worth_table(pages.worths(folder), pages.reports()).markdown()}\n"


Block = Callable[[Pages, str], str]
BLOCKS: dict[str, Block] = {"returns": _returns, "claims": _claims, "boards": _boards, "worth": _worth}
"""What a table mark may ask for."""


def _number(match: "re.Match[str]", pages: Pages) -> str:
    keys = [key.strip() for key in match["key"].split(";")]
    try:
        value = _value(keys, pages)
    except (LookupError, ValueError, TypeError, OSError) as error:
        raise TrainingError(
            f"{match[0]}: names no number ({error}); see `tcmrl_algo.reporting.pages`"
        ) from None
    shown = match["shown"]
    decimals = len(shown.partition(".")[2])
    sign = "+" if shown.startswith("+") and value >= 0 else ""
    text = f"{sign}{value:{',' if ',' in shown else ''}.{decimals}f}"
    return f"{text.replace('-', '−') if '−' in shown else text}<!-- = {match['key']} -->"


def _value(keys: Sequence[str], pages: Pages) -> float:
    folder, *rest = keys
    if folder.endswith(".json"):
        return _of_json(pages.document(folder), rest)
    environment, protocol, subject, quantity = rest
    source = pages.source(folder)
    if subject.startswith("claim "):
        claim = source.experiment.claims[int(subject.removeprefix("claim ")) - 1]
        (verdict,) = (
            found
            for found in judge(source)
            if (found.claim, found.environment) == (claim.text, environment)
            and found.protocol in (None, protocol)
        )
        return _of_verdict(verdict, quantity)
    runs = [result for result in source.results(environment) if result.method == subject]
    if not runs:
        raise LookupError(f"no run of {subject!r} on {environment!r}")
    return _of_runs(runs, protocol, quantity, source.stored_return(environment))


def _of_verdict(verdict: Verdict, quantity: str) -> float:
    values = {"mean": verdict.mean, "low": verdict.low, "high": verdict.high, "p": verdict.adjusted}
    value = values[quantity]
    if value is None:
        raise ValueError(f"the verdict has no {quantity}")
    return value


def _of_runs(runs: Sequence[RunResult], protocol: str, quantity: str, stored: float | None) -> float:
    evaluations = [run.evaluations[protocol] for run in runs]
    if score := known_scores(runs, stored).get(quantity):
        known = [score(found) for found in evaluations]
        return fmean(share for share in known if share is not None)
    ends = quantity in ("low", "high")
    name = "mean_final" if ends else f"mean_{quantity}"
    summary = summarize([found[name] for found in evaluations])
    value: float | None = getattr(summary, quantity) if ends else summary.mean
    if value is None:
        raise ValueError(f"fewer than five runs have no {quantity}")
    return value


def _of_json(value: Any, keys: Sequence[str]) -> float:
    factor = 1.0
    if keys and keys[-1].startswith(FACTOR):
        factor, keys = float(keys[-1].removeprefix(FACTOR)), keys[:-1]
    for key in keys:
        value = value[int(key)] if isinstance(value, list) else value[key]
    return float(value) * factor
