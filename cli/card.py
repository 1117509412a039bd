"""`tcmrl-data card`, `cite`, `croissant` and `schema`: a dataset described for people and programs."""

from pathlib import Path
from typing import cast, get_args

import click

from tcmrl_data.foundation.plain_files import printable

from .frame import print_json, remark
from .places import DATASET_PATH

FORMATS = ("bibtex", "cff", "text")
KINDS = ("manifest", "part", "recipe")

dataset_argument = click.argument("dataset", type=DATASET_PATH)
quiet_option = click.option("--quiet", is_flag=True, help="Print only results and errors.")


@click.command()
@dataset_argument
@click.option(
    "--format",
    "form",
    type=click.Choice(FORMATS),
    default="bibtex",
    show_default=True,
    help="BibTeX, Citation File Format 1.2, or sentences.",
)
def cite(dataset: Path, form: str) -> None:
    """Print how to cite DATASET, the works that its environment is from, and this software.

    Authors, URL, DOI and references are those of [about] in the recipe. The version is the beginning of the
    root, so that equal data have an equal version.

    \b
    Examples:
      tcmrl-data cite data/point-robot
      tcmrl-data cite data/point-robot --format cff > CITATION.cff
    """
    import tcmrl_data
    from tcmrl_data.describe.cite import CitationFormat, citation_text

    assert form in get_args(CitationFormat)
    manifest = tcmrl_data.open_dataset(dataset).manifest
    click.echo(citation_text(manifest, cast(CitationFormat, form)), nl=False)


@click.command()
@click.argument("kind", type=click.Choice(KINDS))
def schema(kind: str) -> None:
    """Print the JSON Schema (2020-12) of a dataset's manifest, part or resolved recipe.

    \b
    Example:
      tcmrl-data schema manifest > manifest.schema.json
    """
    from tcmrl_data.describe.schema import SchemaKind, json_schema

    print_json(json_schema(cast(SchemaKind, kind)))


@click.command()
@dataset_argument
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    show_default="the dataset",
    help="Folder to write to.",
)
def croissant(dataset: Path, out: Path | None) -> None:
    """Write croissant.json (Croissant 1.0) and the two tables that it describes.

    Programs that search for data read it. Its records are a line per task and a line per part; the episodes
    stay in the archives that it names.

    \b
    Example:
      tcmrl-data croissant data/point-robot
    """
    import tcmrl_data
    from tcmrl_data.describe.croissant import write_croissant

    opened = tcmrl_data.open_dataset(dataset)
    if out is None and opened.path != opened.folder:
        raise click.UsageError(f"{dataset} is a view, which has no folder; name one by --out")
    file = write_croissant(opened, out)
    click.echo(f"{printable(str(file))}: {len(opened.tasks):,} tasks, {len(opened.parts):,} parts")


@click.command()
@dataset_argument
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    show_default="standard output",
    help="File to write, such as README.md; what you wrote between its marks stays.",
)
@quiet_option
def card(dataset: Path, out: Path | None, quiet: bool) -> None:
    """Write the README of DATASET: what it is, how it was made, returns, tiers, limits, licence and citation.

    It begins with front matter that hubs of datasets read.

    \b
    Examples:
      tcmrl-data card data/point-robot
      tcmrl-data card data/point-robot --out data/point-robot/README.md
    """
    import tcmrl_data
    from tcmrl_data.describe.card import BEGIN, dataset_card, write_card

    opened = tcmrl_data.open_dataset(dataset)
    if out is None:
        click.echo(dataset_card(opened), nl=False)
        return
    write_card(opened, out)
    click.echo(f"{printable(str(out))} written")
    remark(f"what you write below {BEGIN!r} stays when it is written again", quiet=quiet)
