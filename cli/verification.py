"""`tcmrl-data verify`, `repair`, `gc` and `import-policy`."""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcmrl_data.foundation.machine import size
from tcmrl_data.foundation.plain_files import printable

from .frame import duration, fail_incomplete, output_options, print_json
from .options import PROCESSES
from .places import DATASET_PATH
from .progress import StageProgress

if TYPE_CHECKING:
    from tcmrl_data import BuildEvent, Finding, VerifyLevel

MOST_LINES = 20
"""Findings that are listed one by one; of more, kinds are."""

DATASET = click.argument("dataset", type=DATASET_PATH)


@click.command()
@DATASET
@click.option(
    "--quick", is_flag=True, help="Check only names, sizes, links and the allow-list; hash no file."
)
@click.option(
    "--deep",
    is_flag=True,
    help="Also decode every array, check its values, and simulate extended and relabelled parts again.",
)
@click.option(
    "--replay",
    type=click.IntRange(min=0),
    default=0,
    metavar="N",
    help="Also regenerate N parts from their snapshots and seeds, and compare them.",
)
@click.option(
    "--sample",
    type=click.IntRange(min=1),
    metavar="N",
    help="Open N parts, spread over the dataset; check name and size of the others.",
)
@click.option("--strict", is_flag=True, help="Files of others beside the data are problems too.")
@click.option(
    "--source",
    "sources",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="DATASET",
    help="A dataset that DATASET was derived from; name all, and the derivation is done again and compared.",
)
@output_options
def verify(
    dataset: Path,
    as_json: bool,
    quiet: bool,
    quick: bool,
    deep: bool,
    replay: int,
    sample: int | None,
    strict: bool,
    sources: tuple[Path, ...],
) -> None:
    """Check DATASET, and list every damaged, missing or foreign file; of many alike, how many they are.

    By default every file is hashed. A replay must be equal bit for bit if CPU model, packages and physics
    are those of the original, else equal within a tolerance. The dataset is not changed. The exit code is
    1 if a problem is found. A file of another program beside the data is a note, not a problem.

    \b
    Examples:
      tcmrl-data verify data/point-robot
      tcmrl-data verify data/point-robot --deep --replay 3 --json
      tcmrl-data verify data/point-robot-medium --deep --source data/point-robot
    """
    import tcmrl_data

    level = _level(quick=quick, deep=deep)
    with StageProgress(quiet=quiet) as progress:
        report = tcmrl_data.verify_dataset(
            dataset,
            level=level,
            replay=replay,
            sample=sample,
            strict=strict,
            sources=sources,
            progress=lambda done, total: progress.update("verify", done=done, total=total, unit="parts"),
        )
    if as_json:
        print_json(dataclasses.asdict(report))
    else:
        for line in _lines(report.findings, report.parts):
            click.echo(line)
        for note in report.notes[:MOST_LINES]:
            click.echo(f"note: {printable(note.file)}: {printable(note.problem)}")
        if len(report.notes) > MOST_LINES:
            click.echo(f"note: {len(report.notes) - MOST_LINES:,} more files belong to no part")
        for replayed in report.replays:
            differences = "; ".join(replayed.platform_differences)
            how = (
                f"within the tolerance for another platform ({differences})" if differences else "bit for bit"
            )
            result = "differs" if replayed.problems else "is equal"
            click.echo(f"replay of task {replayed.task}, step {replayed.step}: {result}, compared {how}")
        click.echo(
            f"{printable(str(report.dataset))}: {report.parts:,} parts, {report.files:,} files, "
            f"{size(report.bytes)}, level {report.level}, in {duration(report.seconds)}: "
            f"{_count(report.findings)}"
        )
    if report.findings:
        fail_incomplete(
            f"{report.dataset}: {_count(report.findings)}; `tcmrl-data repair {report.dataset}` "
            "regenerates damaged parts; delete foreign files yourself"
        )


@click.command()
@DATASET
@click.option("--deep", is_flag=True, help="Check as `verify --deep` does.")
@click.option(
    "--from",
    "copy",
    type=click.Path(path_type=Path),
    metavar="COPY",
    help="Take parts from a copy of the dataset where it has them, by their digests.",
)
@click.option(
    "--accept",
    is_flag=True,
    help="Make parts of another platform here and take them as they come out: the dataset gets a new root.",
)
@PROCESSES
@output_options
def repair(
    dataset: Path,
    as_json: bool,
    quiet: bool,
    deep: bool,
    copy: Path | None,
    accept: bool,
    workers: int | None,
) -> None:
    """Regenerate the damaged parts of DATASET.

    Parts are regenerated from the recipe and the seed in the manifest, and replace the damaged parts only
    if they have the same ids. On another platform than theirs nothing is begun without --accept. Foreign
    files are listed and kept. A damaged manifest.json cannot be repaired: delete it and the part folders
    that `verify` lists, then run the original `tcmrl-data build` again, which keeps all valid parts.

    \b
    Examples:
      tcmrl-data repair data/point-robot --workers 2
      tcmrl-data repair data/point-robot --from /backup/point-robot
    """
    import tcmrl_data

    with StageProgress(quiet=quiet) as progress:
        report = tcmrl_data.repair_dataset(
            dataset,
            level=_level(quick=False, deep=deep),
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
        fail_incomplete(f"{report.dataset}: {_count(left)} that `repair` cannot resolve")


@click.command()
@DATASET
@click.option("--dry-run", is_flag=True, help="Only list what would be removed.")
@output_options
def gc(dataset: Path, as_json: bool, quiet: bool, dry_run: bool) -> None:
    """Remove the leftovers of ended builds of DATASET.

    Leftovers are abandoned staging folders and the checkpoints of finished tasks. The command refuses to
    run while a process works on the dataset.

    \b
    Example:
      tcmrl-data gc data/point-robot --dry-run
    """
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


@click.command(name="import-policy")
@click.argument("zip_file", metavar="ZIP", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, metavar="FOLDER", help="Folder to create."
)
@click.option(
    "--observation",
    type=click.Choice(["stored", "full"]),
    default="stored",
    show_default=True,
    help="Observation that the policy was trained on.",
)
@output_options
def import_policy(zip_file: Path, as_json: bool, quiet: bool, out: Path, observation: str) -> None:
    """Convert the SAC actor of a Stable-Baselines3 ZIP to a policy.

    The new folder contains policy.json and policy.safetensors. No pickle of ZIP is run.

    \b
    Example:
      tcmrl-data import-policy sac.zip --out policies/sac
    """
    import tcmrl_data

    snapshot = tcmrl_data.import_sac(zip_file, out, observation="full" if observation == "full" else "stored")
    files = {name: len(content) for name, content in snapshot.files().items()}
    if as_json:
        print_json({"out": str(out), "step": snapshot.step, "files": files, "digest": snapshot.digest()})
    else:
        click.echo(f"{out}: {', '.join(files)}, {size(sum(files.values()))}, digest {snapshot.digest()[:12]}")


def _level(*, quick: bool, deep: bool) -> "VerifyLevel":
    if quick and deep:
        raise click.UsageError("--quick and --deep cannot be combined; pass one of them")
    return "quick" if quick else "deep" if deep else "digests"


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
