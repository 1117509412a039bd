"""Plug-ins: classes that installed packages declare as entry points."""

import difflib
import functools
import inspect
import sys
from collections.abc import Iterable
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from typing import Generic, TypeVar

from tcmrl_data.foundation.errors import MissingPackageError, PluginError, UnknownNameError

Kind = TypeVar("Kind")


class Registry(Generic[Kind]):
    """The plug-ins of one kind, by name; listing the names imports no plug-in.

    Args:
        group: the entry point group, such as `tcmrl.engines`.
        noun: the word for a plug-in of this kind in error messages.
        base: base class of all plug-ins of this kind.

    Example:
        >>> from tcmrl_data.engine.base import ENGINES
        >>> ENGINES.get("local").name
        'local'
    """

    def __init__(self, group: str, noun: str, base: type[Kind]) -> None:
        self.group, self.noun, self.base = group, noun, base

    def names(self) -> list[str]:
        """The declared names, sorted, including those of broken plug-ins."""
        return declared_names(self.group)

    def get(self, name: str) -> type[Kind]:
        """The class with the given name; imports no other plug-in of the group.

        Raises:
            UnknownNameError: no package declares the name; the message lists similar names.
            MissingPackageError: one of ours, and a package is not installed that reading does without.
            PluginError: the plug-in cannot be imported, is not a usable subclass of the base class, or two
                packages declare its name.
        """
        entries = self._entries()
        if name not in entries:
            raise unknown_name(self.noun, name, entries)
        entry, *others = entries[name]
        if others:
            packages = " and ".join(sorted(_package(declared) for declared in entries[name]))
            raise PluginError(f"{self.noun} {name!r} is declared by {packages}; uninstall one of them")
        problem = f"{self.noun} {name!r} of package {_package(entry)} is broken"
        remedy = "repair or uninstall the package"
        try:
            found = entry.load()
            defect = self.defect(found, name)
        except (Exception, SystemExit) as error:  # importing a module may raise anything
            if isinstance(error, ModuleNotFoundError) and _package(entry) == "'tcmrl'":
                raise MissingPackageError(f"{self.noun} {name!r} {missing_package(error)}") from None
            raise PluginError(f"{problem}: {one_line_error(error)}; {remedy}") from error
        if defect:
            raise PluginError(f"{problem}: {entry.value} {defect}; {remedy}")
        plugin: type[Kind] = found
        return plugin

    def provider(self, name: str) -> str | None:
        """The distribution that declares a plug-in; None if no installed one does."""
        distributions = [entry.dist for entry in self._entries().get(name, []) if entry.dist]
        return distributions[0].name if distributions else None

    def working(self) -> dict[str, type[Kind]]:
        """The class of every working plug-in, by name; imports all plug-ins of this kind."""
        return self._load_all()[0]

    def broken(self) -> dict[str, str]:
        """The error message of every broken plug-in, by name; imports all plug-ins of this kind."""
        return self._load_all()[1]

    def _load_all(self) -> tuple[dict[str, type[Kind]], dict[str, str]]:
        working, broken = {}, {}
        for name in self.names():
            try:
                working[name] = Registry.get(self, name)
            except PluginError as error:
                broken[name] = str(error)
        return working, broken

    def _entries(self) -> dict[str, list[EntryPoint]]:
        found: dict[str, list[EntryPoint]] = {}
        for entry in _declared(self.group, tuple(sys.path)):
            found.setdefault(entry.name, []).append(entry)
        return found

    def defect(self, found: object, name: str) -> str | None:
        """Why an imported object cannot be the plug-in with the given name; None if it can."""
        if not (isinstance(found, type) and issubclass(found, self.base)):
            return f"is no subclass of {self.base.__module__}.{self.base.__qualname__}"
        if inspect.isabstract(found):
            missing: frozenset[str] = getattr(found, "__abstractmethods__", frozenset())
            return f"does not define {', '.join(sorted(missing))}"
        own_name = getattr(found, "name", None)
        return None if own_name == name else f"has the name {own_name!r}, but is declared as {name!r}"


@functools.lru_cache
def _declared(group: str, path: tuple[str, ...]) -> EntryPoints:
    """A group's entry points on `sys.path`; cached, because reading them takes about 20 ms."""
    return entry_points(group=group)


def declared_names(group: str) -> list[str]:
    """The names that installed packages declare in an entry point group, sorted; imports no plug-in."""
    return sorted({entry.name for entry in _declared(group, tuple(sys.path))})


def check_declared(group: str, noun: str, name: str) -> None:
    """Checks that an installed package declares a name in an entry point group; imports no plug-in.

    For settings classes, which may not import the base class of the plug-ins that they name.

    Raises:
        UnknownNameError: no package declares the name; the message lists similar names.
    """
    names = declared_names(group)
    if name not in names:
        raise unknown_name(noun, name, names)


def _package(entry: EntryPoint) -> str:
    return repr(entry.dist.name if entry.dist else "unknown")


def missing_package(error: ModuleNotFoundError) -> str:
    """What to do where only the packages are installed that reading needs."""
    return (
        f"needs the package {error.name}, which is not installed; `pip install tcmrl` brings all, "
        "requirements-reader.txt only what reading needs"
    )


def one_line_error(error: BaseException) -> str:
    """An exception's type and message in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


MOST_NAMES = 20
"""Names that an error lists where none is similar."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """An error that contains the unknown name and similar known names."""
    names = sorted(known)
    if not names:
        return UnknownNameError(f"unknown {kind} {name!r}; none is installed, install tcmrl again")
    nearest = difflib.get_close_matches(name.lower(), names, n=3, cutoff=0.4)
    if nearest:
        return UnknownNameError(f"unknown {kind} {name!r}; did you mean {', '.join(nearest)}?")
    shown = names if len(names) <= MOST_NAMES else [*names[:MOST_NAMES], "…"]
    return UnknownNameError(f"unknown {kind} {name!r}; there are {', '.join(shown)}")
