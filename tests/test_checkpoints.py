from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tcmrl_data import Recipe, load_recipe
from tcmrl_data.behavior.base import BehaviorContext
from tcmrl_data.behavior.checkpoints import CheckpointFolder, TrainingState
from tcmrl_data.behavior.snapshot import Snapshot
from tcmrl_data.foundation.disk import CHECKPOINTS
from tcmrl_data.recipe.tasks import choose_tasks
from tests.conftest import TINY


class Interrupted(Exception):
    """Ends a training in the middle, like a kill."""


def folder(
    dataset: Path, *, key: str = "k", before: float = np.inf, seconds: float = 0.0
) -> CheckpointFolder:
    return CheckpointFolder(dataset, "task", key=key, before=before, seconds=seconds)


def trained(
    recipe: Recipe, dataset: Path, stop_at: int | None = None, seconds: float = 0.0
) -> Iterator[Snapshot]:
    """Snapshots of the recipe's third task, with a checkpoint at the end of every episode."""
    steps = 0

    def report(count: int) -> None:
        nonlocal steps
        steps += count
        if stop_at is not None and steps >= stop_at:
            raise Interrupted

    context = BehaviorContext(
        environment=recipe.make_environment(),
        tasks=choose_tasks(recipe, [2]),
        seed=0,
        observation="stored",
        reward="stored",
        report=report,
        checkpoints=lambda task: folder(dataset, seconds=seconds),
    )
    yield from (snapshot for _, snapshot in recipe.make_source().snapshots(context))


HOPPER = (*TINY, "behavior.sac.steps=300", "behavior.sac.snapshots=[0,200,300]")


@pytest.mark.parametrize(
    ("name", "overrides", "stop_at"),
    [
        ("point-robot", TINY, 30),
        ("point-robot", TINY, 130),
        ("hopper-rand-params", HOPPER, 250),
        ("point-robot", (*TINY, "behavior.sac.buffer_size=40", "behavior.sac.entropy=0.1"), 130),
    ],
)
def test_a_resumed_training_equals_an_uninterrupted_one(
    tmp_path: Path, name: str, overrides: tuple[str, ...], stop_at: int
) -> None:
    recipe = load_recipe(name, profile="quick", overrides=overrides)
    straight = {
        snapshot.step: snapshot.digest()
        for snapshot in trained(recipe, tmp_path / "straight", seconds=np.inf)
    }
    resumed: dict[int, str] = {}
    interrupted = trained(recipe, tmp_path, stop_at=stop_at)
    with pytest.raises(Interrupted):
        resumed.update((snapshot.step, snapshot.digest()) for snapshot in interrupted)
    state = folder(tmp_path).load()
    assert state is not None
    assert 0 < state.values["steps"] < stop_at
    later = {snapshot.step: snapshot.digest() for snapshot in trained(recipe, tmp_path)}
    assert set(later) == {step for step in straight if step > state.values["steps"]}
    assert resumed | later == straight


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[], Path]:
    def save() -> Path:
        folder(tmp_path).save(TrainingState({"steps": 10}, {"weights": np.arange(4.0)}))
        return tmp_path

    return save


def test_a_checkpoint_comes_back(saved: Callable[[], Path]) -> None:
    dataset = saved()
    state = folder(dataset).load()
    assert state is not None
    assert state.values == {"steps": 10}
    assert np.array_equal(state.arrays["weights"], np.arange(4.0))
    folder(dataset).clear()
    assert folder(dataset).load() is None


def test_the_last_one_replaces_the_others(saved: Callable[[], Path]) -> None:
    dataset = saved()
    folder(dataset).save(TrainingState({"steps": 20}, {"weights": np.zeros(2)}))
    state = folder(dataset).load()
    assert state is not None
    assert state.values["steps"] == 20
    assert len(list((dataset / CHECKPOINTS / "task").iterdir())) == 1


@pytest.mark.parametrize("change", [{"key": "other recipe"}, {"before": 10}])
def test_a_checkpoint_of_other_settings_or_past_a_missing_part_is_ignored(
    saved: Callable[[], Path], change: dict[str, object]
) -> None:
    assert folder(saved(), **change).load() is None  # type: ignore[arg-type]


def test_a_damaged_checkpoint_is_ignored(saved: Callable[[], Path]) -> None:
    dataset = saved()
    (file,) = (dataset / CHECKPOINTS / "task").iterdir()
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    assert folder(dataset).load() is None
