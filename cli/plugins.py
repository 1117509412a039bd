"""Options that take the name of a plug-in."""

from typing import Any, final

import click


@final
class PluginName(click.ParamType):  # type: ignore[type-arg] # generic in newer versions of click only
    """A name that an installed package declares in an entry point group.

    Help and check read the declared names when they are needed, and import no plug-in.

    Args:
        group: the entry point group, such as `tcmrl.engines`.
        noun: what an error message calls a plug-in of this group.
    """

    name = "name"

    def __init__(self, group: str, noun: str) -> None:
        self._group, self._noun = group, noun

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        from tcmrl_data.foundation.plugins import declared_names

        return f"[{'|'.join(declared_names(self._group))}]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        from tcmrl_data.foundation.plugins import declared_names, unknown_name

        known = declared_names(self._group)
        if value not in known:
            raise unknown_name(self._noun, value, known)
        return str(value)


BEHAVIOR = PluginName("tcmrl.behavior", "behavior source")
ENGINE = PluginName("tcmrl.engines", "engine")
FORMAT = PluginName("tcmrl.formats", "format")
