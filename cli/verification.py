"""`tcmrl-data verify`, `repair`, `gc`, `import-policy`: trust a dataset, mend it, tidy it, take policies."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.foundation.sizes import size

from .frame import duration, fail_incomplete, output_options, print_json
from .progress import StageProgress

if TYPE_CHECKING:
    from tcmrl_data import BuildEvent, VerifyLevel

DATASET = click.argument("dataset", type=click.Path(path_type=Path))


@click.command()
@DATASET
@click.option("--quick", is_flag=True, help="Names, sizes, links and the allow-list only; no file is hashed.")
@click.option("--deep", is_flag=True, help="Also decode every array and check what it says.")
@click.option(
    "--replay",
    type=click.IntRange(min=0),
    default=0,
    metavar="N",
    help="Also make N parts again from their snapshots and seeds, and compare.",
)
@output_options
def verify(dataset: Path, as_json: bool, quiet: bool, quick: bool, deep: bool, replay: int) -> None:
    """Find everything that is wrong with DATASET, and name the files.

    By default every file is hashed. A replay is compared bit for bit on the CPU model, packages and physics
    of the original, elsewhere within a tolerance. Nothing is changed. Exit code 1 where anything is found.

    \b
    Examples:
      tcmrl-data verify data/point-robot
      tcmrl-data verify data/point-robot --deep --replay 3 --json
    """
    import tcmrl_data

    level = _level(quick=quick, deep=deep)
    with StageProgress(quiet=quiet) as progress:
        report = tcmrl_data.verify_dataset(
            dataset,
            level=level,
            replay=replay,
            progress=lambda done, total: progress.update("verify", done=done, total=total, unit="parts"),
        )
    if as_json:
        print_json(dataclasses.asdict(report) | {"dataset": str(report.dataset)})
    else:
        for finding in report.findings:
            click.echo(f"{printable(finding.file)}: {printable(finding.problem)}")
        for each in report.replays:
            how = "bit for bit" if each.exact else "within the tolerance for another platform"
            result = "differs" if each.problems else "is the same"
            click.echo(f"replay of task {each.task}, step {each.step}: {result}, compared {how}")
        click.echo(
            f"{printable(str(report.dataset))}: {report.parts:,} parts, {report.files:,} files, "
            f"{size(report.bytes)}, level {report.level}, in {duration(report.seconds)}: "
            f"{_count(report.findings)}"
        )
    if report.findings:
        fail_incomplete(
            f"{report.dataset}: {_count(report.findings)}; `tcmrl-data repair {report.dataset}` "
            "makes damaged parts again, foreign files are yours to delete"
        )


@click.command()
@DATASET
@click.option("--deep", is_flag=True, help="Reject what `verify --deep` rejects.")
@click.option("--workers", type=click.IntRange(min=1), help="Processes at a time; all cores if left out.")
@output_options
def repair(dataset: Path, as_json: bool, quiet: bool, deep: bool, workers: int | None) -> None:
    """Make the parts of DATASET again that verification rejects.

    Recipe and seed are the manifest's, and the new parts must have the old ids before they replace
    anything. Foreign files are named and left. A damaged manifest.json cannot be repaired: delete it and
    the part folders that `verify` names, then run the first `tcmrl-data build` again, which takes in all
    parts that hold.

    \b
    Example:
      tcmrl-data repair data/point-robot --workers 2
    """
    import tcmrl_data

    with StageProgress(quiet=quiet) as progress:
        report = tcmrl_data.repair_dataset(
            dataset,
            level=_level(quick=False, deep=deep),
            workers=workers,
            progress=lambda event: _show(event, progress),
        )
    if as_json:
        print_json(dataclasses.asdict(report) | {"dataset": str(report.dataset)})
    else:
        for task, step in report.repaired:
            click.echo(f"task {task}, step {step}: made again, same id")
        for file in report.groups:
            click.echo(f"{file}: written again")
        for finding in report.left:
            click.echo(f"{printable(finding.file)}: left, {printable(finding.problem)}")
        click.echo(
            f"{printable(str(report.dataset))}: {len(report.repaired):,} parts made again, "
            f"{len(report.groups):,} group records written, {_count(report.left)} left"
            f"{'; the folder cannot be written, and nothing had to be' if report.read_only else ''}"
        )
    if report.failed:
        fail_incomplete(f"{report.failed[0]}; the same command goes on from there")
    if report.left:
        fail_incomplete(f"{report.dataset}: {_count(report.left)} that a repair does not touch")


@click.command()
@DATASET
@click.option("--dry-run", is_flag=True, help="Only say what would be removed.")
@output_options
def gc(dataset: Path, as_json: bool, quiet: bool, dry_run: bool) -> None:
    """Remove what ended builds of DATASET left behind: abandoned staging, checkpoints of finished tasks.

    Refused while a process works on the dataset.

    \b
    Example:
      tcmrl-data gc data/point-robot --dry-run
    """
    import tcmrl_data

    found = tcmrl_data.collect_garbage(dataset, dry_run=dry_run)
    total = sum(each.bytes for each in found)
    if as_json:
        rows = [dataclasses.asdict(each) for each in found]
        print_json({"dataset": str(dataset), "dry_run": dry_run, "removed": rows, "bytes": total})
        return
    for each in found:
        click.echo(f"{printable(each.path)}: {size(each.bytes)}, {each.reason}")
    verb = "would be removed" if dry_run else "removed"
    click.echo(f"{printable(str(dataset))}: {len(found):,} items, {size(total)} {verb}")


@click.command(name="import-policy")
@click.argument("zip_file", metavar="ZIP", type=click.Path(path_type=Path))
@click.option(
    "--trust-pickle", is_flag=True, help="ZIP holds pickles, which run code when read: say that you trust it."
)
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="FOLDER", help="A new folder.")
@click.option(
    "--observation",
    type=click.Choice(["stored", "full"]),
    default="stored",
    show_default=True,
    help="What the policy was trained to see.",
)
@output_options
def import_policy(
    zip_file: Path, as_json: bool, quiet: bool, trust_pickle: bool, out: Path, observation: str
) -> None:
    """Turn the SAC actor in a Stable-Baselines3 ZIP into policy.json and policy.safetensors.

    \b
    Example:
      tcmrl-data import-policy sac.zip --trust-pickle --out policies/sac
    """
    if not trust_pickle:
        raise click.ClickException(
            f"{zip_file} may run any code when it is read; pass --trust-pickle if you trust its author"
        )
    import tcmrl_data

    snapshot = tcmrl_data.import_sac(zip_file, out, observation="full" if observation == "full" else "stored")
    files = {name: len(content) for name, content in snapshot.files().items()}
    if as_json:
        print_json({"out": str(out), "step": snapshot.step, "files": files, "digest": snapshot.digest()})
    else:
        click.echo(f"{out}: {', '.join(files)}, {size(sum(files.values()))}, digest {snapshot.digest()[:12]}")


def _level(*, quick: bool, deep: bool) -> "VerifyLevel":
    if quick and deep:
        raise click.UsageError("--quick and --deep exclude each other")
    return "quick" if quick else "deep" if deep else "digests"


def _count(findings: Sequence[object]) -> str:
    return f"{len(findings) or 'no'} finding{'' if len(findings) == 1 else 's'}"


def _show(event: "BuildEvent", progress: StageProgress) -> None:
    if event.kind == "unit_failed":
        progress.note(event.message)
    progress.update("behavior training", done=event.steps_done, total=event.steps_total, unit="steps")
    progress.update("parts", done=event.parts_done, total=event.parts_total, unit="parts")
