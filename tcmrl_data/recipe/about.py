"""The `[about]` table: a dataset's description, licence and authors, and the works to cite with it."""

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from tcmrl_data.foundation.errors import RecipeError
from tcmrl_data.foundation.records import validate_table

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
