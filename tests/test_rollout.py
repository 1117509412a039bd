from collections.abc import Sequence

import numpy as np
import pytest

from tcmrl_data import Controller, Lanes, UniformController, load_recipe, roll_out
from tcmrl_data.envs.base import Environment, EnvironmentLanes, LaneStep
from tcmrl_data.envs.trajectory import BoolArray, FloatArray


def roll(environment: Environment, lanes: Lanes, controller: Controller, seed: int = 0) -> list:
    noise = [np.random.default_rng([seed, lane]) for lane in range(lanes.num_lanes)]
    return roll_out(environment, lanes, controller, reset_seeds=range(lanes.num_lanes), noise=noise)


class Falling(Lanes):
    """Lane n terminates after n + 1 steps, or is truncated after 4; counts what reaches it."""

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
    """Asks for an action out of bounds and remembers how many lanes it saw, and what each step paid."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self.paid: list[float] = []

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        self.seen.append(len(observations))
        return np.full((len(observations), 2), 3.0)

    def observe(self, rewards: FloatArray, active: BoolArray) -> None:
        assert rewards[~active].sum() == 0
        self.paid.append(float(rewards.sum()))


@pytest.fixture
def environment() -> Environment:
    return load_recipe("point-robot").make_environment()


def test_episodes_end_where_they_end(environment: Environment) -> None:
    lanes, controller = Falling(), Recording()
    episodes = roll(environment, lanes, controller)
    assert [len(each) for each in episodes] == [1, 2, 3, 4, 4, 4]
    assert [bool(each.terminated[-1]) for each in episodes] == [True] * 4 + [False] * 2
    assert controller.paid == [6.0, 5.0, 4.0, 3.0]  # a controller may adapt within an episode
    assert [bool(each.truncated[-1]) for each in episodes] == [False] * 4 + [True] * 2
    assert [each.observations[-1, 0] for each in episodes] == [1, 2, 3, 4, 4, 4]
    assert [each.undiscounted_return for each in episodes] == [1, 2, 3, 4, 4, 4]
    assert lanes.stepped == [[0, 1, 2, 3, 4, 5], [1, 2, 3, 4, 5], [2, 3, 4, 5], [3, 4, 5]]


def test_the_controller_sees_every_lane_and_actions_are_stored_as_executed(environment: Environment) -> None:
    controller = Recording()
    episodes = roll(environment, Falling(), controller)
    assert controller.seen == [6, 6, 6, 6]
    assert all((each.actions == 1.0).all() for each in episodes)


def test_episodes_do_not_depend_on_their_neighbours(environment: Environment) -> None:
    tasks = [{"goal": [0.0, 1.0], "wind": [0.0, 0.0]}, {"goal": [1.0, 0.0], "wind": [0.01, 0.0]}]
    together = roll(environment, environment.lanes(tasks), UniformController())
    alone = roll(environment, environment.lanes(tasks[:1]), UniformController())
    assert np.array_equal(together[0].observations, alone[0].observations)
    assert not np.array_equal(together[0].actions, together[1].actions)


def test_the_numpy_batch_equals_single_environments(environment: Environment) -> None:
    tasks = [{"goal": [0.0, 1.0], "wind": [0.02, 0.0]}, {"goal": [1.0, 0.0], "wind": [0.01, -0.03]}]
    batch = roll(environment, environment.lanes(tasks), UniformController())
    single = roll(environment, EnvironmentLanes(environment, tasks, "stored"), UniformController())
    for left, right in zip(batch, single, strict=True):
        assert np.array_equal(left.observations, right.observations)
        assert np.array_equal(left.rewards, right.rewards)
        assert np.array_equal(left.truncated, right.truncated)


def test_lanes_can_be_used_again(environment: Environment) -> None:
    lanes = environment.lanes([{"goal": [0.0, 1.0], "wind": [0.02, 0.0]}] * 3)
    first, second = (roll(environment, lanes, UniformController()) for _ in range(2))
    assert all(np.array_equal(a.observations, b.observations) for a, b in zip(first, second, strict=True))
