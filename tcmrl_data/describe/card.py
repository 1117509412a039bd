"""The card of a dataset: a README with front matter for hubs, made of what the dataset says of itself."""

from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

import jinja2
import numpy as np
import yaml

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import dataset_summary, list_returns, summarize_returns
from tcmrl_data.dataset.selection import TIERS
from tcmrl_data.describe.cite import citation_text
from tcmrl_data.describe.viewer import viewer_configs, write_viewer
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import StoreError, TcmrlError
from tcmrl_data.foundation.files import one_line, printable, read_plain_file
from tcmrl_data.foundation.machine import size
from tcmrl_data.quality.scores import Quality, measure_quality
from tcmrl_data.recipe.recipe import load_recipe
from tcmrl_data.store.manifest import FOREIGN_KINDS
from tcmrl_data.store.part_table import REFERENCES

BEGIN, END = "<!-- yours: this text is kept -->", "<!-- end of yours -->"
"""Marks around what people write; everything else is written anew."""

MAX_CARD_BYTES = 2**20

_HUB_NAMES = """
agpl-3.0 apache-2.0 bsd-2-clause bsd-3-clause bsd-3-clause-clear cc-by-3.0 cc-by-4.0 cc-by-nc-4.0
cc-by-nc-nd-4.0 cc-by-nc-sa-4.0 cc-by-nd-4.0 cc-by-sa-3.0 cc-by-sa-4.0 cc0-1.0 epl-2.0 gpl-2.0 gpl-3.0 isc
lgpl-2.1 lgpl-3.0 mit mpl-2.0 odc-by unlicense zlib
"""

HUB_LICENCES = frozenset(_HUB_NAMES.split())
"""Identifiers of licences that front matter may hold (https://huggingface.co/docs/hub/repositories-licenses)."""


def write_card(
    dataset: Dataset,
    file: Path,
    *,
    viewer: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Writes the card; text between the marks of an older card stays.

    Args:
        viewer: write Parquet beside the card too, and name it in the front matter (`describe.viewer`).
        progress: of the Parquet; called with the number of parts written and of all parts.

    Raises:
        MissingPackageError: the viewer's files need a package that is not installed.
        StoreError: the file is no plain file, or has not exactly one pair of marks; text would be lost.
        StorageError: the operating system refuses the operation.
    """
    kept = _kept_text(file)
    if viewer:
        write_viewer(dataset, file.parent, progress=progress)
    replace_file(file, dataset_card(dataset, kept=kept, viewer=viewer).encode())


def _kept_text(file: Path) -> str:
    try:
        text = read_plain_file(file, limit=MAX_CARD_BYTES).decode()
    except FileNotFoundError:
        return ""
    except (OSError, ValueError) as error:
        raise StoreError(f"{file}: {one_line(error)}; name another file by --out") from None
    before, begin, rest = text.partition(BEGIN)
    kept, end, after = rest.partition(END)
    if not (begin and end) or any(mark in part for part in (before, kept, after) for mark in (BEGIN, END)):
        raise StoreError(
            f"{file} would be overwritten: it has not one line {BEGIN!r} and one {END!r} behind it; put "
            "what is to stay between the two, or name another file by --out"
        )
    return kept.strip("\n")


def dataset_card(dataset: Dataset, *, kept: str = "", viewer: bool = False) -> str:
    """The card as Markdown, by the template `card.md.jinja`.

    Args:
        kept: Markdown of people, which stands below the summary between the marks.
        viewer: name the viewer's files in the front matter.
    """
    manifest, summary, quality = dataset.manifest, dataset_summary(dataset), measure_quality(dataset)
    front_matter = _front_matter(dataset, summary)
    if viewer:
        front_matter["configs"] = viewer_configs(dataset)
    spreads = {(stage.step, stage.split): stage.tq for stage in quality.stages}
    returns = summarize_returns(list_returns(dataset))
    for row in returns:
        spread = spreads.get((row["step"], row["split"]))
        row["tq"] = None if spread is None else spread.iqm
    words = {"cpu": "CPU", "system": "system", "python": "Python", "packages": "packages"}
    made_with = [(word, "; ".join(summary["made_with"][name])) for name, word in words.items()]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"plain": _plain, "number": _number, "whole": "{:,}".format}
    return environment.get_template("card.md.jinja").render(
        front_matter=yaml.safe_dump(front_matter, sort_keys=False, allow_unicode=True),
        title=manifest.label or dataset.name,
        manifest=manifest,
        summary=summary,
        begin=BEGIN,
        kept=kept,
        viewer=viewer,
        end=END,
        size=size(summary["bytes"]),
        made_with=[(word, value) for word, value in made_with if value],
        returns=returns,
        tiers=list(tier_rows(quality)),
        task=(dataset.train_tasks or dataset.tasks)[0].index if dataset.tasks else 0,
        build_command=_build_command(dataset),
        limits=_limits(dataset, summary),
        bibtex=citation_text(manifest, "bibtex").rstrip().replace("```", ""),
    )


def _front_matter(dataset: Dataset, summary: dict[str, Any]) -> dict[str, Any]:
    manifest = dataset.manifest
    names = [name.lower().removesuffix("-only").removesuffix("-or-later") for name in manifest.licences]
    known = [name for name in names if name in HUB_LICENCES]
    licence: dict[str, Any] = {"license": known if len(known) > 1 else known[0] if known else "other"}
    if len(known) < len(names):
        licence = {"license": "other", "license_name": _one_line(" AND ".join(manifest.licences))}
    return {
        "pretty_name": _one_line(manifest.label or manifest.name),
        **licence,
        "task_categories": ["reinforcement-learning"],
        "tags": ["offline-reinforcement-learning", "meta-reinforcement-learning", "tcmrl", manifest.name],
        "size_categories": [_size_category(summary["steps"])],
    }


def _size_category(steps: int) -> str:
    """The hub's word for a number of rows, which are environment steps."""
    bounds = ["1K", "10K", "100K", "1M", "10M", "100M", "1B", "10B"]
    place = sum(steps >= 10 ** (3 + power) for power in range(len(bounds)))
    if place in (0, len(bounds)):
        return f"n<{bounds[0]}" if place == 0 else f"n>{bounds[-1]}"
    return f"{bounds[place - 1]}<n<{bounds[place]}"


def tier_rows(quality: Quality) -> Iterator[tuple[str, int, int, int, float | None]]:
    """Of every tier: its name, the tasks that have it, their parts and episodes, and the parts' mean TQ.

    The mean is None where the quality of a part is not known.
    """
    for tier in TIERS:
        taken = [(task.task, part) for task in quality.tasks for part in task.snapshots if tier in part.tiers]
        known = [part.tq for _, part in taken if part.tq is not None]
        episodes = sum(part.episodes for _, part in taken)
        mean = fmean(known) if known and len(known) == len(taken) else None
        yield tier, len({task for task, _ in taken}), len(taken), episodes, mean


def _build_command(dataset: Dataset) -> str | None:
    """The command that builds the dataset from an installed recipe; None where it takes more than that."""
    manifest = dataset.manifest
    if len(manifest.runs) > 1 or manifest.runs[0].kind != "built" or manifest.derivation is not None:
        return None
    try:
        recipe = load_recipe(manifest.name, profile=manifest.profile)
    except TcmrlError:
        return None
    if recipe.unit_settings() != manifest.recipe.unit_settings():
        return None
    tasks = recipe.build == manifest.recipe.build
    limit = "" if tasks and not manifest.dropped else " --tasks LIST"
    return f"tcmrl-data build {manifest.name} --profile {manifest.profile} --seed {manifest.seed}{limit}"


def _limits(dataset: Dataset, summary: dict[str, Any]) -> list[str]:
    runs, columns = dataset.manifest.runs, dataset.parts.columns
    is_unknown = {name: np.isnan(columns[name]) for name in REFERENCES}
    no_expert = is_unknown["oracle"] & is_unknown["scripted"]
    found = {
        "It is incomplete.": not summary["complete"],
        "No seed is known of some runs; their episodes cannot be made again.": any(
            run.seed is None for run in runs
        ),
        "Some runs were made elsewhere; they hold no policies.": any(
            run.kind in FOREIGN_KINDS for run in runs
        ),
        "No returns of uniform actions are known of some tasks, which have no scores and no tiers.": bool(
            is_unknown["uniform"].any()
        ),
        "No controller knows some tasks; their scores compare with the best policy.": bool(no_expert.any()),
        "Parameters of some tasks are not known.": any(not task.parameters for task in dataset.tasks),
    }
    return [text for text, holds in found.items() if holds]


def _plain(text: str) -> str:
    """A text of a stranger in one line of Markdown, without markup that it could end or begin."""
    line = _one_line(text)
    for character in "\\`*_[]|":
        line = line.replace(character, f"\\{character}")
    return line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _one_line(text: str) -> str:
    return printable(" ".join(text.split()))


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:,.2f}"
