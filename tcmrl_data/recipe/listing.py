"""What `tcmrl-data envs` shows: every environment that has a recipe, and every one that is broken."""

from dataclasses import dataclass
from typing import Any

from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.foundation.plugins import one_line_error
from tcmrl_data.recipe.recipe import load_recipe


@dataclass(frozen=True)
class EnvironmentList:
    """The environments of all installed packages.

    Attributes:
        environments: name, dimensions, horizon and task counts, by name.
        broken: one line of error, by name of plug-in or environment.
    """

    environments: tuple[dict[str, Any], ...]
    broken: dict[str, str]


def list_environments() -> EnvironmentList:
    """Every environment that has a recipe; one that fails is listed as broken and harms no other."""
    rows, broken = [], ENVIRONMENTS.broken()
    for name in ENVIRONMENTS.members():
        try:
            if ENVIRONMENTS.get(name).recipe_file(name).is_file():
                rows.append(_row(name))
        except TcmrlError as error:
            broken[name] = str(error)
        except Exception as error:  # noqa: BLE001 # another package's code may raise anything
            broken[name] = f"environment {name!r} is broken: {one_line_error(error)}"
    return EnvironmentList(tuple(rows), broken)


def _row(name: str) -> dict[str, Any]:
    environment = load_recipe(name).make_environment()
    settings = environment.settings
    return {
        "name": name,
        "observation_dim": environment.observation_dim,
        "action_dim": environment.action_dim,
        "horizon": settings.horizon,
        "tasks": settings.tasks,
        "train": settings.train,
        "test": settings.tasks - settings.train,
    }
