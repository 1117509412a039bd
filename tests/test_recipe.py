import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tcmrl_data import Recipe, apply_overrides, canonical_json, list_environments, load_recipe
from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.foundation.errors import RecipeError, UnknownNameError
from tcmrl_data.recipe import PROFILES, Profile
from tcmrl_data.recipe.recipe import choose_tasks, full_settings
from tcmrl_data.recipe.values import read_comments, recipe_values
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
        assert recipe.environment.name == name


def test_sizes_are_the_papers() -> None:
    sizes = {
        name: (environment.tasks, environment.train)
        for name in ENVIRONMENTS.members()
        for environment in [load_recipe(name).environment]
    }
    assert sizes["point-robot-wind"] == sizes["ml1/reach"] == (50, 40)
    assert sizes["sparse-point-robot"] == sizes["half-cheetah-vel"] == (100, 80)
    assert sizes["hopper-rand-params"] == sizes["walker-rand-params"] == (40, 30)
    assert sizes["ant-dir"] == sizes["ant-goal"] == (40, 30)  # CSRO


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
    with pytest.raises(RecipeError, match=r"lacks behavior.scripted.noise; add it"):
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


def lacking(values: dict[str, Any], *path: str) -> dict[str, Any]:
    """Settings as a version recorded them that did not know the field at `path`."""
    copy: dict[str, Any] = json.loads(json.dumps(values))
    table = copy
    for key in path[:-1]:
        table = table[key]
    del table[path[-1]]
    return copy


@pytest.mark.parametrize(
    "path",
    [("environment", "goal_radius"), ("behavior", "observation"), ("behavior", "settings", "gradient_steps")],
)
def test_settings_recorded_without_a_later_field_have_its_default(path: tuple[str, ...]) -> None:
    settings = load_recipe("sparse-point-robot").unit_settings()
    assert full_settings(settings) == settings
    assert full_settings(lacking(settings, *path)) == settings


def test_a_field_with_another_value_than_its_default_makes_other_settings() -> None:
    changed = load_recipe("point-robot-wind", overrides=["environment.wind_limit=0.1"]).unit_settings()
    older = lacking(changed, "environment", "wind_limit")
    assert full_settings(older) != changed
    assert full_settings(older) == load_recipe("point-robot-wind").unit_settings()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("rollouts", "recorded settings: unknown key rollouts.later"),
        ("environment", "recorded settings: unknown key environment.later"),
        ("behavior", "recorded settings: unknown key behavior.later"),
    ],
)
def test_settings_recorded_by_a_later_version_are_refused(table: str, message: str) -> None:
    settings = load_recipe("point-robot").unit_settings()
    settings[table]["later"] = 1
    with pytest.raises(RecipeError, match=message):
        full_settings(settings)


@pytest.mark.parametrize("value", ["0.0", "-0.1", "inf"])
def test_an_entropy_coefficient_that_is_not_above_0_is_refused(value: str) -> None:
    with pytest.raises(RecipeError, match="entropy"):
        load_recipe("point-robot", overrides=["behavior.source=sac", f"behavior.sac.entropy={value}"])


@pytest.fixture
def own_recipe(tmp_path: Path) -> Path:
    """A recipe file of a user: the one of point-robot under another name."""
    file = tmp_path / "my-recipe.toml"
    file.write_text(ENVIRONMENTS.get("point-robot").recipe_file("point-robot").read_text(encoding="utf-8"))
    return file


def test_a_recipe_file_gives_the_recipe_of_the_environment_that_it_names(own_recipe: Path) -> None:
    assert load_recipe(own_recipe, profile="quick") == load_recipe("point-robot", profile="quick")
    text = own_recipe.read_text()
    own_recipe.write_text(text.replace('name = "point-robot"', 'name = "sparse-point-robot"'))
    assert load_recipe(own_recipe).make_environment().name == "sparse-point-robot"


def test_a_recipe_file_may_hold_variants_by_environment(own_recipe: Path) -> None:
    text = own_recipe.read_text()
    own_recipe.write_text(f'{text}\n[variants."point-robot".rollouts]\nepisodes = 100\n')
    assert load_recipe(own_recipe).rollouts.episodes == 100
    assert load_recipe(own_recipe, overrides=["rollouts.episodes=150"]).rollouts.episodes == 150


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ('name = "point-robot"', "", r"\[environment\] has no name; write for example name = "),
        ('name = "point-robot"', "name = 3", r"\[environment\] has no name"),
        ('name = "point-robot"', 'name = "pointrobot"', "'pointrobot'; did you mean point-robot"),
        ("schema = 1", "schema = 2", "schema 2 is not 1"),
        ("schema = 1", "schema = ", "is no TOML: Invalid value"),
        ("schema = 1", "schema = 1\nbuild = 5", r"build is a value; write it as a table \[build\]"),
        ("[rollouts]", "[rolouts]", "unknown table 'rolouts'; did you mean rollouts"),
        ("[profiles.quick.build]", "[profiles.quik.build]", "unknown profile 'quik'; did you mean quick"),
        ("schema = 1", "schema = 1\nvariants = 5", "variants holds a value"),
    ],
)
def test_a_recipe_file_that_is_none_is_refused_in_one_line(
    own_recipe: Path, old: str, new: str, error: str
) -> None:
    text = own_recipe.read_text()
    assert old in text
    own_recipe.write_text(text.replace(old, new, 1))
    with pytest.raises((RecipeError, UnknownNameError), match=error) as caught:
        load_recipe(own_recipe)
    assert str(caught.value).startswith(str(own_recipe))
    assert "\n" not in str(caught.value)


SHORT = """
schema = 1
about = { description = "mine", citation = "none", licence = "MIT" }
environment = { name = "point-robot", tasks = 10, train = 8, horizon = 20 }
behavior.sac = { steps = 3000, snapshots = [0, 2500, 3000] }
"""


def test_a_recipe_says_only_what_has_no_usual_value(tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(SHORT)
    recipe = load_recipe(tmp_path / "short.toml")
    assert (recipe.rollouts.episodes, recipe.rollouts.lanes) == (50, 10)
    assert (recipe.environment.task_seed, recipe.behavior.source) == (1337, "stacked")
    settings = recipe.behavior.settings
    assert [settings[name] for name in ("learning_rate", "warmup", "group")] == [3e-4, 2_000, 10]
    assert "build" not in {value.key for value in recipe_values(tmp_path / "short.toml").values}


def test_all_missing_fields_are_named_at_once(tmp_path: Path) -> None:
    (tmp_path / "empty.toml").write_text(
        'schema = 1\nenvironment.name = "point-robot"\nbehavior.stacked.hidden = [8]\n'
    )
    with pytest.raises(RecipeError) as caught:
        load_recipe(tmp_path / "empty.toml")
    assert str(caught.value) == (
        f"{tmp_path / 'empty.toml'}, profile 'paper' lacks about.description, about.citation, about.licence, "
        "environment.tasks, environment.train, environment.horizon, behavior.stacked.steps, "
        "behavior.stacked.snapshots; add them"
    )


def test_a_recipe_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"nowhere.toml does not exist; name a recipe file or an environ"):
        load_recipe(tmp_path / "nowhere.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(RecipeError, match=r"folder.toml cannot be read: Is a directory"):
        load_recipe(tmp_path / "folder.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(RecipeError, match=r"binary.toml is no TOML: invalid start byte at byte 0"):
        load_recipe(tmp_path / "binary.toml")


def test_the_environment_of_a_recipe_cannot_be_set() -> None:
    with pytest.raises(RecipeError, match="name another one as ENV"):
        load_recipe("point-robot", overrides=["environment.name=point-robot-wind"])


def test_a_recipe_is_the_same_after_json() -> None:
    for name in ("point-robot", "ml1/reach", "half-cheetah-vel"):
        recipe = load_recipe(name)
        again = Recipe.model_validate_json(canonical_json(recipe.model_dump(mode="json")))
        assert again == recipe
        assert again.unit_settings() == recipe.unit_settings()
        assert recipe.unit_settings()["environment"] == recipe.make_environment().settings.model_dump(
            mode="json"
        )


COMMENTED = '''
[plain]  # of the header
# of the table
one = 1
two = 2            # behind # twice
text = "# no comment"
# above,
# in two lines
three.four = [     # inside
    1,             # of an item
    2
]                  # behind a list

five = """
# text
"""

# of nothing

[other."a.b"]
six = { seven = 7, eight = 8 }
'''


def test_a_comment_belongs_to_the_value_before_it_below_it_or_to_its_table() -> None:
    assert read_comments(COMMENTED) == {
        ("plain", "one"): "of the table",
        ("plain", "two"): "behind # twice",
        ("plain", "text"): "of the table",
        ("plain", "three", "four"): "behind a list",
        ("plain", "five"): "of the table",
        ("other", "a.b", "six", "seven"): "",
        ("other", "a.b", "six", "eight"): "",
    }
    assert read_comments("# above,\n# in two lines\none = 1\n\n# far\n\ntwo = 2") == {
        ("one",): "above, in two lines",
        ("two",): "",
    }


@pytest.mark.parametrize("name", ["sparse-point-robot", "ml1/box-close", "hopper-rand-params"])
@pytest.mark.parametrize("profile", ["paper", "quick"])
def test_every_value_of_a_recipe_is_listed_and_can_be_set_by_its_key(name: str, profile: Profile) -> None:
    listed = recipe_values(name, profile=profile).values
    assert len({value.key for value in listed}) == len(listed)
    overrides = [f"{value.key}={json.dumps(value.value)}" for value in listed if value.value is not None]
    recipe = load_recipe(name, profile=profile)
    assert load_recipe(name, profile=profile, overrides=overrides) == recipe
    with pytest.raises(RecipeError, match="unknown key"):
        load_recipe(name, profile=profile, overrides=["behavior.sac.no_such_key=1"])
    keys = {value.key for value in listed}
    assert {f"environment.{key}" for key in recipe.environment.model_dump() if key != "name"} <= keys
    assert {f"build.{key}" for key in recipe.build.model_dump()} <= keys
    settings = {
        key.rpartition(".")[2] for key in keys if key.startswith(("behavior.sac.", "behavior.stacked."))
    }
    assert settings == set(recipe.behavior.settings)


def test_a_source_is_that_of_the_layer_that_the_value_comes_from() -> None:
    found = recipe_values("ml1/box-close", profile="quick", overrides=["rollouts.lanes=5", "training.a.b=1"])
    sources = {value.key: (value.value, value.source) for value in found.values}
    assert (found.environment, found.profile) == ("ml1/box-close", "quick")
    assert sources["rollouts.lanes"] == (5, "--set")
    assert sources["training.a.b"] == (1, "--set")
    assert sources["rollouts.episodes"] == (10, "profile quick")
    assert sources["behavior.sac.tau"][1].startswith("Values without a comment are from the SAC paper")
    assert sources["training.batch.window_length"] == (8, "variant ml1/box-close: K; paper, F.2")
    assert sources["behavior.stacked.group"][1].startswith("profile quick: the profile's tasks")
    assert sources["build.timeout"] == (None, "default")
