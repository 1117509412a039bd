"""Citations: parsed by libraries that know the formats, with names that try to break them."""

from typing import Any

import bibtexparser
import pytest
import yaml

from tcmrl_data import Dataset, Manifest
from tcmrl_data.describe.cite import citation_text
from tcmrl_data.recipe.document import About, Reference, is_listed
from tests.workers import ROOT

HOSTILE = About(
    description="d",
    citation="c",
    licence="CC-BY-4.0",
    authors=("Müller, Jörg", "R&D {Lab}_1", "O'Neil # 100%, A: b"),
    url="https://example.org/a_b?c=1#d",
    doi="10.5281/zenodo.1234567",
    references=(
        Reference(title='"Quoted": a # {brace} & \\ 50% – π', authors=("Doe, Jane", "others"), year=2020),
        Reference(title="Same", authors=("Doe, Jane",), year=2020, venue="A Journal"),
        Reference(title="Same again", authors=("Doe, Jane",), year=2020, url="https://example.org"),
        Reference(title="No authors"),
    ),
)
CFF_TYPES = {"dataset", "software"}
CFF_REFERENCE_TYPES = {"article", "conference-paper", "software", "dataset", "generic"}
PERSON = {"family-names", "given-names"}


def with_about(manifest: Manifest, about: About) -> Manifest:
    run = manifest.runs[0]
    assert run.recipe is not None
    changed = run.model_copy(update={"recipe": run.recipe.model_copy(update={"about": about})})
    return manifest.model_copy(update={"runs": (changed,)})


def check_cff(document: dict[str, Any]) -> None:
    """The required fields of CFF 1.2.0, and the forms of those that we write.

    Source: https://github.com/citation-file-format/citation-file-format/blob/1.2.0/schema-guide.md
    """
    assert document["cff-version"] == "1.2.0"
    assert document["type"] in CFF_TYPES
    assert is_listed(document.get("license", "MIT"))
    for work in (document, *document.get("references", ())):
        assert isinstance(work["title"], str) and work["title"]
        assert work["authors"]
        assert all(set(author) in ({"name"}, PERSON) for author in work["authors"])
        assert all(isinstance(text, str) and text for author in work["authors"] for text in author.values())
        assert work.get("url", "https://").startswith("https://")
        assert work.get("doi", "10.").startswith("10.")
        assert isinstance(work.get("version", ""), str)
        assert isinstance(work.get("year", 0), int)
    assert all(work["type"] in CFF_REFERENCE_TYPES for work in document.get("references", ()))
    known = {"cff-version", "message", "type", "title", "authors", "version", "license", "doi", "url"}
    assert set(document) <= known | {"abstract", "references", "keywords", "repository-code"}
    assert isinstance(document["message"], str)


@pytest.mark.parametrize("about", [None, HOSTILE], ids=["recipe", "hostile"])
def test_the_bibtex_of_a_dataset_parses(tiny: Dataset, about: About | None) -> None:
    manifest = tiny.manifest if about is None else with_about(tiny.manifest, about)
    entries = bibtexparser.loads(citation_text(manifest, "bibtex")).entries
    own = entries[0]
    works = manifest.recipe.about.references
    assert len(entries) == 2 + len(works)
    assert len({entry["ID"] for entry in entries}) == len(entries)
    assert own["version"] == tiny.manifest.root[:12]
    assert "point-robot" in own["title"] and manifest.licences[0] in own["note"]
    assert [("year" in entry) for entry in entries[1:-1]] == [work.year is not None for work in works]
    if about is not None:
        assert own["author"] == r"Müller, Jörg and {R\&D \{Lab\}\_1} and O'Neil \# 100\%, A: b"
        assert (own["doi"], own["url"]) == (about.doi, about.url)
        assert entries[1]["author"] == "Doe, Jane and others"
        assert [entry["ID"] for entry in entries[2:4]] == ["doe2020same", "doe2020same-2"]


@pytest.mark.parametrize("about", [None, HOSTILE], ids=["recipe", "hostile"])
def test_the_cff_of_a_dataset_parses_and_has_what_the_format_requires(
    tiny: Dataset, about: About | None
) -> None:
    manifest = tiny.manifest if about is None else with_about(tiny.manifest, about)
    document = yaml.safe_load(citation_text(manifest, "cff"))
    check_cff(document)
    assert document["version"] == tiny.manifest.root[:12]
    assert [work["title"] for work in document["references"][:-1]] == [
        work.title for work in manifest.recipe.about.references
    ]
    if about is not None:
        assert document["authors"][:2] == [
            {"family-names": "Müller", "given-names": "Jörg"},
            {"name": "R&D {Lab}_1"},
        ]
        assert document["license"] == "CC-BY-4.0"


def test_a_licence_that_cff_does_not_know_stands_in_the_abstract(tiny: Dataset) -> None:
    for licence in ("LicenseRef-mine", "CC-BY-4.0 AND MIT", "unknown"):
        about = HOSTILE.model_copy(update={"licence": licence})
        document = yaml.safe_load(citation_text(with_about(tiny.manifest, about), "cff"))
        assert "license" not in document
        assert document["abstract"] == f"Licence: {licence}."


def test_the_softwares_own_cff_parses() -> None:
    document = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    check_cff(document)
    assert (document["type"], document["license"]) == ("software", "MIT")
