"""Roots of own recipes that come with the package, and what a build says of them."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from tcmrl_data import Dataset, load_recipe
from tcmrl_data.dataset.roots import published_roots, why_not_as_published
from tcmrl_data.foundation.errors import ManifestError


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
