"""Options that several commands take alike, and the types of their values."""

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import click
from click.shell_completion import CompletionItem

from tcmrl_data.recipe import PROFILES

if TYPE_CHECKING:
    from tcmrl_data import Address

TIERS = ("random", "medium", "medium-replay", "expert", "medium-expert", "random-expert", "mixed")
ALL_PROTOCOLS = "all"


@final
class PluginName(click.ParamType):  # type: ignore[type-arg] # generic in newer versions of click only
    """A name that an installed package declares in an entry point group.

    Help texts and checks read the declared names when they need them, without importing a plug-in.

    Args:
        group: the entry point group, such as `tcmrl.engines`.
        noun: kind of plug-in, for error messages.
        others: further values of the option.
    """

    name = "name"

    def __init__(self, group: str, noun: str, *, others: Sequence[str] = ()) -> None:
        self._group, self._noun, self._others = group, noun, others

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"[{'|'.join(self.known())}]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        from tcmrl_data.foundation.plugins import unknown_name

        if value not in self.known():
            raise unknown_name(self._noun, value, self.known())
        return str(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(name) for name in _starting(self.known(), incomplete)]

    def known(self) -> list[str]:
        """The names that can be given."""
        from tcmrl_data.foundation.plugins import declared_names

        return [*declared_names(self._group), *self._others]


@final
class ManyNames(click.Option):
    """An option whose names are too many for the column of its name; its help lists them."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        assert isinstance(self.type, PluginName)
        record = super().get_help_record(ctx)
        return record and (record[0], f"{record[1]} One of {', '.join(self.type.known())}.")


BEHAVIOR_NAME = PluginName("tcmrl.behavior", "behavior source")
ENGINE_NAME = PluginName("tcmrl.engines", "engine")
PROTOCOL_NAME = PluginName("tcmrl.protocols", "protocol")
PROTOCOL_OR_ALL = PluginName("tcmrl.protocols", "protocol", others=[ALL_PROTOCOLS])
FORMAT_NAME = PluginName("tcmrl.formats", "format")
READER_NAME = PluginName("tcmrl.readers", "import format")
ALGORITHM_NAME = PluginName("tcmrl.algorithms", "algorithm")


@final
class WrittenFile(click.Path):
    """A file to write, whose folder exists: a typing error in its name makes no folder."""

    def __init__(self) -> None:
        super().__init__(path_type=Path, dir_okay=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        file = Path(os.fspath(value))
        super().convert(file, param, ctx)
        if not file.parent.is_dir():
            name = param.opts[0] if param else "--out"
            raise click.ClickException(f"{name} {file}: the folder {file.parent} does not exist; create it")
        return file


@final
class DatasetPath(click.Path):
    """The folder of a dataset, a view's file, or an address, which is text."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if isinstance(value, str) and "://" in value else super().convert(value, param, ctx)


DATASET_PATH = DatasetPath(path_type=Path)
PATH = click.Path(path_type=Path)
FILE = WrittenFile()
COUNT = click.IntRange(min=1)
INDEX = click.IntRange(min=0)


DATASET = click.argument("dataset", type=DATASET_PATH)
OUT = click.option("--out", type=PATH, metavar="FOLDER", help="Folder to create.")
NEW_DATASET = click.option("--out", type=PATH, required=True, metavar="FOLDER", help="Folder to create.")
LABEL = click.option("--label", help="The new dataset's own name.")
DRY_RUN = click.option("--dry-run", is_flag=True, help="Only say what would be done; write nothing.")
WORKERS = click.option(
    "--workers", type=COUNT, show_default="all cores", help="Number of processes that work at once."
)
TASKS = click.option("--tasks", metavar="LIST", help="Only these tasks, such as 0-9,12.")
SPLIT = click.option("--split", type=click.Choice(["train", "test"]), help="Only tasks of this split.")
TIER = click.option("--tier", type=click.Choice(TIERS), metavar="NAME", help=f"Tier: {', '.join(TIERS)}.")
SNAPSHOTS = click.option(
    "--snapshots",
    default="all",
    show_default=True,
    metavar="RULE",
    help="Instead of a tier: all, last, steps>=N, or return>=Q with a quantile Q.",
)
PLOT = click.option("--plot", type=FILE, metavar="FILE", help="Also draw a .png, .svg or .pdf file.")
TRAINING_PROFILE = click.option(
    "--profile",
    type=click.Choice(PROFILES),
    show_default="the dataset's",
    help="Profile of the training settings.",
)
TRAINING_SETTINGS = click.option(
    "--set",
    "overrides",
    metavar="SECTION.KEY=VALUE",
    multiple=True,
    help="Override a training setting; repeatable.",
)
DEVICE = click.option("--device", default="cpu", show_default=True, help="PyTorch device: cpu, cuda, …")


def allow_only(context: click.Context, mode: str, *names: str) -> None:
    """Refuses typed options that mean nothing beside another one.

    Args:
        context: of the command.
        mode: the other option.
        names: parameters that go with it.
    """
    allowed = {*names, "as_json", "quiet"}
    typed = click.core.ParameterSource.COMMANDLINE
    for option in context.command.params:
        name = str(option.name)
        is_other = isinstance(option, click.Option) and name not in allowed and option.opts[0] != mode
        if is_other and context.get_parameter_source(name) == typed:
            raise click.UsageError(f"{option.opts[0]} does not go with {mode}; omit one of them.")


def indices(text: str | None, option: str = "--tasks") -> list[int] | None:
    """The indices in a LIST, such as 0-9,12."""
    from tcmrl_data import MAX_TASKS, parse_indices

    return None if text is None else parse_indices(text, MAX_TASKS, option=option)


def beside(place: "Path | Address", ending: str) -> Path:
    """The path of something made of a dataset: beside it, or in the current folder if it is at an address."""
    if not isinstance(place, Path):
        return Path(f"{place.name}{ending}")
    place = place if place.name not in ("", "..") else place.resolve()
    return place.with_name(f"{place.stem if place.is_file() else place.name}{ending}")


def names_or_files(known: Callable[[], Iterable[str]]) -> Callable[..., list[CompletionItem]]:
    """What completes an argument that is a name or a file."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        names = [CompletionItem(name) for name in _starting(known(), incomplete)]
        return names or [CompletionItem(incomplete, type="file")]

    return complete


def _starting(names: Iterable[str], incomplete: str) -> list[str]:
    return sorted(name for name in names if name.startswith(incomplete))
