"""How to cite a dataset, the works that it is from, and this software: BibTeX or CFF."""

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Literal

import yaml

from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.recipe.document import AND, Reference, is_listed
from tcmrl_data.recipe.recipe import load_recipe
from tcmrl_data.store.manifest import Manifest

CitationFormat = Literal["bibtex", "cff"]

UNKNOWN_AUTHORS = ("unknown",)
"""Of a work that names none; the Citation File Format asks for at least one."""

SOFTWARE_AUTHORS = ("the tcmrl authors",)
SOFTWARE_TITLE = "tcmrl: meta-datasets for offline meta-reinforcement learning"

_BIBTEX_SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"} | {
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
}


@dataclass(frozen=True)
class Citation:
    """A dataset as a work to be cited, and the works to be cited with it.

    Attributes:
        version: the first twelve digits of the dataset's root: equal data, equal version.
    """

    name: str
    title: str
    authors: tuple[str, ...]
    version: str
    licences: tuple[str, ...]
    url: str | None
    doi: str | None
    references: tuple[Reference, ...]
    software: str


def citation_of(manifest: Manifest) -> Citation:
    """The citation of a dataset: authors and references are those of all its runs."""
    abouts = [run.recipe.about for run in manifest.runs if run.recipe is not None]
    authors = tuple(dict.fromkeys(name for about in abouts for name in about.authors))
    name = manifest.label or manifest.name
    of = "" if manifest.label is None else f"{manifest.name}, "
    return Citation(
        name=name,
        title=f"{name}: {of}a dataset for offline meta-reinforcement learning",
        authors=authors or UNKNOWN_AUTHORS,
        version=manifest.root[:12],
        licences=manifest.licences,
        url=manifest.recipe.about.url,
        doi=manifest.recipe.about.doi,
        references=_works_of(manifest),
        software=version("tcmrl"),
    )


def _works_of(manifest: Manifest) -> tuple[Reference, ...]:
    """The works that the data are from: those of all runs.

    A dataset that names none, such as one of an earlier version, takes those of the installed recipe.
    """
    named = [work for run in manifest.runs if run.recipe is not None for work in run.recipe.about.references]
    if not named:
        with contextlib.suppress(TcmrlError):
            named = list(load_recipe(manifest.name).about.references)
    return tuple(dict.fromkeys(named))


def citation_text(manifest: Manifest, form: CitationFormat) -> str:
    """The citation of a dataset in a format, ending with a line end."""
    citation = citation_of(manifest)
    return {"bibtex": _bibtex, "cff": _cff}[form](citation)


def _bibtex(citation: Citation) -> str:
    key = re.sub(r"[^A-Za-z0-9-]+", "-", citation.name).strip("-").lower() or "dataset"
    fields: dict[str, Any] = {
        "title": citation.title,
        "author": citation.authors,
        "version": citation.version,
        "doi": citation.doi,
        "url": citation.url,
        "note": f"Data set, licence {AND.join(citation.licences)}",
    }
    software = {
        "title": SOFTWARE_TITLE,
        "author": SOFTWARE_AUTHORS,
        "version": citation.software,
        "note": "Software, licence MIT",
    }
    entries = [
        _entry(f"{key}-{citation.version}", fields),
        *(_entry(name, _reference_fields(work)) for name, work in _named(citation.references)),
        _entry("tcmrl", software),
    ]
    return "\n".join(entries)


def _named(references: Sequence[Reference]) -> Iterator[tuple[str, Reference]]:
    """The references with a key of author, year and first word of the title, each key once."""
    taken: dict[str, int] = {}
    for work in references:
        words = re.findall(r"[a-z0-9]+", work.title.lower())
        author = re.sub(r"[^a-z0-9]", "", (work.authors or UNKNOWN_AUTHORS)[0].partition(",")[0].lower())
        key = f"{author}{work.year or ''}{words[0] if words else ''}"
        taken[key] = taken.get(key, 0) + 1
        yield key if taken[key] == 1 else f"{key}-{taken[key]}", work


def _reference_fields(work: Reference) -> dict[str, Any]:
    return {
        "title": work.title,
        "author": work.authors or None,
        "year": work.year,
        "howpublished": work.venue,
        "doi": work.doi,
        "url": work.url,
    }


def _entry(key: str, fields: dict[str, Any]) -> str:
    lines = [f"  {name} = {{{_bibtex_value(name, value)}}},\n" for name, value in fields.items() if value]
    return f"@misc{{{key},\n{''.join(lines)}}}\n"


def _bibtex_value(name: str, value: Any) -> str:
    if name == "author":
        return " and ".join(map(_bibtex_author, value))
    if name in ("url", "doi"):
        return str(value)  # \url and \doi take them as they are; neither can hold a brace
    text = "".join(_BIBTEX_SPECIAL.get(character, character) for character in str(value))
    return f"{{{text}}}" if name == "title" else text  # the inner braces keep capitals


def _bibtex_author(name: str) -> str:
    text = "".join(_BIBTEX_SPECIAL.get(character, character) for character in name)
    return text if "," in name or name == "others" else f"{{{text}}}"


def _cff(citation: Citation) -> str:
    """The Citation File Format, version 1.2.0 (https://citation-file-format.github.io)."""
    listed = [licence for licence in citation.licences if is_listed(licence)]
    fields: dict[str, Any] = {
        "cff-version": "1.2.0",
        "message": "Cite this dataset with the works that it is from, listed as its references.",
        "type": "dataset",
        "title": citation.title,
        "authors": [_cff_author(name) for name in citation.authors],
        "version": citation.version,
        # several identifiers would mean a choice between them
        "license": listed[0] if len(citation.licences) == len(listed) == 1 else None,
        "doi": citation.doi,
        "url": citation.url,
        "abstract": f"Licence: {AND.join(citation.licences)}.",
        "references": [
            *(_cff_reference(work) for work in citation.references),
            {
                "type": "software",
                "title": SOFTWARE_TITLE,
                "authors": [{"name": name} for name in SOFTWARE_AUTHORS],
                "version": citation.software,
                "license": "MIT",
            },
        ],
    }
    known = {name: value for name, value in fields.items() if value is not None}
    return str(yaml.safe_dump(known, sort_keys=False, allow_unicode=True))


def _cff_reference(work: Reference) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "type": "article" if work.venue is None else "conference-paper",
        "title": work.title,
        "authors": [_cff_author(name) for name in work.authors or UNKNOWN_AUTHORS],
        "year": work.year,
        "collection-title": work.venue,
        "doi": work.doi,
        "url": work.url,
    }
    return {name: value for name, value in fields.items() if value is not None}


def _cff_author(name: str) -> dict[str, str]:
    family, comma, given = (part.strip() for part in name.partition(","))
    return {"family-names": family, "given-names": given} if comma and given else {"name": name}
