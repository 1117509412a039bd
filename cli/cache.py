"""`tcmrl-data cache`: list and clear the cache of decoded steps."""

import dataclasses
import datetime

import click

from tcmrl_data.foundation.sizes import size

from .frame import make_table, output_options, print_json, print_table, remark


@click.group()
def cache() -> None:
    """List or clear the cache of decoded steps.

    Training reads data that do not fit in memory from this cache. The environment variable TCMRL_CACHE
    names its folder (default: tcmrl in the user's cache folder), and TCMRL_CACHE_LIMIT limits its size
    (default: 100G). The least recently used entries are removed first.

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
        rows = [dataclasses.asdict(entry) for entry in entries]
        print_json({"folder": str(folder), "limit": limit, "entries": rows})
        return
    total = sum(entry.bytes for entry in entries)
    title = f"{folder}: {size(total)} of {size(limit)}"
    table = make_table(
        title, columns=["key", "environment", "root", "tasks", "size", "used", "state"],
        text=["key", "environment", "root", "used", "state"],
    )  # fmt: skip
    for entry in entries:
        used = datetime.datetime.fromtimestamp(entry.used).isoformat(" ", "minutes")
        table.add_row(
            entry.key[:12],
            entry.environment,
            entry.root[:12],
            str(entry.tasks),
            size(entry.bytes),
            used,
            "in use" if entry.in_use else "",
        )
    print_table(table)


@cache.command()
@output_options
def clear(as_json: bool, quiet: bool) -> None:
    """Remove all entries that no process is using.

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
    click.echo(f"{len(removed)} entries removed, {size(sum(entry.bytes for entry in removed))}")
    if kept:
        remark(f"{len(kept)} entries kept, because they are in use", quiet=quiet)
