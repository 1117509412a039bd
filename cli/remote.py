"""`tcmrl-data push` and `pull`: datasets in buckets and behind web servers."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from tcmrl_data.foundation.machine import size

from .frame import (
    output_options,
    print_json,
    print_properties,
    remark,
    stopped_by_signals,
    typed_command,
)
from .options import DATASET, SNAPSHOTS, SPLIT, TASKS, TIER, indices
from .progress import StageProgress

if TYPE_CHECKING:
    from tcmrl_data import PushPlan
    from tcmrl_data.envs.base import Split

Made = TypeVar("Made")

PRICE = click.FloatRange(min=0)


@click.command()
@DATASET
@click.argument("url")
@click.option("--tag", metavar="NAME", help="A name for this state of DATASET: it is opened as URL@NAME.")
@click.option("--move", is_flag=True, help="The tag may name another dataset so far.")
@click.option("--plan", is_flag=True, help="Only print what would be sent: bytes, requests and price.")
@click.option("--price-per-gb", type=PRICE, metavar="PRICE", help="Such as a GB of storage costs a month.")
@click.option("--price-per-1000-requests", type=PRICE, metavar="PRICE", help="Such as 1,000 writes cost.")
@output_options
def push(
    dataset: Path,
    url: str,
    tag: str | None,
    move: bool,
    plan: bool,
    price_per_gb: float | None,
    price_per_1000_requests: float | None,
    as_json: bool,
) -> None:
    """Copy DATASET to URL, a folder of a bucket such as s3://bucket/point-robot.

    Without --tag, URL becomes the address of this dataset for good. Under tags the same URL keeps further
    states of it, and tiers or other selections; a part is stored once for all of them. Credentials come from
    the environment, as those of the bucket's own tools do. After an interruption the same command goes on.

    \b
    Examples:
      tcmrl-data push data/point-robot s3://bucket/point-robot
      tcmrl-data push data/point-robot-medium s3://bucket/point-robot --tag medium
      tcmrl-data push data/point-robot s3://bucket/pr --plan --price-per-gb 0.023
    """
    import tcmrl_data

    if move and tag is None:
        raise click.UsageError("--move is for tags; name one by --tag.")
    if plan:
        planned = tcmrl_data.plan_push(dataset, url, tag=tag, move=move)
        _print_plan(planned, [price_per_gb, price_per_1000_requests], as_json=as_json)
        return
    if price_per_gb is not None or price_per_1000_requests is not None:
        raise click.UsageError("prices are for --plan; add it.")
    done = _in_bytes(
        lambda progress: tcmrl_data.push_dataset(dataset, url, tag=tag, move=move, progress=progress),
        stage="pushing",
    )
    if as_json:
        print_json(dataclasses.asdict(done))
        return
    if done.moved_from is not None:
        remark(f"{done.address} named root {done.moved_from[:12]} until now")
    click.echo(
        f"{done.address}: {done.parts:,} parts, {done.sent_parts:,} of them sent now, with tables "
        f"{size(done.sent_bytes)}, root {done.root[:12]}"
    )
    remark(f"Next: tcmrl-data show {done.address}")


def _print_plan(plan: "PushPlan", prices: list[float | None], *, as_json: bool) -> None:
    amounts = (plan.missing_bytes / 1e9, plan.requests / 1e3)
    costs = [amount * price for amount, price in zip(amounts, prices, strict=True) if price is not None]
    if as_json:
        print_json(dataclasses.asdict(plan) | {"price": sum(costs) if costs else None})
        return
    rows = {
        "root": plan.root[:12],
        "parts": f"{plan.parts:,}, {plan.missing_parts:,} of them to send",
        "size": f"{size(plan.missing_bytes)} to send, with tables",
        "requests": f"{plan.requests:,}, if none is made again",
    }
    if costs:
        rows["price"] = f"{sum(costs):.4g}, by the prices given"
    print_properties(f"Plan: push to {plan.address}", rows)


@click.command()
@click.argument("url")
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@TASKS
@SPLIT
@TIER
@SNAPSHOTS
@output_options
def pull(
    url: str,
    out: Path,
    tasks: str | None,
    split: "Split | None",
    snapshots: str,
    tier: str | None,
    as_json: bool,
) -> None:
    """Copy the dataset at URL into the folder OUT, whole or by a selection.

    Every byte is compared with the digests that the dataset seals before it appears in OUT. A selection
    becomes what `tcmrl-data derive` makes of it, and only its parts are fetched. After an interruption the
    same command goes on.

    \b
    Examples:
      tcmrl-data pull s3://bucket/point-robot data/point-robot
      tcmrl-data pull https://example.org/point-robot data/medium --tier medium
    """
    import tcmrl_data

    done = _in_bytes(
        lambda progress: tcmrl_data.pull_dataset(
            url,
            out,
            tasks=indices(tasks),
            split=split,
            snapshots=snapshots,
            tier=tier,
            progress=progress,
        ),
        stage="pulling",
    )
    if as_json:
        print_json(dataclasses.asdict(done))
        return
    click.echo(
        f"{done.out}: {done.parts:,} parts, {done.fetched_parts:,} of them fetched now, "
        f"{size(done.fetched_bytes)}, root {done.root[:12]}"
    )
    remark(f"Next: tcmrl-data inspect returns {done.out}")


def _in_bytes(work: Callable[[Callable[[int, int], None]], Made], *, stage: str) -> Made:
    """Calls a function that reports its progress in bytes; Ctrl-C says how to go on."""

    def how_to_continue() -> str:
        return f"what arrived is kept; to continue, run `{typed_command()}` again"

    with stopped_by_signals(how_to_continue), StageProgress() as progress:
        return work(lambda done, total: progress.update(stage, done=done / 1e3, total=total / 1e3, unit="kB"))
