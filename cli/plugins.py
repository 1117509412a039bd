"""Types of options whose values are names of plug-ins."""

from collections.abc import Sequence
from typing import Any, final

import click
from click.shell_completion import CompletionItem


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
        return f"[{'|'.join(self._known())}]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        from tcmrl_data.foundation.plugins import unknown_name

        if value not in self._known():
            raise unknown_name(self._noun, value, self._known())
        return str(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(name) for name in self._known() if name.startswith(incomplete)]

    def _known(self) -> list[str]:
        from tcmrl_data.foundation.plugins import declared_names

        return [*declared_names(self._group), *self._others]


ALL_PROTOCOLS = "all"

BEHAVIOR = PluginName("tcmrl.behavior", "behavior source")
ENGINE = PluginName("tcmrl.engines", "engine")
PROTOCOL_NAME = PluginName("tcmrl.protocols", "protocol")
PROTOCOL = PluginName("tcmrl.protocols", "protocol", others=[ALL_PROTOCOLS])
FORMAT = PluginName("tcmrl.formats", "format")
READER = PluginName("tcmrl.readers", "import format")
ALGORITHM = PluginName("tcmrl.algorithms", "algorithm")
