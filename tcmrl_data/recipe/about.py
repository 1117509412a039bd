"""The `[about]` table: what a dataset says of itself, and the works that it asks to be cited with it."""

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from tcmrl_data.foundation.errors import RecipeError
from tcmrl_data.foundation.records import validate_table

Text = Annotated[str, Field(min_length=1)]

DOI = re.compile(r"10\.\d{4,9}(\.\d+)?/[A-Za-z0-9:/_;\-.()\[\]\\]+")
"""The form that the Citation File Format 1.2 asks of a DOI."""

URL = re.compile(r"https?://[^\s\"<>{}|\\^`]+")


AND = " AND "


def licence_problem(text: str) -> str | None:
    """Why a text is no licence, in words for an error message; None if it is one.

    A licence is an SPDX identifier, a `LicenseRef-NAME`, or several of them joined by `AND` or `OR`.
    """
    for name in re.split(" AND | OR ", text):
        spelled = _spelled(name) or _spelled(name.replace(" ", "-"))
        if spelled != name:
            meant = f"did you mean {spelled}? " if spelled else "see https://spdx.org/licenses. "
            return f"{name[:80]!r} is no SPDX licence; {meant}One of your own is written LicenseRef-NAME"
    return None


def _spelled(name: str) -> str | None:
    """A licence as SPDX spells it; None if SPDX does not know it."""
    from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

    try:
        return canonicalize_license_expression(name)
    except InvalidLicenseExpression:
        return None


def is_listed(name: str) -> bool:
    """Whether a text is one identifier of the SPDX licence list."""
    return _spelled(name) == name and " " not in name and not name.startswith("LicenseRef-")


def joined_licences(licences: list[str]) -> str:
    """The licence of something that is under all the given ones, each named once, in order."""
    return AND.join(sorted({name for licence in licences for name in licence.split(AND)}))


class _Plain(BaseModel):
    """A table that is written without the fields that are not set."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    @model_serializer(mode="wrap")
    def _without_unset(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A manifest of a recipe without these fields has the bytes that it had before the fields existed."""
        return {
            name: value
            for name, value in write(self).items()
            if type(self).model_fields[name].is_required() or value not in (None, [], ())
        }


class Reference(_Plain):
    """A published work.

    Attributes:
        authors: `Family, Given` for people; a name without a comma is that of a group.
        venue: conference or journal.
    """

    title: Text
    authors: tuple[Text, ...] = ()
    year: int | None = Field(default=None, ge=1000, le=9999)
    venue: Text | None = None
    url: Text | None = None
    doi: Text | None = None


class About(_Plain):
    """What a dataset says of itself; no part of any digest.

    Attributes:
        citation: in a sentence, what the environment is from.
        licence: an SPDX expression; datasets of earlier versions and imported ones may say anything.
        authors: who made the data: `Family, Given` for people; a name without a comma is that of a group.
        url: where the dataset is published.
        doi: of the dataset.
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
    """The `[about]` table of a recipe that someone wrote.

    Args:
        values: the table.
        place: of the recipe, for error messages.

    Raises:
        RecipeError: an unknown key, a wrong type, or a licence, DOI or URL that is none.
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
    """What the union of equal data says of itself: all licences, authors, citations and references.

    Args:
        abouts: at least one; the description is the first one's, and so are URL and DOI if all agree.
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
