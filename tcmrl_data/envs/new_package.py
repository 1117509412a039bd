"""The files of a package with an environment of one's own, from templates."""

import re
from pathlib import Path

from tcmrl_data.envs.base import ENVIRONMENTS
from tcmrl_data.foundation.errors import PluginError

NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def new_environment(name: str, out: Path) -> list[Path]:
    """Writes a package with an environment, its recipe and its tests, which builds as it stands.

    Args:
        name: of the environment, such as `mountain-car`.
        out: a folder that does not exist yet.

    Returns:
        The files written, in the order in which they are read.

    Raises:
        PluginError: no such name is allowed, it is taken, or `out` exists.
    """
    import jinja2

    if not NAME.fullmatch(name):
        raise PluginError(
            f"{name!r} is no name of an environment; use small letters, digits and -, such as my-env"
        )
    if name in ENVIRONMENTS.names():
        raise PluginError(f"an environment {name!r} is installed already; choose another name")
    if out.exists():
        raise PluginError(f"{out} exists; choose another --out")
    package = name.replace("-", "_")
    files = {
        f"{package}/environment.py": "environment.py.jinja",
        f"{package}/{name}.toml": "recipe.toml.jinja",
        "tests/test_environment.py": "test_environment.py.jinja",
        "pyproject.toml": "pyproject.toml.jinja",
        "README.md": "README.md.jinja",
    }
    templates = jinja2.Environment(  # Python and TOML, not HTML
        loader=jinja2.PackageLoader("tcmrl_data.envs", "new"),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
    )
    values = {"name": name, "package": package, "class_name": "".join(map(str.capitalize, name.split("-")))}
    (out / package).mkdir(parents=True)
    (out / "tests").mkdir()
    (out / package / "__init__.py").touch()
    for file, template in files.items():
        (out / file).write_text(templates.get_template(template).render(values), encoding="utf-8")
    return [out / file for file in files]
