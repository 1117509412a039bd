"""The card of a dataset: a README with front matter for hubs, made of what the dataset says of itself."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import yaml

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import dataset_summary
from tcmrl_data.dataset.returns import return_table, summarize_returns
from tcmrl_data.dataset.selection import TIERS
from tcmrl_data.describe.cite import citation_text
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import StoreError, TcmrlError
from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.plain_files import one_line, printable, read_plain_file
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


def write_card(dataset: Dataset, file: Path) -> None:
    """Writes the card; text between the marks of an older card stays.

    Raises:
        StoreError: the file is no plain file, or has not exactly one pair of marks; text would be lost.
        StorageError: the operating system refuses the operation.
    """
    replace_file(file, dataset_card(dataset, kept=_kept_text(file)).encode())


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


def dataset_card(dataset: Dataset, *, kept: str = "") -> str:
    """The card as Markdown.

    Args:
        dataset: the dataset or view.
        kept: Markdown of people, which stands below the summary between the marks.
    """
    summary, quality = dataset_summary(dataset), measure_quality(dataset)
    sections = [
        f"---\n{yaml.safe_dump(_front_matter(dataset, summary), sort_keys=False, allow_unicode=True)}---",
        f"# {_plain(dataset.manifest.label or dataset.name)}",
        _plain(summary["description"]),
        "\n".join(filter(None, [BEGIN, kept, END])),
        *_what_it_is(summary),
        *_how_it_was_made(dataset, summary),
        *_returns(dataset, quality),
        *_tiers(quality),
        *_how_to_use(dataset),
        *_limits(dataset, summary),
        *_licence_and_citation(dataset),
    ]
    return "\n\n".join(sections) + "\n"


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


def _what_it_is(summary: dict[str, Any]) -> Iterator[str]:
    steps = ", ".join(f"{step:,}" for step in summary["snapshots"])
    yield "## What it is"
    yield (
        "A dataset for offline meta-reinforcement learning: policies of many tasks of one environment, kept "
        "at several steps of their training, and episodes that they played. A policy with its episodes is a "
        "*part*."
    )
    rows = {
        "environment": _plain(summary["name"]),
        "tasks": f"{summary['tasks']:,} ({summary['train']:,} training, {summary['test']:,} test)",
        "snapshots": f"steps {steps}",
        "parts": f"{summary['parts']:,} of {summary['parts_total']:,}",
        "episodes": f"{summary['episodes']:,} with {summary['steps']:,} steps",
        "size": size(summary["bytes"]),
        "root": f"`{summary['root']}`",
    }
    yield _table(["", ""], rows.items())


def _how_it_was_made(dataset: Dataset, summary: dict[str, Any]) -> Iterator[str]:
    manifest = dataset.manifest
    yield "## How it was made"
    rows = [
        (
            run.name,
            run.kind,
            "–" if run.recipe is None else _plain(run.recipe.behavior.source),
            "–" if run.seed is None else str(run.seed),
        )
        for run in manifest.runs
    ]
    yield _table(["run", "kind", "behavior policies", "seed"], rows)
    if manifest.derivation is not None:
        made = manifest.derivation
        roots = ", ".join(f"`{source.root[:12]}`" for source in made.sources)
        yield f"Made by `{made.operation}`{f' from datasets with the roots {roots}' if roots else ''}."
    made_with = summary["made_with"]
    lines = [
        f"- {name}: {_plain('; '.join(made_with[key]))}"
        for name, key in (
            ("CPU", "cpu"),
            ("system", "system"),
            ("Python", "python"),
            ("packages", "packages"),
        )
        if made_with[key]
    ]
    yield "\n".join(lines) if lines else "The software and hardware that made it are not known."


def _returns(dataset: Dataset, quality: Quality) -> Iterator[str]:
    yield "## Returns"
    yield (
        "Mean undiscounted return of a task, over tasks. Trajectory quality (TQ) is the interquartile mean "
        "over tasks of the return, where 0 is that of uniform actions and 1 the best that is known of the "
        "task ([Schweighofer et al., 2021](https://arxiv.org/abs/2111.04714))."
    )
    tq = {(stage.step, stage.split): stage.tq for stage in quality.stages}
    rows = []
    for row in summarize_returns(return_table(dataset)):
        spread = tq.get((row["step"], row["split"]))
        numbers = [_number(row[name]) for name in ("mean", "std", "min", "max")]
        found = _number(None if spread is None else spread.iqm)
        rows.append((f"{row['step']:,}", row["split"], str(row["tasks"]), *numbers, found))
    yield _table(["step", "split", "tasks", "mean", "std", "min", "max", "TQ"], rows)


def _tiers(quality: Quality) -> Iterator[str]:
    yield "## Tiers"
    yield "Quality tiers by D4RL's words; `tcmrl-data derive DATASET --tier NAME --out FOLDER` makes one."
    rows = [
        (f"`{tier}`", f"{tasks:,} of {len(quality.tasks):,}", f"{parts:,}", _number(tq))
        for tier, tasks, parts, _, tq in tier_rows(quality)
    ]
    yield _table(["tier", "tasks", "parts", "mean TQ"], rows)


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


def _how_to_use(dataset: Dataset) -> Iterator[str]:
    task = (dataset.train_tasks or dataset.tasks)[0].index if dataset.tasks else 0
    yield "## How to load it"
    yield (
        "```python\n"
        "import tcmrl_data\n\n"
        'dataset = tcmrl_data.open_dataset("FOLDER")\n'
        f'episodes = dataset.select(snapshots="last").trajectories({task})\n'
        "observations, actions = episodes[0].observations, episodes[0].actions\n"
        "```"
    )
    yield "`tcmrl-data verify FOLDER` checks every file; no code of the dataset runs when it is read."
    command = _build_command(dataset)
    if command is not None:
        yield "## How to build it again"
        yield f"```bash\n{command}\n```"
        yield f"gives the root `{dataset.manifest.root[:12]}` on an equal platform."


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


def _limits(dataset: Dataset, summary: dict[str, Any]) -> Iterator[str]:
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
    yield "## Known limits"
    lines = [f"- {text}" for text, holds in found.items() if holds]
    yield "\n".join([*lines, "- Episodes are of simulations; other processors round differently."])


def _licence_and_citation(dataset: Dataset) -> Iterator[str]:
    licences = [_plain(name) for name in dataset.manifest.licences]
    yield "## Licence"
    if len(licences) == 1:
        yield f"{licences[0]}."
    else:
        yield f"Its sources are under different licences, all of which apply: {', '.join(licences)}."
    yield "## Citation"
    yield f"{_plain(dataset.manifest.recipe.about.citation)}."
    yield f"```bibtex\n{citation_text(dataset.manifest, 'bibtex').rstrip().replace('```', '')}\n```"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


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
