"""Recording: every finished episode survives a crash, and the dataset is the one that no crash would give."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

from tcmrl_data import DatasetRecorder, open_dataset, verify_dataset
from tcmrl_data.foundation import disk as publish
from tcmrl_data.foundation.errors import LockedError, StoreError
from tcmrl_data.store.manifest import MANIFEST
from tests.simulated_disk import FAULTS, Fault, RecordingDisk, run_with_fault

LENGTH, PART = 4, 3


class Counter(gymnasium.Env[Any, Any]):
    """Counts its steps; episode n starts at 100 n, and every second one ends by itself."""

    observation_space = Box(-np.inf, np.inf, (2,), np.float64)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, first: int = 0) -> None:
        self.number, self.time = first - 1, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.number, self.time = self.number + 1, 0
        return np.array([100.0 * self.number, 0.0]), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        ended, by_itself = self.time == LENGTH, self.number % 2 == 0
        observation = np.array([100.0 * self.number + self.time, action[0]])
        return observation, float(self.time), ended and by_itself, ended and not by_itself, {}


def play(recorder: DatasetRecorder, episodes: int, *, steps: int = LENGTH) -> None:
    for _ in range(episodes):
        recorder.reset()
        for step in range(steps):
            recorder.step(np.array([step / LENGTH], dtype=np.float32))


def record(out: Path, episodes: int, **options: Any) -> None:
    with DatasetRecorder(Counter(), out, part_episodes=PART, horizon=LENGTH, **options) as recorder:
        play(recorder, episodes)


def go_on(out: str | Path, episodes: int, done: Callable[[int], object] = lambda episodes: None) -> int:
    """Records up to a number of episodes, those of earlier attempts included; returns how many these are."""
    counter = Counter()
    with DatasetRecorder(counter, out, part_episodes=PART, horizon=LENGTH) as recorder:
        first = recorder.episodes
        counter.number = first - 1
        done(first)
        while recorder.episodes < episodes:
            play(recorder, 1)
            done(recorder.episodes)
    return first


def test_episodes_become_parts(tmp_path: Path) -> None:
    record(tmp_path / "data", 7, label="counted", parameters={"goal": 1.0})
    found = open_dataset(tmp_path / "data")
    assert [(key.step, found.entry(key).episodes) for key in found.parts] == [(0, 3), (12, 3), (24, 1)]
    assert (found.name, found.manifest.label, found.manifest.runs[0].kind) == (
        "foreign",
        "counted",
        "recorded",
    )
    assert found.tasks[0].parameters == {"goal": 1.0}
    first, second = found.trajectories(0, 0)[:2]
    np.testing.assert_array_equal(first.observations[:, 0], [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(second.actions[:, 0], [0, 0.25, 0.5, 0.75])
    assert [first.terminated[-1], first.truncated[-1]] == [True, False]
    assert [second.terminated[-1], second.truncated[-1]] == [False, True]
    assert found.part(0, 0).identity.policy is None
    assert verify_dataset(found.folder, level="deep", replay=1).findings == ()


def test_a_reset_truncates_the_open_episode(tmp_path: Path) -> None:
    with DatasetRecorder(Counter(), tmp_path / "data", horizon=LENGTH) as recorder:
        play(recorder, 2, steps=2)
        recorder.reset()
    episodes = open_dataset(tmp_path / "data").trajectories(0, 0)
    assert [(len(one), bool(one.truncated[-1])) for one in episodes] == [(2, True)] * 2


@pytest.mark.check
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_at_any_operation_loses_the_open_episode_alone(
    fault: Fault, memory: Path, sweep: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the process lives on after the fault, it ends the dataset with what it has."""
    recorder, ends = RecordingDisk(), []
    with monkeypatch.context() as patch:
        patch.setattr(publish, "disk", recorder)
        go_on(memory / "7", 7, lambda episodes: ends.append(len(recorder.log)))
    stride = max(1, sweep // 2)
    for at in range(FAULTS.index(fault) % stride, len(recorder.log), stride):
        out = memory / f"fault at {at}"
        status = run_with_fault(lambda: go_on(out, 7), at, fault)  # noqa: B023
        place = f"operation {at} of {len(recorder.log)}"
        assert status == (-signal.SIGKILL if fault in ("kill", "torn") else 1), place
        finished = max((number for number, end in enumerate(ends) if end <= at), default=0)
        if not (out / MANIFEST).exists():
            assert go_on(out, 7) >= finished, place
        found = open_dataset(out)
        kept = sum(found.entry(key).episodes for key in found.parts)
        assert kept >= finished, place
        if not (memory / str(kept)).exists():
            go_on(memory / str(kept), kept)
        assert found.manifest.root == open_dataset(memory / str(kept)).manifest.root, place
        assert verify_dataset(out).findings == (), place


def test_what_cannot_be_recorded_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "data"

    def environment(**spaces: Any) -> Counter:
        made = Counter()
        for name, space in spaces.items():
            setattr(made, name, space)
        return made

    for env, options, message in (
        (environment(action_space=Box(-2, 2, (1,))), {"horizon": 4}, "RescaleAction"),
        (environment(action_space=Discrete(3)), {"horizon": 4}, "others cannot be stored"),
        (environment(observation_space=Box(0, 1, (2, 2))), {"horizon": 4}, "FlattenObservation"),
        (environment(), {}, "pass horizon=N"),
        (environment(), {"horizon": 4, "part_episodes": 0}, "part_episodes must be 1 or more"),
        (environment(), {"horizon": 4, "environment": "point-robot"}, r"those of point-robot \(2, 2, 20\)"),
    ):
        with pytest.raises(StoreError, match=message):
            DatasetRecorder(env, out, **options)  # type: ignore[arg-type]
    assert not out.exists()
    with DatasetRecorder(environment(), out, horizon=2) as recorder:
        with pytest.raises(LockedError):
            DatasetRecorder(environment(), out, horizon=2)
        with pytest.raises(StoreError, match="longer than the horizon of 2 steps"):
            play(recorder, 1)
        play(recorder, 1, steps=2)
    assert [len(one) for one in open_dataset(out).trajectories(0, 0)] == [2]
    with pytest.raises(StoreError, match="exists and is not empty"):
        DatasetRecorder(environment(), out, horizon=2)
