"""Recipes of data that were made elsewhere: what is known of their environment, and no rollouts."""

from collections.abc import Mapping

from tcmrl_data.envs.foreign import Foreign
from tcmrl_data.foundation.errors import RecipeError
from tcmrl_data.foundation.licences import licence_problem
from tcmrl_data.recipe.about import About
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
"""Of episodes whose policies nobody has described; no behavior source has this name."""


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
    """The recipe of data of an unknown environment.

    A manifest always has a recipe: that is where samplers, exports, `inspect` and training look for sizes,
    horizon and training tables, which thus need no second path for imported data.

    Args:
        tasks: number of tasks.
        train: number of training tasks.
        horizon: steps of the longest episode.
        observation_dim: width of observations.
        action_dim: width of actions.
        extra_arrays: dtypes of further per-step arrays, by name.
        licence: of the data; None where it is not known.
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
    """The recipe of data that come from one of our environments, but not from a build of it.

    Args:
        environment: its name.
        licence: of the data; None where it is not known.

    Raises:
        UnknownNameError: there is no such environment.
    """
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
    """Checks the licence that someone gives for data from elsewhere.

    Raises:
        RecipeError: SPDX does not know it.
    """
    problem = None if licence is None else licence_problem(licence)
    if problem:
        raise RecipeError(f"licence: {problem}")
