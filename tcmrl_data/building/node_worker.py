"""Describes a machine: `python -m tcmrl_data.building.node_worker`; a JSON spec on its input.

It answers in two messages, because another version of the package may not understand the recipe.
"""

from importlib.metadata import version
from pathlib import Path
from typing import Any

from tcmrl_data.engine.worker import Send, serve
from tcmrl_data.foundation.canonical import canonical_json
from tcmrl_data.foundation.locks import wait_until_visible


def work(spec: dict[str, Any], report: Send) -> str:
    """Reports what the machine sees of the dataset's folder, its version and its platform."""
    sees = wait_until_visible(Path(spec["token"]), deadline=spec["deadline"])
    report({"kind": "node", "sees_folder": sees, "tcmrl": version("tcmrl")})
    if sees and version("tcmrl") == spec["tcmrl"]:
        report({"kind": "platform", "platform": _platform(spec["recipe"])})
    return ""


def _platform(recipe: dict[str, Any]) -> dict[str, Any]:
    from tcmrl_data.recipe.recipe import Recipe
    from tcmrl_data.store.platform import this_platform

    resolved = Recipe.model_validate_json(canonical_json(recipe))
    platform = this_platform(resolved.make_environment(), resolved.behavior.source)
    return platform.model_dump(mode="json")


if __name__ == "__main__":
    serve(work)
