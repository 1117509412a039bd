"""Recipe files: TOML files, parsed and merged but not yet validated; and their `[about]` table."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.envs.own import declare_file
from tcmrl_data.foundation.errors import RecipeError, UnknownNameError
from tcmrl_data.foundation.records import nearest, validate_table
from tcmrl_data.recipe import PROFILES, Profile

Text = Annotated[str, Field(min_length=1)]

DOI = re.compile(r"10\.\d{4,9}(\.\d+)?/[A-Za-z0-9:/_;\-.()\[\]\\]+")
"""A DOI in the form that the Citation File Format 1.2 requires."""

URL = re.compile(r"https?://[^\s\"<>{}|\\^`]+")


AND = " AND "


def licence_problem(text: str) -> str | None:
    """Why a text is not a licence, for an error message; None if it is one.

    A licence is an SPDX identifier, a `LicenseRef-NAME`, or several of them joined by `AND` or `OR`.
    """
    for name in re.split(" AND | OR ", text):
        spelled = _spelled(name) or _spelled(name.replace(" ", "-"))
        if spelled != name:
            meant = f"did you mean {spelled}? " if spelled else "see https://spdx.org/licenses. "
            return f"{name[:80]!r} is no SPDX licence; {meant}One of your own is written LicenseRef-NAME"
    return None


def _spelled(name: str) -> str | None:
    """A licence in SPDX's spelling; None if SPDX does not know it."""
    from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

    try:
        return canonicalize_license_expression(name)
    except InvalidLicenseExpression:
        return None


def is_listed(name: str) -> bool:
    """Whether a text is one identifier of the SPDX licence list."""
    return _spelled(name) == name and " " not in name and not name.startswith("LicenseRef-")


def joined_licences(licences: list[str]) -> str:
    """The licence of something to which all given licences apply; sorted, each named once."""
    return AND.join(sorted({name for licence in licences for name in licence.split(AND)}))


class _Plain(BaseModel):
    """A table that is written without its unset fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @model_serializer(mode="wrap")
    def _without_unset(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Keeps the bytes of manifests whose recipe does not set fields that were added later."""
        return {
            name: value
            for name, value in write(self).items()
            if type(self).model_fields[name].is_required() or value not in (None, [], ())
        }


class Reference(_Plain):
    """A published work.

    Attributes:
        authors: people as `Family, Given`; a name without a comma is a group.
        venue: conference or journal.
    """

    title: Text
    authors: tuple[Text, ...] = ()
    year: int | None = Field(default=None, ge=1000, le=9999)
    venue: Text | None = None
    url: Text | None = None
    doi: Text | None = None


class About(_Plain):
    """Description of a dataset, which is not part of any digest.

    Attributes:
        citation: origin of the environment, in a sentence.
        licence: an SPDX expression; any text in imported datasets and in those of earlier versions.
        authors: who made the data; people as `Family, Given`, a name without a comma is a group.
        url: where the dataset is published.
        doi: DOI of the dataset.
        references: works to be cited with the dataset.
    """

    description: str
    citation: str
    licence: str
    authors: tuple[Text, ...] = ()
    url: Text | None = None
    doi: Text | None = None
    references: tuple[Reference, ...] = ()


def read_about(values: Mapping[str, Any], place: str) -> About:
    """Validates the `[about]` table of a recipe; error messages begin with `place`.

    Raises:
        RecipeError: an unknown key, a wrong type, or an invalid licence, DOI or URL.
    """
    about = validate_table(About, values, place=place, error=RecipeError, table="about")
    problem = licence_problem(about.licence)
    if problem:
        raise RecipeError(f"{place}: about.licence: {problem}")
    works: dict[str, About | Reference] = {"about": about}
    works |= {f"about.references.{index}": work for index, work in enumerate(about.references)}
    for name, work in works.items():
        if work.doi is not None and not DOI.fullmatch(work.doi):
            raise RecipeError(f"{place}: {name}.doi: {work.doi!r} is no DOI; write it as 10.1000/182")
        if work.url is not None and not URL.fullmatch(work.url):
            raise RecipeError(f"{place}: {name}.url: {work.url!r} is no URL; write it as https://example.org")
    return about


def merged_about(abouts: Sequence[About]) -> About:
    """The table of a union of datasets: all their licences, authors, citations and references.

    The description is that of the first dataset. URL and DOI are kept if they are the same in all.
    """
    first = abouts[0]
    if all(about == first for about in abouts):
        return first
    return first.model_copy(
        update={
            "citation": "; ".join(dict.fromkeys(about.citation for about in abouts)),
            "licence": joined_licences([about.licence for about in abouts]),
            "authors": tuple(dict.fromkeys(name for about in abouts for name in about.authors)),
            "url": first.url if len({about.url for about in abouts}) == 1 else None,
            "doi": first.doi if len({about.doi for about in abouts}) == 1 else None,
            "references": tuple(dict.fromkeys(work for about in abouts for work in about.references)),
        }
    )


RECIPE_SCHEMA = 1
TABLES = ("about", "behavior", "build", "environment", "rollouts", "training")
SUFFIX = ".toml"
"""Ending of a recipe file's name, and of no environment's name."""


@dataclass(frozen=True)
class RecipeDocument:
    """The content of a recipe file, for one environment.

    Attributes:
        place: the document's name in error messages.
        content: the file's tables, including variants and profiles.
    """

    environment: str
    place: str
    text: str
    content: Mapping[str, Any]

    @property
    def profiles(self) -> list[Profile]:
        """The profiles that the document has."""
        return [name for name in PROFILES if name == "paper" or name in self.content.get("profiles", {})]

    def layers(self, profile: Profile) -> list[tuple[str, ...]]:
        """Paths of the tables that are merged for a profile; later ones override earlier ones."""
        return [(), ("variants", self.environment), ("profiles", profile)]

    def tables(self, profile: Profile, overrides: Sequence[str] = ()) -> dict[str, Any]:
        """The document's tables, overridden by the variant, then the profile, then the overrides.

        Tables that it lacks are empty.

        Raises:
            RecipeError: the profile is missing, a table is unknown, a value stands where
                a table should be, or an override is invalid (see `apply_overrides`).
        """
        if profile not in self.profiles:
            raise RecipeError(
                f"{self.place} has no profile {profile!r}; known are {', '.join(self.profiles)}"
            )
        tables: dict[str, Any] = {}
        for path in self.layers(profile):
            tables = merge_tables(tables, _table_at(self.content, path))
        tables = {name: table for name, table in tables.items() if name not in ("profiles", "variants")}
        tables = apply_overrides(tables, overrides)
        place = f"{self.place}, profile {profile!r}"
        for name, table in tables.items():
            if name not in TABLES:
                raise RecipeError(f"{place}: unknown table {name!r}; {nearest(name, TABLES)}")
            if not isinstance(table, Mapping):
                raise RecipeError(f"{place}: {name} is a value; write it as a table [{name}]")
        return {name: tables.get(name, {}) for name in TABLES}


def open_recipe(name_or_file: str | Path) -> RecipeDocument:
    """The recipe of an environment, or a recipe file.

    Args:
        name_or_file: an environment, such as `point-robot`, the path of a file whose name ends in `.toml`,
            or a class in a file of yours, such as `my_env.py:MyEnv`, whose recipe stands beside it.

    Raises:
        PluginError: the file of yours cannot be imported, or holds no such environment.
        RecipeError: the file does not exist or is not a recipe.
    """
    text = str(name_or_file)
    if text.endswith(SUFFIX):
        return _open_file(Path(text))
    if ".py:" in text:
        text = declare_file(text)
    file = ENVIRONMENTS.get(text).recipe_file(text)
    if not file.is_file():
        raise RecipeError(f"environment {text!r} has no recipe; write {file} (`tcmrl-data new` writes one)")
    place = f"recipe of {text!r}"
    content = file.read_text(encoding="utf-8")
    return RecipeDocument(text, place, content, _parse(content, place))


def _open_file(file: Path) -> RecipeDocument:
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RecipeError(f"{file} does not exist; name a recipe file or an environment") from None
    except OSError as error:
        raise RecipeError(f"{file} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise RecipeError(f"{file} is no TOML: {error.reason} at byte {error.start}") from None
    content = _parse(text, str(file))
    table = content.get("environment")
    name = table.get("name") if isinstance(table, Mapping) else None
    if not isinstance(name, str):
        raise RecipeError(f'{file}: [environment] has no name; write for example name = "point-robot"')
    try:
        ENVIRONMENTS.get(name)
    except UnknownNameError as error:
        raise UnknownNameError(f"{file}: {error}") from None
    return RecipeDocument(name, str(file), text, content)


def _parse(text: str, place: str) -> dict[str, Any]:
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"{place} is no TOML: {error}") from None
    schema = document.pop("schema", None)
    if schema != RECIPE_SCHEMA:
        raise RecipeError(f"{place}: schema {schema!r} is not {RECIPE_SCHEMA}")
    for group in ("profiles", "variants"):
        members = document.get(group, {})
        if not isinstance(members, Mapping) or not all(isinstance(one, Mapping) for one in members.values()):
            raise RecipeError(f"{place}: {group} holds a value; write tables such as [{group}.NAME.rollouts]")
    unknown = sorted(set(document.get("profiles", {})) - set(PROFILES))
    if unknown:
        raise RecipeError(f"{place}: unknown profile {unknown[0]!r}; {nearest(unknown[0], PROFILES)}")
    return document


def apply_overrides(table: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """A copy of nested tables with `section.key=value` texts applied; values are read as TOML.

    Raises:
        RecipeError: a text has no `=`, or its section is a value.
    """
    result = merge_tables({}, table)
    for text in overrides:
        keys, value = read_override(text)
        section = result
        for key in keys[:-1]:
            section = section.setdefault(key, {})
            if not isinstance(section, dict):
                raise RecipeError(f"--set {text!r}: {key!r} is a value, not a section")
        section[keys[-1]] = value
    return result


def read_override(text: str) -> tuple[list[str], Any]:
    """The keys and the value of a text `section.key=value`."""
    path, equals, value = text.partition("=")
    keys = path.strip().split(".")
    if not equals or len(keys) < 2 or not all(keys):
        raise RecipeError(f"--set {text!r}: expected section.key=value, such as rollouts.episodes=10")
    try:
        return keys, tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return keys, value.strip()  # an unquoted word is a string


def merge_tables(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """A deep merge: tables merge, everything else is replaced."""
    result = {
        key: merge_tables({}, value) if isinstance(value, Mapping) else value for key, value in base.items()
    }
    for key, value in top.items():
        below = result.get(key)
        if isinstance(value, Mapping):
            result[key] = merge_tables(below if isinstance(below, Mapping) else {}, value)
        else:
            result[key] = value
    return result


def _table_at(content: Mapping[str, Any], path: Sequence[str]) -> Mapping[str, Any]:
    for key in path:
        content = content.get(key, {})
    return content
