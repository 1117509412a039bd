"""Roots of own recipes that come with the package, and what a build says of them."""

import importlib.resources
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tcmrl_data import Dataset, build_dataset, load_recipe, open_dataset
from tcmrl_data.dataset.roots import ROOTS_FILE, published_roots, why_not_as_published
from tcmrl_data.foundation.errors import ManifestError

ROWS = tomllib.loads((importlib.resources.files("tcmrl_manifests") / ROOTS_FILE).read_text())["roots"]


def built(root: str, **platform: Any) -> Dataset:
    made = SimpleNamespace(cpu="another", system="", python="3.11.7", packages={}, **platform)
    return cast(Dataset, SimpleNamespace(path="data", manifest=SimpleNamespace(root=root, platforms=[made])))


def test_a_build_is_compared_with_the_roots_of_its_recipe() -> None:
    roots = published_roots(load_recipe("point-robot", profile="quick"))
    assert why_not_as_published(built(roots[0].root), roots) is None
    words = str(why_not_as_published(built("0" * 64), roots))
    assert f"has root {'0' * 12}, and {roots[0].root[:12]} was published" in words
    assert "another platform (cpu AMD EPYC → another" in words


def test_a_changed_recipe_or_seed_has_no_published_root() -> None:
    recipe = load_recipe("point-robot", profile="quick")
    for changed, seed in ((recipe, 1), (load_recipe("ant-dir"), 0)):
        with pytest.raises(ManifestError, match="no root was published of this recipe"):
            published_roots(changed, seed)


@pytest.mark.sweep
@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row['recipe']}-{row['profile']}")
def test_a_build_has_the_published_root(row: dict[str, Any], tmp_path: Path) -> None:
    recipe = load_recipe(row["recipe"], profile=row["profile"])
    assert build_dataset(recipe, tmp_path / "data").failed == ()
    opened, roots = open_dataset(tmp_path / "data"), published_roots(recipe)
    platforms = opened.manifest.platforms
    if all(published.differences(platform) for published in roots for platform in platforms):
        pytest.skip(str(why_not_as_published(opened, roots)))
    assert why_not_as_published(opened, roots) is None
