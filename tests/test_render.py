"""`render`: stored episodes played again, compared, and drawn."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import tcmrl_data
from tcmrl_data import Dataset, FigureCamera, RenderingError, Trajectory, render_episode
from tcmrl_data.describe.film import StoredEpisode, film, find_episode
from tcmrl_data.envs.base import ENVIRONMENTS, Environment
from tcmrl_data.envs.rollout import UniformController
from tcmrl_data.envs.simulation import SimulatedTask, find_open_gl
from tcmrl_data.foundation.errors import SelectionError, SimulationError
from tcmrl_data.store.tables import PartKey
from tests.commands import Call, assert_refused
from tests.conftest import SIMULATED
from tests.environments import environment_of, episodes, parameters_of, some_members

pytestmark = pytest.mark.usefixtures("module_in_process")

NAMES = [name for family in ENVIRONMENTS.working().values() for name in some_members(family)[:1]]
TASK = 40


def stored_episode(name: str) -> tuple[Environment, StoredEpisode]:
    """An episode of uniform actions in the first task, which was reset with seed 0."""
    environment, parameters = environment_of(name, "environment.horizon=8"), parameters_of(name)[0]
    (trajectory,) = episodes(environment, UniformController(), [parameters])
    return environment, StoredEpisode(PartKey(0, 0), 0, parameters, trajectory, reset_seed=0)


def changed(episode: StoredEpisode, name: str, step: int) -> StoredEpisode:
    """The episode with another value of an array at a step."""
    array = getattr(episode.trajectory, name).copy()
    array[step] = ~array[step] if array.dtype == bool else np.nextafter(array[step], np.float32(np.inf))
    return dataclasses.replace(episode, trajectory=dataclasses.replace(episode.trajectory, **{name: array}))


@pytest.mark.check
@pytest.mark.parametrize("name", NAMES)
def test_every_environment_gives_pictures_of_an_episode_that_comes_back(name: str) -> None:
    environment, episode = stored_episode(name)
    task = environment.make(episode.parameters)
    if isinstance(task, SimulatedTask) and find_open_gl() is None:
        pytest.skip("no OpenGL works on this machine")
    task.close()
    frames = film(environment, episode, frames=3, width=96)
    steps = len(episode.trajectory)
    assert [frame.steps for frame in frames] == [0, round(steps / 2), steps]
    assert frames[-1].reward == pytest.approx(episode.trajectory.undiscounted_return)
    for frame in frames:
        assert (frame.picture.shape, frame.picture.dtype) == ((72, 96, 3), np.uint8)
        assert frame.picture.std() > 1
    assert (frames[0].picture != frames[-1].picture).any()


@pytest.mark.parametrize(
    ("name", "step"), [("observations", 0), ("observations", 5), ("rewards", 3), ("truncated", 2)]
)
def test_an_episode_that_does_not_come_back_is_refused_with_its_first_step(name: str, step: int) -> None:
    environment, episode = stored_episode("point-robot")
    film(environment, episode, frames=1, width=64)
    with pytest.raises(SimulationError, match=rf"{name.rstrip('s')} differs first at step {step}$"):
        film(environment, changed(episode, name, step), frames=1, width=64)


def test_an_environment_without_a_camera_is_refused() -> None:
    environment, episode = stored_episode("point-robot")
    environment.camera = lambda *_, **__: None  # type: ignore[method-assign]
    with pytest.raises(RenderingError, match="'point-robot' has no picture; give its class a method"):
        film(environment, episode, frames=1, width=64)


def test_a_film_shows_every_step(call: Call, tiny: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "film.webp"
    code, output, _ = call("render", tiny.folder, "--task", TASK, "--episode", 2, "--out", file, "--json")
    document = json.loads(output)
    stored = tiny.trajectories(TASK, 150)[2]
    assert code == 0
    assert document == {
        "file": str(file),
        "task": TASK,
        "step": 150,
        "run": "main",
        "episode": 2,
        "steps": 20,
        "reward": stored.undiscounted_return,
        "frames": 21,
        "bytes": file.stat().st_size,
    }
    assert file.stat().st_size < 60_000
    with Image.open(file) as film_file:
        assert (film_file.format, film_file.n_frames, film_file.width) == ("WEBP", 21, 320)  # type: ignore[attr-defined]


def test_a_strip_has_stills_side_by_side(call: Call, tiny: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "strip.png"
    options = ("--step", 100, "--frames", 3, "--width", 160, "--out", file)
    code, output, errors = call("render", tiny.folder / "manifest.json", "--task", TASK, *options)
    assert (code, "equal bit for bit; 3 frames" in output) == (0, True), errors
    with Image.open(file) as strip:
        assert (strip.format, strip.size) == ("PNG", (3 * 164, 120 + 2 * 14))


def test_a_film_for_slides(tiny: Dataset, tmp_path: Path) -> None:
    render_episode(tiny, tmp_path / "film.gif", task=TASK, frames=4, width=66)
    with Image.open(tmp_path / "film.gif") as film_file:
        assert (film_file.format, film_file.n_frames, film_file.width) == ("GIF", 4, 64)  # type: ignore[attr-defined]


def test_bad_input_writes_nothing(call: Call, tiny: Dataset, tmp_path: Path) -> None:
    def refused(name: str, *options: object) -> tuple[int, str, str]:
        return call("render", tiny.folder, "--quiet", "--out", tmp_path / name, *options)

    assert_refused(refused("film.mp4", "--task", TASK), "film.mp4", ".webp, .png, .gif")
    assert_refused(refused("film.webp", "--task", 1), "no task 1")
    assert_refused(refused("film.webp", "--task", TASK, "--step", 99), "its steps are [0, 100, 150]")
    assert_refused(refused("film.webp", "--task", TASK, "--run", "more"), "no part of that run")
    assert_refused(refused("film.webp", "--task", TASK, "--episode", 6), "has 6 episodes")
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_with_other_numbers_is_refused(
    call: Call, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(self: Dataset, task: int, step: int, run: str = "main") -> list[Trajectory]:
        found = original(self, task, step, run)
        found[0].observations[4] += np.float32(1e-7)
        return found

    original = Dataset.trajectories
    monkeypatch.setattr(Dataset, "trajectories", other)
    result = call("render", tiny.folder, "--task", TASK, "--out", tmp_path / "film.webp", "--quiet")
    place = f"{tiny.folder}: task {TASK}, step 150, run main, episode 0"
    assert_refused(result, f"{place}: does not replay, its observation differs first at step 4", "--deep")
    assert list(tmp_path.iterdir()) == []


def test_imported_episodes_have_no_seed(tiny: Dataset, tmp_path: Path) -> None:
    exported = tmp_path / "exported"
    files = tcmrl_data.export_dataset(tiny, "hdf5", exported, tasks=[0, TASK], snapshots="last").files
    tcmrl_data.import_dataset("hdf5", files, tmp_path / "imported", environment="point-robot")
    imported = tcmrl_data.open_dataset(tmp_path / "imported")
    key = next(iter(imported.parts))
    with pytest.raises(RenderingError, match=r"the seeds of the episodes of .* are not known"):
        render_episode(imported, tmp_path / "film.webp", task=key.task, run=key.run)


@pytest.fixture(params=["egl", "disabled"])
def chosen(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A value of MUJOCO_GL where no OpenGL works: PyOpenGL is told to use what MuJoCo has no context for."""
    monkeypatch.setenv("MUJOCO_GL", request.param)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "nothing")
    find_open_gl.cache_clear()
    yield request.param
    find_open_gl.cache_clear()


def test_without_open_gl_a_line_says_what_to_install(chosen: str) -> None:
    environment, trajectory = environment_of("half-cheetah-vel"), stored_episode("point-robot")[1].trajectory
    episode = StoredEpisode(PartKey(0, 0), 0, {"velocity": 1.0}, trajectory, reset_seed=0)
    expected = "MUJOCO_GL=egl does not work" if chosen == "egl" else "no OpenGL works here"
    with pytest.raises(RenderingError, match=rf"{expected} .* install libegl1 .*, or libosmesa6"):
        film(environment, episode, frames=1, width=64)


@pytest.mark.check
@pytest.mark.parametrize("kind", ["egl", "osmesa"])
def test_a_process_that_draws_ends_without_a_word(kind: str, tmp_path: Path) -> None:
    script = (
        "from tests.test_render import *\n"
        "if find_open_gl() is None: sys.exit(3)\n"
        "film(*stored_episode('half-cheetah-vel'), frames=2, width=64)\n"
    )
    environment = {"MUJOCO_GL": kind, "PATH": "/usr/bin:/bin", "PYTHONWARNINGS": "error::ResourceWarning"}
    root = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode == 3:
        pytest.skip(f"{kind} does not work on this machine")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


class Blank(FigureCamera):
    """Draws nothing, so that no OpenGL is needed."""

    def draw(self, axes: Any, observations: Any) -> None:
        pass


@pytest.mark.check
def test_derived_parts_start_again_from_the_seeds_of_their_sources(tmp_path: Path) -> None:
    recipe = tcmrl_data.load_recipe("half-cheetah-vel", profile="quick", overrides=SIMULATED)
    built, more, other, less = (tmp_path / name for name in ("built", "more", "other", "less"))
    assert tcmrl_data.build_dataset(recipe, built, tasks=[0, 1], workers=2).failed == ()
    tcmrl_data.extend_dataset(built, out=more, episodes=4, workers=2)
    pair = {"to": [0], "tasks": [1], "allow_test": True}
    tcmrl_data.relabel_dataset(built, other, workers=1, **pair)  # type: ignore[arg-type]
    tcmrl_data.derive_dataset(more, less, episodes=2, seed=5)
    filmed = 0
    for folder in (built, more, other, less):
        dataset = tcmrl_data.open_dataset(folder)
        environment = dataset.environment
        environment.camera = lambda *_, width, height: Blank(width, height)  # type: ignore[method-assign]
        for key in dataset.parts:
            for number in range(len(dataset.trajectories(*key))):
                film(environment, find_episode(dataset, key, number), frames=1, width=64)
                filmed += 1
    assert filmed == 16 + 24 + 8 + 12
    with pytest.raises(SelectionError, match="4 episodes"):
        find_episode(tcmrl_data.open_dataset(built), PartKey(0, 60), 4)
