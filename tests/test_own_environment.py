"""An environment of one's own: from `new` to an adapted policy, and what is refused before training."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import tcmrl_cli.data
import tcmrl_cli.train
from gymnasium.spaces import Box, Discrete

import tcmrl_data
from tcmrl_data.envs.base import Environment, EnvironmentSettings
from tcmrl_data.envs.own import OWN_ENVIRONMENTS, check_environment
from tcmrl_data.foundation.errors import PluginError, SimulationError
from tests.commands import in_process

SMALL = [
    word
    for value in (
        "behavior.sac.steps=40",
        "behavior.sac.warmup=20",
        "behavior.sac.snapshots=[0, 40]",
        "behavior.sac.batch_size=16",
        "environment.horizon=20",
        "rollouts.episodes=4",
        "rollouts.lanes=4",
    )
    for word in ("--set", value)
]


@pytest.fixture
def _own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forgets the environments in files that a test declares."""
    monkeypatch.setenv(OWN_ENVIRONMENTS, "")


@pytest.mark.check
@pytest.mark.usefixtures("_own")
def test_a_new_environment_builds_trains_and_adapts_from_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    data, learn = in_process(tcmrl_cli.data.data, capsys), in_process(tcmrl_cli.train.tcmrl, capsys)
    code, output, _ = data("new", "mountain-car")
    assert code == 0
    assert "mountain-car/mountain_car/environment.py" in output
    target = "mountain-car/mountain_car/environment.py:MountainCar"
    assert data("build", target, "--profile", "quick", "--out", "d", "--engine", "local", *SMALL)[0] == 0
    dataset = tcmrl_data.open_dataset("d")
    assert (dataset.environment.name, len(dataset.tasks)) == ("mountain-car", 8)
    small = [word for value in ("run.steps=10", "batch.transitions=8") for word in ("--set", value)]
    assert learn("train", "d", "--out", "r", *small)[0] == 0
    assert "adapted" in learn("evaluate", "r")[1]
    monkeypatch.setenv(OWN_ENVIRONMENTS, "")
    code, _, errors = learn("evaluate", "r")
    assert code == 2
    assert f"export {OWN_ENVIRONMENTS}=" in errors


@pytest.mark.parametrize(
    ("name", "problem"),
    [("Mountain Car", "no name of an environment"), ("point-robot", "is installed already")],
)
def test_a_name_that_cannot_be_used_is_refused(name: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(PluginError, match=problem):
        tcmrl_data.new_environment(name, tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.usefixtures("_own")
@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("1 / 0", "cannot be imported: ZeroDivisionError"),
        ("class Other: pass", "has no environment 'Mine'"),
        (
            "from tcmrl_data.envs.base import Environment\nclass Mine(Environment): pass",
            "class Mine has no name",
        ),
    ],
)
def test_a_file_without_the_environment_is_named(content: str, problem: str, tmp_path: Path) -> None:
    file = tmp_path / f"file_{abs(hash(content))}.py"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(PluginError, match=problem):
        tcmrl_data.load_recipe(f"{file}:Mine")


class Task(gymnasium.Env[Any, Any]):
    """A sound task of ten steps, whose parts a test replaces."""

    observation_space = Box(-np.inf, np.inf, (2,), np.float32)
    action_space: gymnasium.Space[Any] = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        return self.observation(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self.observation(), self.reward(), False, self.steps == 10, {}

    def observation(self) -> Any:
        return self.np_random.normal(size=2).astype(np.float32)

    def reward(self) -> Any:
        return 1.0


class Own(Environment):
    name = "own"
    observation_dim = 2
    action_dim = 1
    task: type[Task] = Task

    def draw_parameters(self, num_tasks: int, task_seed: int) -> list[dict[str, Any]]:
        return [{"number": number} for number in range(num_tasks)]

    def make(self, parameters: Any, **options: Any) -> gymnasium.Env[Any, Any]:
        return self.task()


class Unseeded(Task):
    def observation(self) -> Any:
        return np.random.default_rng().normal(size=2)


class NotANumber(Task):
    def reward(self) -> Any:
        return np.nan if self.steps == 3 else 1.0


class Endless(Task):
    def step(self, action: Any) -> Any:
        return self.observation(), 1.0, False, False, {}


class Wide(Task):
    action_space = Box(-2.0, 2.0, (1,), np.float32)


class Choices(Task):
    action_space = Discrete(3)


class Longer(Task):
    def observation(self) -> Any:
        return np.zeros(3)


@pytest.mark.parametrize(
    ("task", "problem"),
    [
        (Unseeded, "differ in their observations; draw random numbers from self.np_random"),
        (NotANumber, "step 2 returned the reward nan"),
        (Endless, r"goes on after 10 steps; truncate it at self\.settings\.horizon"),
        (Wide, r"actions lie in \[-2\.0, 2\.0\], expected \[-1, 1\]; wrap it in gymnasium\.wrappers"),
        (Choices, r"its actions are Discrete\(3\); tcmrl takes vectors of real numbers only"),
        (Longer, r"shape \(3,\), but observation_dim is 2; set observation_dim = 3"),
    ],
)
def test_what_would_be_found_hours_later_is_found_before_training(task: type[Task], problem: str) -> None:
    environment = Own(EnvironmentSettings(name="own", tasks=4, train=3, horizon=10))
    check_environment(environment)
    environment.task = task
    with pytest.raises(SimulationError, match=problem):
        check_environment(environment)


def test_gymnasiums_own_pictures_serve_a_film() -> None:
    class Drawn(Task):
        render_mode = "rgb_array"

        def render(self) -> Any:
            return np.full((4, 6, 3), 7, dtype=np.uint8)

    environment = Own(EnvironmentSettings(name="own", tasks=4, train=3, horizon=10))
    assert environment.camera(Task(), {}, width=6, height=4) is None
    camera = environment.camera(Drawn(), {}, width=6, height=4)
    assert camera is not None
    assert camera.picture(np.zeros((1, 2))).tolist() == np.full((4, 6, 3), 7).tolist()
