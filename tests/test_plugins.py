"""Plug-ins of other packages: found by entry points, imported one at a time, errors name the plug-in."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tcmrl_cli.data import data

from tcmrl_data import list_environments, load_recipe
from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.foundation.errors import PluginError, UnknownNameError
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.store.part import this_platform
from tests.commands import assert_refused, in_process
from tests.plugin_packages import install

GROUP = "tcmrl_test.animals"


class Animal:
    """The base class of the test's plug-ins."""

    name: str


def animal(name: str) -> str:
    """Source code of a working plug-in."""
    return f"from {__name__} import Animal\nclass Plugin(Animal):\n    name = {name!r}\n"


Declare = Callable[..., None]


@pytest.fixture
def declare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Declare:
    """Installs a package with one module per plug-in."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def declare_in(package: str, **sources: str) -> None:
        prefix = f"{package.replace('-', '_')}_{tmp_path.name}"
        lines = "\n".join(f"{name} = {prefix}_{name}:Plugin" for name in sources)
        modules = {f"{prefix}_{name}": source for name, source in sources.items()}
        install(tmp_path, package, modules=modules, declares={GROUP: lines})

    return declare_in


@pytest.fixture
def animals() -> Registry[Animal]:
    return Registry(GROUP, "animal", Animal)


def test_a_declared_class_is_found_by_its_name(declare: Declare, animals: Registry[Animal]) -> None:
    declare("zoo", cat=animal("cat"), dog=animal("dog"))
    assert animals.names() == ["cat", "dog"]
    assert (animals.get("cat").name, animals.broken()) == ("cat", {})


def test_an_unknown_name_gets_the_nearest_ones(declare: Declare, animals: Registry[Animal]) -> None:
    declare("zoo", cat=animal("cat"), dog=animal("dog"))
    with pytest.raises(UnknownNameError, match=r"^unknown animal 'catt'; did you mean cat\?$"):
        animals.get("catt")


def test_a_group_that_nobody_declares_says_what_to_install(animals: Registry[Animal]) -> None:
    with pytest.raises(UnknownNameError, match=r"^unknown animal 'cat'; none is installed"):
        animals.get("cat")


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("raise RuntimeError('first line\\nsecond line')", "RuntimeError: first line second line"),
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("import sys; sys.exit(3)", "SystemExit: 3"),
        ("class Plugin", "SyntaxError"),
        ("", "AttributeError: "),
        ("class Plugin: name = 'cat'", f"is no subclass of {__name__}.Animal"),
        (f"from {__name__} import Animal\nPlugin = Animal()", "is no subclass of"),
        (animal("lion"), "has the name 'lion', but is declared as 'cat'"),
        (
            f"import abc\nfrom {__name__} import Animal\nclass Plugin(Animal, abc.ABC):\n"
            "    name = 'cat'\n    @abc.abstractmethod\n    def eat(self): ...\n",
            "does not define eat",
        ),
    ],
    ids=["raises", "lacks", "exits", "syntax", "none", "type", "instance", "name", "abstract"],
)
def test_a_broken_plugin_is_named_with_its_package_and_harms_no_other(
    source: str, error: str, declare: Declare, animals: Registry[Animal]
) -> None:
    declare("zoo", cat=source)
    declare("farm", dog=animal("dog"))
    assert animals.names() == ["cat", "dog"]
    assert animals.get("dog").name == "dog"
    (name, told), *others = animals.broken().items()
    assert (name, others) == ("cat", [])
    assert told.startswith("animal 'cat' of package 'zoo' is broken: ")
    assert error in told
    assert told.endswith("; repair or uninstall the package")
    assert "\n" not in told
    with pytest.raises(PluginError) as raised:
        animals.get("cat")
    assert str(raised.value) == told


def test_a_name_that_two_packages_declare_is_an_error_that_names_both(
    declare: Declare, animals: Registry[Animal]
) -> None:
    declare("zoo", cat=animal("cat"))
    declare("farm", cat=animal("cat"), dog=animal("dog"))
    with pytest.raises(PluginError, match=r"^animal 'cat' is declared by 'farm' and 'zoo'; uninstall one"):
        animals.get("cat")
    assert list(animals.broken()) == ["cat"]
    assert animals.get("dog").name == "dog"


def test_looking_one_up_imports_no_other_and_listing_imports_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = "class Plugin:\n    name = {!r}\n"
    modules = {f"imports_{name}": source.format(name) for name in ("cat", "dog")}
    lines = "cat = imports_cat:Plugin\ndog = imports_dog:Plugin"
    install(tmp_path, "zoo", modules=modules, declares={GROUP: lines})
    monkeypatch.syspath_prepend(tmp_path)
    animals = Registry(GROUP, "animal", object)
    assert animals.names() == ["cat", "dog"]
    assert not modules.keys() & sys.modules.keys()
    assert animals.get("cat").name == "cat"  # type: ignore[attr-defined]
    assert modules.keys() & sys.modules.keys() == {"imports_cat"}
    del sys.modules["imports_cat"]


POLE = """
from pathlib import Path
from typing import final
from tcmrl_data.envs.base import Environment


@final
class Pole(Environment):
    name = "pole"
    observation_dim = 4
    action_dim = 1

    @classmethod
    def members(cls):
        return ["pole/short", "pole/long"]

    @classmethod
    def recipe_file(cls, name):
        return Path(__file__).with_name("pole.toml")

    def draw_parameters(self, num_tasks, task_seed):
        return [{"length": 0.5 + index} for index in range(num_tasks)]

    def make(self, parameters, *, view="stored", reward="stored"):
        raise NotImplementedError
"""
ENVIRONMENT_GROUP = "tcmrl.environments"


@pytest.fixture
def pole_recipe() -> str:
    """The recipe of point-robot, for another environment, whose tasks have no order."""
    file = ENVIRONMENTS.get("point-robot").recipe_file("point-robot")
    text = file.read_text(encoding="utf-8").replace('name = "point-robot"', 'name = "pole"')
    return text.replace('split = "strata"', 'split = "permutation"')


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages with an environment family, and one that raises."""
    monkeypatch.syspath_prepend(str(tmp_path))
    for module in ("users_pole", "users_broken"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    modules = {"users_pole": POLE, "users_broken": "raise RuntimeError('out of order')"}
    lines = "pole = users_pole:Pole\nrusty = users_broken:Rusty"
    install(tmp_path, "users-package", modules=modules, declares={ENVIRONMENT_GROUP: lines})
    return tmp_path


def test_an_environment_of_another_package_brings_its_recipe(site: Path, pole_recipe: str) -> None:
    (site / "pole.toml").write_text(pole_recipe)
    recipe = load_recipe("pole/long", profile="quick")
    assert recipe.make_environment().name == "pole/long"
    with pytest.raises(UnknownNameError, match="unknown environment 'pole/lang'; did you mean pole/long"):
        load_recipe("pole/lang")
    with pytest.raises(UnknownNameError, match="unknown environment 'pole'; did you mean pole/"):
        load_recipe("pole")


def test_the_package_of_a_plugin_is_part_of_the_platform(site: Path, pole_recipe: str) -> None:
    (site / "pole.toml").write_text(pole_recipe)
    environment = load_recipe("pole/long", profile="quick").make_environment()
    assert this_platform(environment, "sac").packages["users-package"] == "1.0"
    assert "tcmrl" not in this_platform(environment, "sac").packages


def test_envs_lists_broken_environments_with_their_errors_beside_all_others(
    site: Path, pole_recipe: str, capsys: pytest.CaptureFixture[str]
) -> None:
    ours = [row["name"] for row in list_environments().environments]
    (site / "pole.toml").write_text(pole_recipe)
    call = in_process(data, capsys)
    code, output, _ = call("envs", "--json")
    listed = json.loads(output)
    assert (code, list(listed["broken"])) == (0, ["rusty"])
    assert "package 'users-package' is broken: RuntimeError: out of order" in listed["broken"]["rusty"]
    assert [row["name"] for row in listed["environments"]] == sorted([*ours, "pole/long", "pole/short"])
    code, output, _ = call("envs")
    assert (code, output.count("broken: environment 'rusty' of package")) == (0, 1)
    assert_refused(
        call("build", "rusty", "--plan"), "environment 'rusty' of package 'users-package' is broken"
    )


def test_an_environment_whose_recipe_does_not_load_is_listed_as_broken(site: Path) -> None:
    (site / "pole.toml").write_text("schema = 99")
    broken = list_environments().broken
    assert list(broken) == ["rusty", "pole/long", "pole/short"]
    assert "schema 99 is not 1" in broken["pole/long"]


def test_a_family_with_members_of_another_name_is_broken(site: Path) -> None:
    (site / "users_pole.py").write_text(POLE.replace("pole/short", "point-robot"))
    assert "has the member 'point-robot' outside 'pole'" in ENVIRONMENTS.broken()["pole"]
    assert ENVIRONMENTS.get("point-robot").name == "point-robot"


@pytest.mark.parametrize(
    ("option", "error"),
    [
        (["build", "point-robot", "--engine", "rya"], "unknown engine 'rya'; did you mean ray"),
        (["build", "point-robot", "--behavior", "sack"], "unknown behavior source 'sack'; did you mean sac"),
        (["export", "nowhere", "--format", "hdf"], "unknown format 'hdf'; did you mean hdf5"),
    ],
)
def test_an_option_refuses_a_name_that_nobody_declares(
    option: list[str], error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(in_process(data, capsys)(*option), error)
