from itertools import pairwise

import pytest

from tcmrl_data import apply_overrides, list_environments, load_recipe
from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.foundation.errors import RecipeError, UnknownNameError
from tcmrl_data.recipe.recipe import PROFILES
from tcmrl_data.recipe.tasks import choose_tasks
from tests.environments import some_members


def test_every_environment_has_a_recipe() -> None:
    assert [row["name"] for row in list_environments().environments] == ENVIRONMENTS.members()
    assert list_environments().broken == {}


@pytest.mark.parametrize(
    "name", [name for family in ENVIRONMENTS.working().values() for name in some_members(family)]
)
def test_profiles_resolve(name: str) -> None:
    profiles = list(load_recipe(name).training)
    recipes = {profile: load_recipe(name, profile=profile) for profile in profiles}
    assert recipes["paper"].rollouts.episodes == 50  # paper, Appendix F.1
    assert recipes["paper"].environment == recipes["quick"].environment
    assert {"paper", "quick"} <= set(profiles)
    for profile in set(PROFILES) - set(profiles):
        with pytest.raises(RecipeError, match=f"has no profile '{profile}'; known are paper, quick"):
            load_recipe(name, profile=profile)
    assert recipes["paper"].training == recipes["quick"].training
    for recipe in recipes.values():
        assert recipe.rollouts.episodes % recipe.rollouts.lanes == 0
        assert recipe.environment["name"] == name


def test_sizes_are_the_papers() -> None:
    sizes = {
        name: (environment["tasks"], environment["train"])
        for name in ENVIRONMENTS.members()
        for environment in [load_recipe(name).environment]
    }
    assert sizes["point-robot-wind"] == sizes["ml1/reach"] == (50, 40)
    assert sizes["sparse-point-robot"] == sizes["half-cheetah-vel"] == (100, 80)
    assert sizes["hopper-rand-params"] == sizes["walker-rand-params"] == (40, 30)


def test_quick_point_robot_has_sixteen_training_and_four_test_tasks_over_the_half_circle() -> None:
    tasks = choose_tasks(load_recipe("point-robot", profile="quick"))
    assert [sum(task.split == split for task in tasks) for split in ("train", "test")] == [16, 4]
    angles = [task.index * 180 / 99 for task in tasks]
    assert (angles[0] < 10, angles[-1] > 170) == (True, True)
    assert max(b - a for a, b in pairwise(angles)) < 30


@pytest.mark.parametrize(
    ("override", "pattern"),
    [
        ("behavior.sac.stepz=1", r"unknown key behavior\.stacked\.stepz; did you mean steps"),
        ("behavior.sac.steps='many'", r"steps: Input should be a valid integer, got 'many'"),
        ("behavior.sac.gamma=1.5", "gamma: Input should be less than 1"),
        ("behavior.sac.snapshots=[0,100,3000]", "within the warm-up of 250 random steps"),
        ("behavior.sac.snapshots=[0,1000]", r"must rise from 0 to steps \(3000\)"),
        ("environment.train=100", "must be smaller than tasks"),
        ("rollouts.lanes=0", "lanes: Input should be greater"),
        ("rollouts.lanes=7", "multiple of lanes"),
        ("nonsense.key=1", "unknown table 'nonsense'"),
        ("rollouts.episodes", "expected section.key=value"),
        ("rollouts.episodes.x=1", "is a value, not a section"),
        ("behavior.colour=1", "unknown key behavior.colour; known are observation, reward, source"),
    ],
)
def test_bad_overrides_say_what_and_where(override: str, pattern: str) -> None:
    with pytest.raises(RecipeError, match=pattern) as caught:
        load_recipe("point-robot", profile="quick", overrides=[override])
    assert "\n" not in str(caught.value)


def test_unknown_names_list_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean point-robot"):
        load_recipe("pointrobot")
    with pytest.raises(UnknownNameError, match="unknown behavior source 'sack'; did you mean sac"):
        load_recipe("point-robot", behavior="sack")
    with pytest.raises(UnknownNameError, match="ml1/reach"):
        load_recipe("ml1/reech")


def test_a_source_without_settings_is_refused() -> None:
    with pytest.raises(RecipeError, match=r"no \[behavior.scripted\] table"):
        load_recipe("point-robot", behavior="scripted")


def test_overrides_are_read_as_toml_and_leave_the_original_alone() -> None:
    table = {"a": {"b": 1, "c": [1]}}
    result = apply_overrides(table, ["a.b=2.5", "a.c=[3, 4]", "a.d.e=true", "a.word=last"])
    assert result == {"a": {"b": 2.5, "c": [3, 4], "d": {"e": True}, "word": "last"}}
    assert table == {"a": {"b": 1, "c": [1]}}


def test_only_data_settings_are_unit_settings() -> None:
    base = load_recipe("point-robot")
    edited = load_recipe("point-robot", overrides=["training.steps=3", "build.train_tasks=4"])
    assert edited.unit_settings() == base.unit_settings()
    assert (
        load_recipe("point-robot", overrides=["rollouts.episodes=100"]).unit_settings()
        != base.unit_settings()
    )


@pytest.mark.parametrize("value", ["0.0", "-0.1", "inf"])
def test_an_entropy_coefficient_that_is_not_above_0_is_refused(value: str) -> None:
    with pytest.raises(RecipeError, match="entropy"):
        load_recipe("point-robot", overrides=["behavior.source=sac", f"behavior.sac.entropy={value}"])
