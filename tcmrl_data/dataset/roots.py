"""Roots of builds of this package's own recipes, in `manifests/roots.toml`, and whether a build has one."""

import importlib.resources
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.foundation.errors import ManifestError
from tcmrl_data.recipe.recipe import Recipe, load_recipe
from tcmrl_data.store.part import Platform

ROOTS_FILE = "roots.toml"


@dataclass(frozen=True)
class PublishedRoot:
    """The root of a build of an own recipe, with seed 0 and all tasks of the profile.

    Attributes:
        root: the root.
        platform: where it was built: cpu, system, python, and packages by name.
    """

    root: str
    platform: Mapping[str, str]

    def differences(self, platform: Platform) -> list[str]:
        """What is otherwise on a platform."""
        here = {"cpu": platform.cpu, "system": platform.system, "python": platform.python}
        here |= platform.packages
        names = sorted(here.keys() & self.platform.keys())
        return [
            f"{name} {self.platform[name]} → {here[name]}"
            for name in names
            if self.platform[name] != here[name]
        ]


def published_roots(recipe: Recipe, seed: int = 0) -> list[PublishedRoot]:
    """The roots that were published of a recipe.

    Raises:
        ManifestError: there is none: the recipe is not one of the package's own, or was changed.
    """
    file = importlib.resources.files("tcmrl_manifests") / ROOTS_FILE
    content: dict[str, Any] = tomllib.loads(file.read_text(encoding="utf-8"))
    names = (recipe.environment.name, recipe.profile)
    found = [row for row in content["roots"] if (row["recipe"], row["profile"]) == names]
    if not found or seed != 0 or load_recipe(names[0], profile=recipe.profile) != recipe:
        known = ", ".join(sorted({f"{row['recipe']} ({row['profile']})" for row in content["roots"]}))
        raise ManifestError(
            f"no root was published of this recipe, profile {recipe.profile}, and seed {seed}; with seed 0 "
            f"and nothing set there are those of {known}"
        )
    return [PublishedRoot(row["root"], content["platforms"][row["platform"]]) for row in found]


def why_not_as_published(dataset: Dataset, roots: list[PublishedRoot]) -> str | None:
    """Why a dataset has none of the published roots, the platform first; None if it has one."""
    root = dataset.manifest.root
    if any(published.root == root for published in roots):
        return None
    nearest = min(
        (
            [change for platform in dataset.manifest.platforms for change in one.differences(platform)],
            one.root,
        )
        for one in roots
    )
    why = (
        f"it was built on another platform ({'; '.join(nearest[0])})"
        if nearest[0]
        else ("the platform is the same, so something else differs: other tasks, or a damaged part")
    )
    return f"{dataset.path} has root {root[:12]}, and {nearest[1][:12]} was published; {why}"
