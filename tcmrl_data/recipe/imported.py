"""Recipes of imported and recorded data: they name the environment and describe no rollouts."""

from collections.abc import Mapping

from tcmrl_data.envs.foreign import Foreign
from tcmrl_data.foundation.errors import RecipeError
from tcmrl_data.recipe.document import About, licence_problem
from tcmrl_data.recipe.recipe import (
    BehaviorTable,
    EnvironmentTable,
    NoRollouts,
    Recipe,
    TaskChoice,
    load_recipe,
)

UNKNOWN = "unknown"
UNKNOWN_BEHAVIOR = BehaviorTable(source=UNKNOWN, settings={})
"""Behavior of imported episodes, whose policies are not described; no behavior source has this name."""


def foreign_recipe(
    *,
    tasks: int,
    train: int,
    horizon: int,
    observation_dim: int,
    action_dim: int,
    extra_arrays: Mapping[str, str],
    licence: str | None,
) -> Recipe:
    """The recipe of imported data whose environment is unknown; arguments as in `ForeignSettings`.

    Every manifest has a recipe, in which samplers, exports, `inspect` and training find sizes, horizon and
    training tables. `licence` is None if it is unknown.
    """
    environment = {
        "name": Foreign.name,
        "task_seed": 0,
        "tasks": tasks,
        "train": train,
        "horizon": horizon,
        "reward_density": "dense",
        "observation_dim": observation_dim,
        "action_dim": action_dim,
        "extra_arrays": dict(extra_arrays),
    }
    return Recipe(
        profile="paper",
        about=About(
            description="data of an environment that is not known here",
            citation=UNKNOWN,
            licence=licence or UNKNOWN,
        ),
        environment=EnvironmentTable.model_validate(environment),
        behavior=UNKNOWN_BEHAVIOR,
        rollouts=NoRollouts(),
        build=TaskChoice(),
        training={"paper": {}},
    )


def bound_recipe(environment: str, *, licence: str | None) -> Recipe:
    """The recipe of imported data of an installed environment; `licence` is None if it is unknown."""
    recipe = load_recipe(environment)
    return recipe.model_copy(
        update={
            "about": recipe.about.model_copy(
                update={
                    "citation": UNKNOWN,
                    "licence": licence or UNKNOWN,
                    "authors": (),
                    "url": None,
                    "doi": None,
                }
            ),
            "behavior": UNKNOWN_BEHAVIOR,
            "rollouts": NoRollouts(),
            "build": TaskChoice(),
        }
    )


def check_licence(licence: str | None) -> None:
    """Raises `RecipeError` if SPDX does not know the licence given for imported data."""
    problem = None if licence is None else licence_problem(licence)
    if problem:
        raise RecipeError(f"licence: {problem}")
