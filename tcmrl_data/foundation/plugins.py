"""Plug-ins are files: what a folder holds is what there is."""

import difflib
import importlib
import pkgutil
from collections.abc import Iterable
from types import ModuleType

from tcmrl_data.foundation.errors import UnknownNameError


def modules(package: str) -> list[ModuleType]:
    """Imports every module of a plug-in package, sorted by file name.

    Plug-in modules import heavy libraries inside functions, so that listing them stays cheap.
    """
    paths = importlib.import_module(package).__path__
    names = sorted(info.name for info in pkgutil.iter_modules(paths) if not info.name.startswith("_"))
    return [importlib.import_module(f"{package}.{name}") for name in names]


def plugin(package: str, kind: str, name: str) -> ModuleType:
    """The module of `package` whose NAME is `name`.

    Raises:
        UnknownNameError: no such plug-in; the message lists the nearest names.
    """
    found = {module.NAME: module for module in modules(package) if hasattr(module, "NAME")}
    if name not in found:
        raise unknown_name(kind, name, found)
    return found[name]


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """An error that names what was asked for and what comes nearest."""
    names = sorted(known)
    nearest = difflib.get_close_matches(name, names, n=3, cutoff=0.4) or names[:8]
    return UnknownNameError(f"unknown {kind} {name!r}; did you mean {', '.join(nearest)}?")
