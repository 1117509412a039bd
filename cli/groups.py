"""Groups of commands, listed under headings, and the names that went with what to use instead."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import final

import click

SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 80}

GONE = {
    "tcmrl-data plan": "tcmrl-data build ENV --plan",
    "tcmrl-data recipe": "tcmrl-data build ENV --recipe",
    "tcmrl-data status": "tcmrl-data show DATASET",
    "tcmrl-data repair": "tcmrl-data verify DATASET --repair",
    "tcmrl-data gc": "tcmrl-data verify DATASET --clean",
    "tcmrl-data split": "tcmrl-data derive DATASET --folds K, or --episodes 45,5",
    "tcmrl-data rename": "--label when the dataset is made, or tcmrl_data.rename_dataset in Python",
    "tcmrl-data cite": "tcmrl-data card DATASET --format bibtex, or cff",
    "tcmrl-data croissant": "tcmrl-data card DATASET --format croissant",
    "tcmrl-data schema": "the files in docs/schema, or tcmrl_data.describe.schema.json_schema in Python",
    "tcmrl-data completion": 'eval "$(_TCMRL_DATA_COMPLETE=bash_source tcmrl-data)" in ~/.bashrc',
    "tcmrl completion": 'eval "$(_TCMRL_COMPLETE=bash_source tcmrl)" in ~/.bashrc',
    "tcmrl train --steps": "--stop-at",
    "tcmrl experiment --reuse": "--out with the folder of the finished runs, which it keeps",
    "tcmrl-data inspect returns --recompute": "tcmrl-data verify DATASET --deep",
    "tcmrl-data import-policy": "stable_baselines3.SAC.load in Python; no command read its output",
    "tcmrl-data import --task": "--first-task",
    "tcmrl-data import --tasks": "--task-file",
    "tcmrl-data extend --of": "--run (and --as for the name of the new run)",
    "tcmrl-data relabel --of": "--run (and --as for the name of the new run)",
    "tcmrl-data inspect coverage --tasks": "overlap_tasks of tcmrl_data.measure_coverage in Python",
    "tcmrl-data inspect coverage --max-tasks": "overlap_tasks of tcmrl_data.measure_coverage in Python",
    "tcmrl-data inspect coverage --cell": "cell of tcmrl_data.measure_coverage in Python",
    "tcmrl-data inspect rewards --bins": "bins of tcmrl_data.measure_rewards in Python",
    "tcmrl-data inspect transfer --deterministic": "deterministic of tcmrl_data.measure_transfer in Python",
    "tcmrl-data inspect worth --transitions": "transitions of tcmrl_data.measure_worth in Python",
    "tcmrl-data derive --tolerance": "far_from_medium of `tcmrl-data derive --json`",
    "tcmrl-data cache verify": "tcmrl-data cache clear",
    "tcmrl-data derive --strict": "far_from_medium of `tcmrl-data derive --json`",
    "tcmrl-data inspect transfer --tasks": "--max-tasks",
    "tcmrl-data inspect worth --tasks": "--max-tasks",
}
"""Commands and options that went, as they were typed, and what to use instead."""


def gone(name: str) -> str:
    """The error for a name that went."""
    return f"`{name}` is gone; use {GONE[name]}"


@final
class Commands(click.Group):
    """A group whose help lists its commands by section, with whole summaries.

    A name that went is refused with what to use instead, and a path in place of a command with the choice.
    """

    sections: Mapping[str, Sequence[click.Command]]

    def fill(self, sections: Mapping[str, Sequence[click.Command]]) -> None:
        """Adds commands, in the order in which the help lists them.

        Args:
            sections: commands by heading.
        """
        self.sections = sections
        for commands in sections.values():
            for command in commands:
                self.add_command(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, self.commands))
        for heading, commands in self.sections.items():
            with formatter.section(heading):
                rows = [(str(command.name), command.get_short_help_str(200)) for command in commands]
                formatter.write_dl([(name.ljust(width), summary) for name, summary in rows])

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if self.get_command(ctx, args[0]) is None:
            if f"{ctx.command_path} {args[0]}" in GONE:
                raise click.ClickException(gone(f"{ctx.command_path} {args[0]}"))
            if Path(args[0]).exists():
                choices = "|".join(self.commands)
                raise click.UsageError(f"Choose a command: `{ctx.command_path} {choices} {args[0]}`.", ctx)
        return super().resolve_command(ctx, args)
