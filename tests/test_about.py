"""What a dataset says of itself: licence, authors and references, which shape no id and no root."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import tcmrl_data
from tcmrl_data import Dataset, Recipe
from tcmrl_data.foundation.errors import RecipeError
from tcmrl_data.foundation.records import parse_json, sealed
from tcmrl_data.recipe.document import (
    About,
    Reference,
    joined_licences,
    licence_problem,
    merged_about,
    read_about,
)
from tcmrl_data.store.manifest import MANIFEST, read_manifest
from tests.datasets import part_ids

pytestmark = pytest.mark.usefixtures("module_in_process")

Copy = Callable[[], Path]
PLAIN = {"description": "a", "citation": "b", "licence": "MIT"}
FULL = {
    **PLAIN,
    "licence": "CC-BY-4.0",
    "authors": ["Doe, Jane", "A Laboratory"],
    "url": "https://example.org/data",
    "doi": "10.5281/zenodo.1234567",
    "references": [{"title": "A Paper", "authors": ["Roe, Richard"], "year": 2020}],
}


def relicensed(folder: Path, about: dict[str, Any]) -> Path:
    """Gives a dataset another `[about]` table, under a new seal."""
    fields = parse_json((folder / MANIFEST).read_bytes())
    del fields["digest"]
    for run in fields["runs"]:
        run["recipe"]["about"] = about
    (folder / MANIFEST).write_bytes(sealed(fields))
    return folder


def test_every_recipe_names_a_licence_and_its_works() -> None:
    for name in ("point-robot", "half-cheetah-vel", "walker-rand-params", "ml1/reach"):
        about = tcmrl_data.load_recipe(name).about
        assert licence_problem(about.licence) is None
        assert all(work.authors and work.year and work.url for work in about.references)
        assert about.references


@pytest.mark.parametrize("text", ["MIT", "MIT AND CC-BY-4.0", "LicenseRef-my-terms", "GPL-2.0-only OR MIT"])
def test_spdx_expressions_are_licences(text: str) -> None:
    assert licence_problem(text) is None


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("licence", "CC BY 4.0", "'CC BY 4.0' is no SPDX licence; did you mean .*CC-BY-4.0"),
        ("licence", "mine", "'mine' is no SPDX licence; .*LicenseRef-NAME"),
        ("licence", "MIT AND mit", "'mit' is no SPDX licence; did you mean MIT"),
        ("doi", "https://doi.org/10.1/x", "about.doi: .* is no DOI; write it as 10.1000/182"),
        ("url", "example.org", "about.url: 'example.org' is no URL"),
        ("author", ["Doe, Jane"], "unknown key about.author; did you mean authors"),
        ("references", [{"title": "A", "url": "ftp://a"}], r"about.references.0.url: 'ftp://a' is no URL"),
        ("references", [{"name": "A"}], r"about.references.0.title: Field required"),
    ],
)
def test_a_recipe_with_what_is_no_licence_doi_or_url_is_refused(key: str, value: Any, expected: str) -> None:
    with pytest.raises(RecipeError, match=f"^my.toml: .*{expected}"):
        read_about(PLAIN | {key: value}, "my.toml")


def test_fields_that_are_not_set_are_not_written() -> None:
    """Manifests of earlier versions, which lack them, thus keep their bytes when they are written again."""
    assert (
        About.model_validate_json(b'{"description":"a","citation":"b","licence":"MIT"}').model_dump() == PLAIN
    )
    assert About.model_validate(read_about(FULL, "x").model_dump()) == read_about(FULL, "x")
    assert read_about(FULL, "x").model_dump(mode="json") == FULL


@pytest.mark.check
def test_a_dataset_of_an_earlier_version_opens_and_is_written_alike(tiny_copy: Copy) -> None:
    folder = relicensed(tiny_copy(), {**PLAIN, "licence": "my own words"})
    before = (folder / MANIFEST).read_bytes()
    tcmrl_data.rename_dataset(folder, "named")
    fields = parse_json((folder / MANIFEST).read_bytes())
    del fields["digest"]
    assert sealed(fields | {"label": None}) == before
    assert read_manifest(folder).licences == ("my own words",)


def test_about_changes_no_id_and_no_root(tiny: Dataset, tiny_copy: Copy) -> None:
    folder = relicensed(tiny_copy(), FULL)
    manifest = read_manifest(folder)
    assert manifest.root == tiny.manifest.root
    assert manifest.recipe.unit_settings() == tiny.manifest.recipe.unit_settings()
    assert tcmrl_data.verify_dataset(folder).findings == ()


@pytest.mark.check
def test_a_build_that_says_other_things_of_itself_gives_the_same_ids(
    tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    recipe = tiny_recipe.model_copy(update={"about": read_about(FULL, "x")})
    tcmrl_data.build_dataset(recipe, tmp_path / "built", tasks=[0], workers=1)
    built = part_ids(tmp_path / "built")
    assert built == {key: digest for key, digest in part_ids(tiny.folder).items() if key[0] == 0}


def test_a_merge_lists_the_licences_of_all_sources(tiny: Dataset, tiny_copy: Copy, tmp_path: Path) -> None:
    sources = [tiny.folder, relicensed(tiny_copy(), FULL)]
    merged = tcmrl_data.merge_datasets(sources, tmp_path / "merged")
    manifest = read_manifest(tmp_path / "merged")
    assert (manifest.licences, merged.root) == (("CC-BY-4.0", "MIT"), tiny.manifest.root)
    assert manifest.recipe.about.authors == ("Doe, Jane", "A Laboratory", "the tcmrl authors")
    tcmrl_data.merge_datasets(sources[::-1], tmp_path / "reversed")
    assert read_manifest(tmp_path / "reversed").digest == manifest.digest


def test_merged_tables_keep_what_agrees_and_list_the_rest() -> None:
    one = About(description="d", citation="a", licence="MIT AND ISC", url="https://a.org")
    two = one.model_copy(update={"citation": "b", "licence": "ISC", "references": (Reference(title="t"),)})
    both = merged_about([one, two, two])
    assert (both.citation, both.licence, both.url) == ("a; b", "ISC AND MIT", "https://a.org")
    assert both.references == (Reference(title="t"),)
    assert merged_about([one, one]) is one
    assert joined_licences(["MIT", "unknown", "MIT"]) == "MIT AND unknown"


def test_an_import_under_no_licence_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"^licence: 'CC-BY' is no SPDX licence"):
        tcmrl_data.import_dataset("hdf5", [tmp_path / "none.hdf5"], tmp_path / "out", licence="CC-BY")
