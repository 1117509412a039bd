"""`tcmrl-data cache`: look at and empty the cache of decoded steps."""

import dataclasses
import datetime

import click

from tcmrl_data.foundation.sizes import size

from .frame import make_table, output_options, print_json, print_table, remark


@click.group()
def cache() -> None:
    """Look at, or empty, the cache of decoded steps that training reads where memory is short.

    It lies in TCMRL_CACHE, or else in tcmrl below the user's cache folder, and takes at most
    TCMRL_CACHE_LIMIT (100G if not set); what was used longest ago goes first.

    \b
    Examples:
      tcmrl-data cache list
      tcmrl-data cache clear
    """


@cache.command(name="list")
@output_options
def list_(as_json: bool, quiet: bool) -> None:
    """List the entries, least recently used first.

    \b
    Example:
      tcmrl-data cache list
    """
    import tcmrl_data

    folder, limit, entries = tcmrl_data.cache_folder(), tcmrl_data.cache_limit(), tcmrl_data.list_cache()
    if as_json:
        rows = [dataclasses.asdict(each) for each in entries]
        print_json({"folder": str(folder), "limit": limit, "entries": rows})
        return
    total = sum(each.bytes for each in entries)
    title = f"{folder}: {size(total)} of {size(limit)}"
    table = make_table(
        title, columns=["key", "environment", "root", "tasks", "size", "used", "state"],
        text=["key", "environment", "root", "used", "state"],
    )  # fmt: skip
    for each in entries:
        used = datetime.datetime.fromtimestamp(each.used).isoformat(" ", "minutes")
        state = "in use" if each.in_use else ""
        table.add_row(
            each.key[:12], each.environment, each.root[:12], str(each.tasks), size(each.bytes), used, state
        )
    print_table(table)


@cache.command()
@output_options
def clear(as_json: bool, quiet: bool) -> None:
    """Remove every entry that no process reads.

    \b
    Example:
      tcmrl-data cache clear
    """
    import tcmrl_data

    removed = tcmrl_data.clear_cache()
    kept = tcmrl_data.list_cache()
    if as_json:
        print_json(
            {"removed": list(map(dataclasses.asdict, removed)), "kept": list(map(dataclasses.asdict, kept))}
        )
        return
    click.echo(f"{len(removed)} entries removed, {size(sum(each.bytes for each in removed))}")
    if kept:
        remark(f"{len(kept)} entries are in use and stay", quiet=quiet)
