"""`tcmrl-data recipe`: the values that `--set` can change."""

import dataclasses
import json
from typing import Any

import click

from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.recipe import Profile

from .building import profile_option, recipe_argument, set_option
from .frame import FOLDED_WIDTH, make_table, output_options, print_json, print_table


@click.command()
@recipe_argument
@profile_option
@set_option
@output_options
def recipe(
    name_or_file: str, profile: Profile, overrides: tuple[str, ...], as_json: bool, quiet: bool
) -> None:
    """Show the values of a recipe and where they come from, by the keys that --set takes.

    The recipe is that of an environment ENV, or a FILE of your own, which ends in .toml. Sources are the
    comments in the recipe's file.

    \b
    Examples:
      tcmrl-data recipe point-robot --profile quick
      tcmrl-data recipe my-recipe.toml --set rollouts.episodes=20 --json
    """
    import tcmrl_data

    found = tcmrl_data.recipe_values(name_or_file, profile=profile, overrides=overrides)
    if as_json:
        print_json(dataclasses.asdict(found))
        return
    title = f"Recipe of {found.environment}, profile {found.profile}"
    table = make_table(title, columns=["key", "value", "source"], text=["key"], long_text=["value", "source"])
    texts = [_value_text(value.value) for value in found.values]
    numbers = [word for text in texts for word in text.split() if not word[0].isalpha()]
    table.columns[1].min_width = max(FOLDED_WIDTH, *map(len, numbers))  # so that no number is folded
    for value, text in zip(found.values, texts, strict=True):
        table.add_row(value.key, text, printable(value.source))
    print_table(table)


def _value_text(value: Any) -> str:
    """A value as `--set` takes it; a dash where it is not set."""
    if value is None:
        return "–"
    return printable(value) if isinstance(value, str) else json.dumps(value, default=str)
