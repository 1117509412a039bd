"""Plug-ins that other packages declare: found by entry points, imported one at a time, broken ones named."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tcmrl_data.foundation.errors import PluginError, UnknownNameError
from tcmrl_data.foundation.plugins import Registry
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
    ids=[
        "raises",
        "lacks a module",
        "exits",
        "syntax",
        "no class",
        "wrong type",
        "instance",
        "name",
        "abstract",
    ],
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


def test_looking_one_up_imports_no_other_and_listing_imports_none(tmp_path: Path) -> None:
    source = "class Plugin:\n    name = {!r}\n"
    modules = {f"imports_{name}": source.format(name) for name in ("cat", "dog")}
    lines = "cat = imports_cat:Plugin\ndog = imports_dog:Plugin"
    install(tmp_path, "zoo", modules=modules, declares={GROUP: lines})
    script = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from tcmrl_data.foundation.plugins import Registry\n"
        f"animals = Registry({GROUP!r}, 'animal', object)\n"
        "animals.names()\n"
        "assert not {'imports_cat', 'imports_dog'} & set(sys.modules)\n"
        "animals.get('cat')\n"
        "assert {'imports_cat', 'imports_dog'} & set(sys.modules) == {'imports_cat'}\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
