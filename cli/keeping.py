"""`tcmrl-data verify`, `delete` and `cache`."""

import dataclasses
import datetime
import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcmrl_data.foundation.files import printable
from tcmrl_data.foundation.machine import size

from .frame import duration, fail_incomplete, output_options, print_json, print_rows, remark
from .groups import Commands
from .options import COUNT, DATASET, DRY_RUN, INDEX, PATH, WORKERS, allow_only
from .progress import StageProgress

if TYPE_CHECKING:
    from tcmrl_data import BuildEvent, Finding, VerifyReport

MOST_LINES = 20
"""Findings that are listed one by one; of more, kinds are."""


@click.command()
@DATASET
@click.option("--quick", is_flag=True, help="Check names, sizes, links and the allow-list; hash no file.")
@click.option(
    "--deep",
    is_flag=True,
    help="Also decode every array, check its values, and simulate extended and relabelled parts again.",
)
@click.option(
    "--replay",
    type=INDEX,
    default=0,
    metavar="N",
    help="Also make N parts again from their snapshots and seeds, and compare them.",
)
@click.option("--sample", type=COUNT, metavar="N", help="Open N parts; check name and size of the others.")
@click.option("--strict", is_flag=True, help="What else is a note is a problem.")
@click.option(
    "--source",
    "sources",
    multiple=True,
    type=PATH,
    metavar="DATASET",
    help="With --deep or --replay: a dataset with parts that parts of DATASET were made from.",
)
@click.option("--repair", is_flag=True, help="Make damaged and missing parts again.")
@click.option(
    "--from",
    "copy",
    type=PATH,
    metavar="COPY",
    help="With --repair: take parts from a copy of the dataset where it has them, by their digests.",
)
@click.option(
    "--accept",
    is_flag=True,
    help="With --repair: make parts of another platform here; the dataset gets a new root.",
)
@WORKERS
@click.option("--clean", is_flag=True, help="Remove what ended builds left behind.")
@DRY_RUN
@output_options
@click.pass_context
def verify(
    context: click.Context,
    dataset: Path,
    quick: bool,
    deep: bool,
    replay: int,
    sample: int | None,
    strict: bool,
    sources: tuple[Path, ...],
    repair: bool,
    copy: Path | None,
    accept: bool,
    workers: int | None,
    clean: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Check DATASET, make damaged parts again, or remove leftovers.

    By default every file is hashed, and damaged, missing and foreign files are listed; of many alike, how
    many they are. A replay must be equal bit for bit if CPU model, packages and physics are those of the
    original, else equal within a tolerance. The exit code is 1 if a problem is found. A file of another
    program beside the data is a note, not a problem.

    With --repair, parts are made again from the recipe and the seed in the manifest, and replace the damaged
    ones only if they have the same ids. On another platform than theirs nothing is begun without --accept.
    Foreign files are kept. If manifest.json and its copy are both damaged, delete them and run the original
    `tcmrl-data build` again, which keeps all valid parts.

    With --clean, abandoned staging folders and the checkpoints of finished tasks are removed, unless a
    process works on the dataset.

    \b
    Examples:
      tcmrl-data verify data/point-robot --deep --replay 3 --json
      tcmrl-data verify data/medium --deep --source data/point-robot
      tcmrl-data verify data/point-robot --repair --from /backup/point-robot
      tcmrl-data verify data/point-robot --clean --dry-run
    """
    import tcmrl_data

    if repair:
        allow_only(context, "--repair", "deep", "copy", "accept", "workers")
        _repair(dataset, deep=deep, copy=copy, accept=accept, workers=workers, as_json=as_json)
        return
    if clean:
        allow_only(context, "--clean", "dry_run")
        _clean(dataset, dry_run=dry_run, as_json=as_json)
        return
    for option, value in {"--from": copy, "--accept": accept, "--workers": workers}.items():
        if value:
            raise click.UsageError(f"{option} goes with --repair.")
    if dry_run:
        raise click.UsageError("--dry-run goes with --clean.")
    if quick and deep:
        raise click.UsageError("--quick and --deep cannot be combined; pass one of them")
    with StageProgress() as progress:
        report = tcmrl_data.verify_dataset(
            dataset,
            level="quick" if quick else "deep" if deep else "digests",
            replay=replay,
            sample=sample,
            strict=strict,
            sources=sources,
            progress=lambda done, total: progress.update("verify", done=done, total=total, unit="parts"),
        )
    if as_json:
        print_json(dataclasses.asdict(report))
    else:
        for line in _report_lines(report):
            click.echo(line)
    if report.findings:
        command = shlex.join(["tcmrl-data", "verify", str(report.dataset), "--repair"])
        fail_incomplete(
            f"{report.dataset}: {_count(report.findings)}; `{command}` makes damaged parts again; delete "
            "foreign files yourself"
        )


def _report_lines(report: "VerifyReport") -> Iterator[str]:
    yield from _lines(report.findings, report.parts)
    for note in report.notes[:MOST_LINES]:
        yield f"note: {printable(note.file)}: {printable(note.problem)}"
    if len(report.notes) > MOST_LINES:
        yield f"note: {len(report.notes) - MOST_LINES:,} more notes; --json lists all"
    for replayed in report.replays:
        differences = "; ".join(replayed.platform_differences)
        how = f"within the tolerance for another platform ({differences})" if differences else "bit for bit"
        result = "differs" if replayed.problems else "is equal"
        yield f"replay of task {replayed.task}, step {replayed.step}: {result}, compared {how}"
    yield (
        f"{printable(str(report.dataset))}: {report.parts:,} parts, {report.files:,} files, "
        f"{size(report.bytes)}, level {report.level}, in {duration(report.seconds)}: "
        f"{_count(report.findings)}"
    )


def _repair(
    dataset: Path, *, deep: bool, copy: Path | None, accept: bool, workers: int | None, as_json: bool
) -> None:
    import tcmrl_data

    with StageProgress() as progress:
        report = tcmrl_data.repair_dataset(
            dataset,
            level="deep" if deep else "digests",
            workers=workers,
            copy=copy,
            accept=accept,
            progress=lambda event: _show(event, progress),
        )
    if as_json:
        print_json(dataclasses.asdict(report))
    else:
        for key in report.repaired:
            click.echo(f"{key}: regenerated, same id")
        for key in report.copied:
            click.echo(f"{key}: taken from {printable(str(copy))}, same digest")
        for key in report.accepted:
            click.echo(f"{key}: regenerated, another id")
        for table in report.tables:
            click.echo(f"{table}: written again from the parts, same root")
        for finding in report.left:
            click.echo(f"{printable(finding.file)}: kept, {printable(finding.problem)}")
        click.echo(
            f"{printable(str(report.dataset))}: {len(report.repaired) + len(report.accepted):,} parts "
            f"regenerated, {f'{len(report.copied):,} copied, ' if report.copied else ''}"
            f"{len(report.tables):,} tables rewritten, {len(report.left):,} findings left"
            f"{'; the folder cannot be written, and no write was needed' if report.read_only else ''}"
        )
        if report.accepted:
            click.echo(f"the root is now {report.root}; the manifest names the new parts")
    if report.failed:
        fail_incomplete(f"{report.failed[0]}; run the same command again to continue")
    left = [finding for finding in report.left if not finding.note]
    if left:
        fail_incomplete(f"{report.dataset}: {_count(left)} that `--repair` cannot resolve")


def _clean(dataset: Path, *, dry_run: bool, as_json: bool) -> None:
    import tcmrl_data

    found = tcmrl_data.collect_garbage(dataset, dry_run=dry_run)
    total = sum(item.bytes for item in found)
    if as_json:
        rows = [dataclasses.asdict(item) for item in found]
        print_json({"dataset": str(dataset), "dry_run": dry_run, "removed": rows, "bytes": total})
        return
    for item in found:
        click.echo(f"{printable(item.path)}: {size(item.bytes)}, {item.reason}")
    verb = "would be removed" if dry_run else "removed"
    click.echo(f"{printable(str(dataset))}: {len(found):,} items, {size(total)} {verb}")


def _lines(findings: Sequence["Finding"], parts: int) -> Iterator[str]:
    """The findings, or of many how many there are of every kind."""
    missing = [finding for finding in findings if finding.problem == "is missing" and finding.key is not None]
    if parts > 1 and len(missing) == parts:
        yield f"all {parts:,} parts are missing: is the disk mounted?"
        findings = [finding for finding in findings if finding.problem != "is missing" or finding.key is None]
    if len(findings) <= MOST_LINES:
        yield from (f"{printable(finding.file)}: {printable(finding.problem)}" for finding in findings)
        return
    kinds: dict[str, list[Finding]] = {}
    for finding in findings:
        kinds.setdefault(re.sub(r"[0-9]+", "N", finding.problem), []).append(finding)
    for alike in sorted(kinds.values(), key=len, reverse=True)[:MOST_LINES]:
        first = f"{printable(alike[0].file)}: {printable(alike[0].problem)}"
        yield first if len(alike) == 1 else f"{first}; and {len(alike) - 1:,} more of the kind"
    if len(kinds) > MOST_LINES:
        yield f"and {len(kinds) - MOST_LINES:,} more kinds; --json lists all"


def _count(findings: Sequence[object]) -> str:
    return f"{len(findings) or 'no'} finding{'' if len(findings) == 1 else 's'}"


def _show(event: "BuildEvent", progress: StageProgress) -> None:
    if event.kind in ("unit_failed", "warning"):
        progress.note(event.message)
    progress.update("behavior training", done=event.steps_done, total=event.steps_total, unit="steps")
    progress.update("parts", done=event.parts_done, total=event.parts_total, unit="parts")


@click.command()
@DATASET
@click.option("--yes", is_flag=True, help="Do not ask.")
@DRY_RUN
@output_options
def delete(dataset: Path, yes: bool, dry_run: bool, as_json: bool) -> None:
    """Delete DATASET, or what a stopped command left of one.

    Files in its folder that are no part of a dataset are listed and kept. A dataset that a process works on
    is not deleted.

    \b
    Examples:
      tcmrl-data delete data/point-robot-medium --dry-run
      tcmrl-data delete data/point-robot-medium --yes
    """
    import tcmrl_data

    found = tcmrl_data.delete_dataset(dataset, dry_run=True)
    what = f"{found.files:,} files, {size(found.bytes)}"
    if not dry_run:
        if not yes:
            click.confirm(f"Delete {printable(str(dataset))}, {what}?", abort=True, err=True)
        found = tcmrl_data.delete_dataset(dataset)
    if as_json:
        print_json(dataclasses.asdict(found) | {"dry_run": dry_run})
        return
    for file in found.kept:
        click.echo(f"{printable(file)}: {'would be ' if dry_run else ''}kept, it is no part of a dataset")
    click.echo(f"{printable(str(found.dataset))}: {what} {'would be ' if dry_run else ''}deleted")


@click.group(cls=Commands)
def cache() -> None:
    """List or clear the cache of decoded steps.

    Training reads data that do not fit in memory from this cache. The environment variable TCMRL_CACHE
    names its folder (default: tcmrl in the user's cache folder), and TCMRL_CACHE_LIMIT limits its size
    (default: 100G). The least recently used entries are removed first. Several runs may use the same
    entry: the first decodes it while the others wait.

    \b
    Examples:
      tcmrl-data cache list
      tcmrl-data cache clear
    """


@click.command(name="list")
@output_options
def list_cache(as_json: bool) -> None:
    """List the entries, least recently used first.

    \b
    Example:
      tcmrl-data cache list
    """
    import tcmrl_data

    folder, limit, entries = tcmrl_data.cache_folder(), tcmrl_data.cache_limit(), tcmrl_data.list_cache()
    if as_json:
        rows = [dataclasses.asdict(entry) for entry in entries]
        print_json({"folder": str(folder), "limit": limit, "entries": rows})
        return
    total = sum(entry.bytes for entry in entries)
    title = f"{folder}: {size(total)} of {size(limit)}"
    texts, counts = ["key", "environment", "dataset", "used", "state"], ["tasks", "parts", "size"]
    cells = []
    for entry in entries:
        used = datetime.datetime.fromtimestamp(entry.used).isoformat(" ", "minutes")
        numbers = (str(entry.tasks), str(entry.parts), size(entry.bytes))
        state = "in use" if entry.in_use else ""
        cells.append((entry.key[:12], entry.environment, entry.dataset, *numbers, used, state))
    print_rows(title, [*texts[:3], *counts, *texts[3:]], cells, text=texts)


@click.command(name="clear")
@click.option("--fetched", is_flag=True, help="Remove the parts and tables of datasets at addresses instead.")
@output_options
def clear_cache(fetched: bool, as_json: bool) -> None:
    """Remove all entries that no process is using.

    \b
    Examples:
      tcmrl-data cache clear
      tcmrl-data cache clear --fetched
    """
    import tcmrl_data

    if fetched:
        num_bytes = tcmrl_data.clear_fetched()
        print_json({"bytes": num_bytes}) if as_json else click.echo(
            f"fetched data removed, {size(num_bytes)}"
        )
        return
    removed = tcmrl_data.clear_cache()
    kept = tcmrl_data.list_cache()
    if as_json:
        print_json(
            {"removed": list(map(dataclasses.asdict, removed)), "kept": list(map(dataclasses.asdict, kept))}
        )
        return
    click.echo(f"{len(removed)} entries removed, {size(sum(entry.bytes for entry in removed))}")
    if kept:
        remark(f"{len(kept)} entries kept, because they are in use")


cache.fill({"Commands": [list_cache, clear_cache]})
