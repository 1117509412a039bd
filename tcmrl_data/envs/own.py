"""A user's own environment: a new package for one, one in a file without a package, and its check."""

import functools
import importlib.util
import os
import re
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np

from tcmrl_data.envs.base import ENVIRONMENTS, Environment, draw_tasks
from tcmrl_data.envs.rollout import FloatArray
from tcmrl_data.foundation.errors import PluginError, SimulationError
from tcmrl_data.foundation.plugins import one_line_error

OWN_ENVIRONMENTS = "TCMRL_ENVIRONMENTS"
"""Environments in files, as FILE.py:CLASS, separated by commas; worker processes inherit it."""

CHECK_SEED = 0


class FileEntry(EntryPoint):
    """An environment in a file, found as if an installed package declared it."""

    def load(self) -> Any:
        return _load(self.value)


def own_entries() -> list[FileEntry]:
    """The environments that `TCMRL_ENVIRONMENTS` names; imports their files.

    Raises:
        PluginError: a file cannot be imported, or holds no such class.
    """
    targets = filter(None, os.environ.get(OWN_ENVIRONMENTS, "").split(","))
    return [FileEntry(_load(target).name, target, "tcmrl.environments") for target in targets]


def declare_file(target: str) -> str:
    """Makes the class of FILE.py:CLASS an environment of this process and its workers; returns its name.

    Raises:
        PluginError: the file cannot be imported, or holds no such class.
    """
    file, _, name = target.rpartition(":")
    full = f"{Path(file).resolve()}:{name}"
    found: str = _load(full).name
    others = [other for other in os.environ.get(OWN_ENVIRONMENTS, "").split(",") if other and other != full]
    os.environ[OWN_ENVIRONMENTS] = ",".join([*others, full])
    return found


@functools.cache
def _load(target: str) -> Any:
    file, _, name = target.rpartition(":")
    module = f"tcmrl_own_{Path(file).stem}"
    spec = importlib.util.spec_from_file_location(module, file)
    if spec is None or spec.loader is None or not Path(file).is_file():
        raise PluginError(f"{file} is no Python file; name an environment as FILE.py:CLASS")
    loaded = sys.modules[module] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(loaded)
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        raise PluginError(f"{file} cannot be imported: {one_line_error(error)}") from error
    environments = {
        key: value
        for key, value in vars(loaded).items()
        if isinstance(value, type) and issubclass(value, Environment) and value.__module__ == module
    }
    if name not in environments:
        known = ", ".join(environments) or "none: subclass tcmrl_data.envs.base.Environment"
        raise PluginError(f"{file} has no environment {name!r}; its environments are {known}")
    if not isinstance(getattr(environments[name], "name", None), str):
        raise PluginError(f'{file}: class {name} has no name; write for example name = "my-env"')
    return environments[name]


def check_environment(environment: Environment) -> None:
    """Plays two episodes of uniform actions in the first task, with one seed, and looks at every step.

    Raises:
        SimulationError: the environment is not what it declares; the message names what to change.
    """
    place = f"environment {environment.name!r}"
    task = draw_tasks(environment)[0]
    first, second = (_play(environment, task.parameters, place) for _ in range(2))
    for name, one, other in zip(("observations", "rewards"), first, second, strict=True):
        if not np.array_equal(one, other):
            raise SimulationError(
                f"{place}: two episodes with one seed and the same actions differ in their {name}; "
                "draw random numbers from self.np_random, which reset(seed=...) seeds"
            )
    oracle = environment.oracle([task.parameters])
    if oracle is not None:
        noise = oracle.draw_noise(np.random.default_rng(CHECK_SEED), 1, environment.action_dim)
        actions = oracle.act(first[0][:1], noise)
        if np.shape(actions) != (1, environment.action_dim):
            raise SimulationError(
                f"{place}: oracle() acts with shape {np.shape(actions)}; "
                f"return one row of {environment.action_dim} numbers per task"
            )


def _play(environment: Environment, parameters: Any, place: str) -> tuple[FloatArray, FloatArray]:
    task = environment.make(parameters, view="full")
    try:
        return _steps(environment, task, place)
    finally:
        task.close()


def _steps(environment: Environment, task: Any, place: str) -> tuple[FloatArray, FloatArray]:
    _check_spaces(environment, task, place)
    draws, horizon = np.random.default_rng(CHECK_SEED), environment.settings.horizon
    observations, rewards = [_checked(environment, task.reset(seed=CHECK_SEED)[0], f"{place}: reset()")], []
    for t in range(horizon):
        at = f"{place}: step {t}"
        action = draws.uniform(-1.0, 1.0, environment.action_dim).astype(np.float32)
        observation, reward, terminated, truncated, info = task.step(action)
        observations.append(_checked(environment, observation, at))
        if np.size(np.asarray(reward)) != 1 or not np.isfinite(float(reward)):
            raise SimulationError(f"{at} returned the reward {reward!r}; return one finite number")
        rewards.append(float(reward))
        lacking = [name for name in environment.extras if name not in info]
        if lacking:
            raise SimulationError(f"{at}: info lacks {lacking[0]!r}, which `extras` declares")
        if terminated or truncated:
            break
    else:
        raise SimulationError(
            f"{place}: an episode goes on after {horizon} steps; truncate it at self.settings.horizon, "
            "for example by gymnasium.make(..., max_episode_steps=self.settings.horizon)"
        )
    return np.array(observations), np.array(rewards)


def _check_spaces(environment: Environment, task: Any, place: str) -> None:
    from gymnasium.spaces import Box

    for noun, space in (("action", task.action_space), ("observation", task.observation_space)):
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise SimulationError(
                f"{place}: its {noun}s are {space}; tcmrl takes vectors of real numbers only (Box with one "
                "dimension), neither discrete actions nor images"
            )
    size = task.action_space.shape
    if size != (environment.action_dim,):
        raise SimulationError(
            f"{place}: action_dim is {environment.action_dim}, but actions have shape {size}; "
            f"set action_dim = {size[0]}"
        )
    low, high = task.action_space.low.min(), task.action_space.high.max()
    if not (np.all(task.action_space.low == -1) and np.all(task.action_space.high == 1)):
        raise SimulationError(
            f"{place}: actions lie in [{low}, {high}], expected [-1, 1]; "
            "wrap it in gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))"
        )


def _checked(environment: Environment, observation: Any, at: str) -> FloatArray:
    found = np.asarray(observation)
    if found.shape != (environment.observation_dim,):
        raise SimulationError(
            f"{at} returned an observation of shape {found.shape}, but observation_dim is "
            f"{environment.observation_dim}; set observation_dim = {found.size}"
        )
    if not np.isfinite(found).all():
        raise SimulationError(f"{at} returned an observation with {found[~np.isfinite(found)][0]}")
    return found


NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def new_environment(name: str, out: Path) -> list[Path]:
    """Writes a package with an environment, its recipe and its tests, which builds as it stands.

    Args:
        name: of the environment, such as `mountain-car`.

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
