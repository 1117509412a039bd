"""`tcmrl-data cache`: list, check and clear the cache of decoded steps."""

import dataclasses
import datetime

import click

from tcmrl_data.foundation.machine import size

from .frame import fail_incomplete, make_table, output_options, print_json, print_table, remark


@click.group()
def cache() -> None:
    """List, check or clear the cache of decoded steps.

    Training reads data that do not fit in memory from this cache. The environment variable TCMRL_CACHE
    names its folder (default: tcmrl in the user's cache folder), and TCMRL_CACHE_LIMIT limits its size
    (default: 100G). The least recently used entries are removed first. Several runs may use the same
    entry: the first decodes it while the others wait.

    \b
    Examples:
      tcmrl-data cache list
      tcmrl-data cache verify
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
        title, columns=["key", "environment", "dataset", "tasks", "parts", "size", "used", "state"],
        text=["key", "environment", "dataset", "used", "state"],
    )  # fmt: skip
    for entry in entries:
        used = datetime.datetime.fromtimestamp(entry.used).isoformat(" ", "minutes")
        table.add_row(
            entry.key[:12],
            entry.environment,
            entry.dataset,
            str(entry.tasks),
            str(entry.parts),
            size(entry.bytes),
            used,
            "in use" if entry.in_use else "",
        )
    print_table(table)


@cache.command()
@output_options
def verify(as_json: bool, quiet: bool) -> None:
    """Hash all entries, and remove those that are damaged.

    A run that opens an entry hashes it if it takes up to 1 GB; this command hashes larger entries too. The
    exit code is 1 if an entry is damaged; the next run that needs it decodes it again.

    \b
    Example:
      tcmrl-data cache verify
    """
    import tcmrl_data

    checked = tcmrl_data.list_cache()
    damaged = tcmrl_data.verify_cache()
    kept = {entry.key for entry in tcmrl_data.list_cache()}
    if as_json:
        rows = [
            dataclasses.asdict(entry) | {"problem": problem, "removed": entry.key not in kept}
            for entry, problem in damaged
        ]
        print_json({"checked": len(checked), "damaged": rows})
    else:
        for entry, problem in damaged:
            state = "kept, because it is in use" if entry.key in kept else "removed"
            click.echo(f"{entry.key[:12]}: {problem}; {state}")
        click.echo(
            f"{len(checked)} entries, {size(sum(entry.bytes for entry in checked))}: {len(damaged)} damaged"
        )
    if damaged:
        fail_incomplete(f"{len(damaged)} of {len(checked)} entries are damaged")


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
