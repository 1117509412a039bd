from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tcmrl_data import (
    Controller,
    Lanes,
    LaneTransition,
    Recorder,
    Trajectory,
    UniformController,
    load_recipe,
    roll_out,
)
from tcmrl_data.envs.base import Environment, LaneStep
from tcmrl_data.envs.rollout import BoolArray, FloatArray, ObservationView
from tests.environments import environment_of, parameters_of


def roll(environment: Environment, lanes: Lanes, controller: Controller, seed: int = 0) -> list:
    noise = [np.random.default_rng([seed, lane]) for lane in range(lanes.num_lanes)]
    return roll_out(environment, lanes, controller, reset_seeds=range(lanes.num_lanes), noise=noise)


class Falling(Lanes):
    """Lane n terminates after n + 1 steps, or is truncated after 4; records the lanes of every step."""

    num_lanes = 6

    def __init__(self) -> None:
        self.t = 0
        self.stepped: list[list[int]] = []

    def reset(self, seeds: Sequence[int]) -> FloatArray:
        self.t = 0
        return np.zeros((6, 2))

    def reset_lane(self, lane: int, seed: int) -> FloatArray:
        raise AssertionError("a rollout has one episode per lane")

    def step(self, actions: FloatArray, active: BoolArray) -> LaneStep:
        self.t += 1
        self.stepped.append(np.flatnonzero(active).tolist())
        terminated = active & (np.arange(6) + 1 == self.t)
        truncated = active & ~terminated & (self.t == 4)
        return LaneStep(np.full((6, 2), self.t), np.where(active, 1.0, 0.0), terminated, truncated, {})

    def close(self) -> None:
        pass


class Recording(Controller):
    """Returns actions out of bounds; records the number of lanes, and every step."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self.transitions: list[LaneTransition] = []

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        self.seen.append(len(observations))
        return np.full((len(observations), 2), 3.0)

    def observe(self, transition: LaneTransition) -> None:
        self.transitions.append(transition)


@pytest.fixture
def environment() -> Environment:
    return load_recipe("point-robot").make_environment()


def test_episodes_end_where_they_end(environment: Environment) -> None:
    lanes, controller = Falling(), Recording()
    episodes = roll(environment, lanes, controller)
    assert [len(episode) for episode in episodes] == [1, 2, 3, 4, 4, 4]
    assert [bool(episode.terminated[-1]) for episode in episodes] == [True] * 4 + [False] * 2
    assert [bool(episode.truncated[-1]) for episode in episodes] == [False] * 4 + [True] * 2
    assert [episode.observations[-1, 0] for episode in episodes] == [1, 2, 3, 4, 4, 4]
    assert [episode.undiscounted_return for episode in episodes] == [1, 2, 3, 4, 4, 4]
    assert lanes.stepped == [[0, 1, 2, 3, 4, 5], [1, 2, 3, 4, 5], [2, 3, 4, 5], [3, 4, 5]]


def test_the_controller_sees_every_lane_and_every_step_as_it_was_executed(environment: Environment) -> None:
    controller = Recording()
    episodes = roll(environment, Falling(), controller)
    assert controller.seen == [6, 6, 6, 6]
    assert all((episode.actions == 1.0).all() for episode in episodes)  # clipped from 3.0
    assert all((step.actions == 1.0).all() for step in controller.transitions)
    assert [step.rewards.sum() for step in controller.transitions] == [6.0, 5.0, 4.0, 3.0]
    assert [step.active.sum() for step in controller.transitions] == [6, 5, 4, 3]
    for t, step in enumerate(controller.transitions):
        assert (step.observations == t).all() and (step.next_observations == t + 1).all()
        assert step.terminated.sum() == 1 and not step.rewards[~step.active].any()


class Reconstructing(Controller):
    """Draws actions from its noise, and records every step that it observes."""

    def __init__(self, view: ObservationView) -> None:
        self.view = view
        self.recorder = Recorder()
        self.lengths: list[list[int]] = []

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        self.lengths.append([len(trajectory) for trajectory in self.recorder.trajectories()])
        return 2 * noise

    def observe(self, transition: LaneTransition) -> None:
        self.recorder.record(transition)


def assert_rebuilt(controller: Reconstructing, stored: list[Trajectory], environment: Environment) -> None:
    rebuilt = controller.recorder.trajectories()
    assert len(rebuilt) == len(stored)
    for found, expected in zip(rebuilt, stored, strict=True):
        if controller.view == "full":
            found = replace(found, observations=environment.stored_view(found.observations))
        for name in ("observations", "actions", "rewards", "terminated", "truncated"):
            ours, theirs = getattr(found, name), getattr(expected, name)
            assert ours.dtype == theirs.dtype
            assert np.array_equal(ours, theirs), name


def test_a_controller_rebuilds_the_stored_trajectories_of_lanes_that_end_early(
    environment: Environment,
) -> None:
    controller = Reconstructing("stored")
    stored = roll(environment, Falling(), controller)
    assert [len(trajectory) for trajectory in stored] == [1, 2, 3, 4, 4, 4]
    assert_rebuilt(controller, stored, environment)
    assert controller.lengths == [[], [1] * 6, [1, *[2] * 5], [1, 2, *[3] * 4]]  # within the episode


@pytest.mark.parametrize("view", ["stored", "full"])
def test_a_controller_rebuilds_the_stored_trajectories_in_either_view(view: ObservationView) -> None:
    environment = environment_of("ml1/reach", "environment.horizon=4")
    controller = Reconstructing(view)
    stored = roll(environment, environment.lanes(parameters_of("ml1/reach")[:2]), controller)
    assert_rebuilt(controller, stored, environment)
    goals = [trajectory.observations[:, -3:] for trajectory in controller.recorder.trajectories()]
    assert all(np.any(goal != 0) == (view == "full") for goal in goals)


def test_recorded_steps_are_copies() -> None:
    recorder, array, active = Recorder(), np.ones((1, 2), np.float32), np.ones(1, dtype=bool)
    recorder.record(LaneTransition(array, array, array[:, 0], array, ~active, ~active, active))
    array[:] = 7.0
    (trajectory,) = recorder.trajectories()
    assert (trajectory.observations == 1.0).all() and (trajectory.actions == 1.0).all()
    assert (trajectory.rewards == 1.0).all()


def test_episodes_do_not_depend_on_their_neighbours(environment: Environment) -> None:
    tasks = [{"goal": [0.0, 1.0], "wind": [0.0, 0.0]}, {"goal": [1.0, 0.0], "wind": [0.01, 0.0]}]
    together = roll(environment, environment.lanes(tasks), UniformController())
    alone = roll(environment, environment.lanes(tasks[:1]), UniformController())
    assert np.array_equal(together[0].observations, alone[0].observations)
    assert not np.array_equal(together[0].actions, together[1].actions)


def test_lanes_can_be_used_again(environment: Environment) -> None:
    lanes = environment.lanes([{"goal": [0.0, 1.0], "wind": [0.02, 0.0]}] * 3)
    first, second = (roll(environment, lanes, UniformController()) for _ in range(2))
    assert all(np.array_equal(a.observations, b.observations) for a, b in zip(first, second, strict=True))
