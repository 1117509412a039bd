"""Protocols of adaptation, the arena in which they adapt, and the contexts of other tasks."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from torch import Tensor

from tcmrl_algo import PROTOCOLS, Capabilities
from tcmrl_algo.algorithms.core.problem import TaskParameters
from tcmrl_algo.evaluation.evaluate import contexts_of_others
from tcmrl_algo.evaluation.protocols.non_prior import num_uniform_steps
from tcmrl_data import Controller, Dataset, TrainingError, Trajectory
from tests.adapters import GOALS, GoalController, GoalReader, GoalSeeker, arena, oracle

STATEFUL = Capabilities(stateful=True, needs_trajectories=False)


@pytest.fixture
def two_tests(tiny: Dataset) -> Dataset:
    """The tiny dataset with a second test task."""
    dataset = Dataset(tiny.folder, tiny.manifest)
    dataset.tasks = tuple(replace(task, split="test") if task.index == 40 else task for task in tiny.tasks)
    return dataset


@pytest.mark.parametrize("protocol", PROTOCOLS.names())
def test_a_perfect_adapter_reaches_the_oracle_under_every_protocol(two_tests: Dataset, protocol: str) -> None:
    algorithm = GoalReader()
    place = arena(two_tests, algorithm, episodes=5, random_episodes=2)
    adaptations = PROTOCOLS.get(protocol)().adapt(place, two_tests.test_tasks)
    assert len(adaptations) == 2
    for task, adaptation in zip(two_tests.test_tasks, adaptations, strict=True):
        assert len(adaptation.returns) == 5
        assert adaptation.returns[-1] == pytest.approx(oracle(two_tests, task), abs=0.05)


def test_paper_protocol_acts_randomly_first_and_lets_the_context_grow(two_tests: Dataset) -> None:
    algorithm = GoalReader()
    place = arena(two_tests, algorithm, episodes=5, random_episodes=2)
    adaptations = PROTOCOLS.get("paper")().adapt(place, two_tests.test_tasks)
    assert algorithm.seen == [[2, 2], [3, 3], [4, 4]]
    for task, adaptation in zip(two_tests.test_tasks, adaptations, strict=True):
        assert max(adaptation.returns[:2]) < oracle(two_tests, task) - 2
        assert len(adaptation.contexts[0]) == 5


def test_offline_protocol_draws_stored_trajectories_of_the_task_itself(two_tests: Dataset) -> None:
    place = arena(two_tests, GoalReader(), episodes=3, offline_trajectories=2)
    adaptations = PROTOCOLS.get("offline")().adapt(place, two_tests.test_tasks)
    for task, adaptation in zip(two_tests.test_tasks, adaptations, strict=True):
        stored = {
            trajectory.rewards.tobytes()
            for trajectory in two_tests.select(tasks=[task.index]).trajectories(task.index)
        }
        drawn = [[trajectory.rewards.tobytes() for trajectory in context] for context in adaptation.contexts]
        assert [len(set(context)) for context in drawn] == [2, 2, 2]
        assert all(set(context) <= stored for context in drawn)
        assert len({tuple(context) for context in drawn}) > 1


def test_stored_contexts_come_from_the_snapshots_of_contexts(two_tests: Dataset) -> None:
    (task, *_) = two_tests.test_tasks
    place = arena(two_tests, GoalReader(), context_snapshots="last", offline_trajectories=6)
    last = two_tests.select(tasks=[task.index], snapshots="last").trajectories(task.index)
    stored = {trajectory.rewards.tobytes() for trajectory in place.stored(task, draw=0)}
    assert stored == {trajectory.rewards.tobytes() for trajectory in last}


def test_idaq_protocol_tries_training_contexts_and_keeps_the_best(two_tests: Dataset) -> None:
    place = arena(two_tests, GoalReader(), episodes=5)
    adaptations = PROTOCOLS.get("idaq")().adapt(place, two_tests.test_tasks)
    training = [oracle(two_tests, task) for task in two_tests.train_tasks]
    assert len(training) == 3
    for task, adaptation in zip(two_tests.test_tasks, adaptations, strict=True):
        # three training goals are tried, then the goal that the best of the episodes shows
        assert max(adaptation.returns[:3]) < oracle(two_tests, task) - 0.2
        assert adaptation.returns[3] == pytest.approx(oracle(two_tests, task), abs=0.05)
        assert len(adaptation.contexts) == len(adaptation.contexts[0]) == 1


def test_idaq_keeps_a_training_context_that_nothing_beats(two_tests: Dataset) -> None:
    class Stubborn(GoalReader):
        """Acts well under the first context it sees and badly under all others."""

        def adapt(
            self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
        ) -> Controller:
            self.seen.append([0])
            goal = [0.0, 1.0] if len(self.seen) == 1 else [0.0, -9.0]
            return GoalController(np.array([goal] * len(trajectories)))

    place = arena(two_tests, Stubborn(), episodes=5)
    adaptations = PROTOCOLS.get("idaq")().adapt(place, two_tests.test_tasks)
    first = place.stored(two_tests.train_tasks[0], draw=0)
    for adaptation in adaptations:
        assert adaptation.contexts[0] == first
        assert adaptation.returns[0] == max(adaptation.returns)


def test_idaq_keeps_the_first_of_equal_contexts(two_tests: Dataset) -> None:
    class Indifferent(GoalReader):
        def adapt(
            self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
        ) -> Controller:
            return GoalController(np.array([[0.0, 1.0]] * len(trajectories)))

    place = arena(two_tests, Indifferent(), episodes=5)
    first = place.stored(two_tests.train_tasks[0], draw=0)
    for adaptation in PROTOCOLS.get("idaq")().adapt(place, two_tests.test_tasks):
        assert len(set(adaptation.returns)) == 1
        assert adaptation.contexts[0] == first


def test_a_context_that_two_tasks_keep_is_not_another_tasks(two_tests: Dataset) -> None:
    place = arena(two_tests, GoalReader(), offline_trajectories=2)
    tests = two_tests.test_tasks
    shared = place.stored(two_tests.train_tasks[0], draw=0)
    own = {task.index: [shared] for task in tests}
    (borrowed,) = contexts_of_others(place, tests[0], own)[:1]
    assert all(trajectory is not mine for trajectory in borrowed for mine in shared)


def test_contexts_of_others_are_never_the_tasks_own(two_tests: Dataset, tiny: Dataset) -> None:
    place = arena(two_tests, GoalReader(), offline_trajectories=2)
    tests = two_tests.test_tasks
    own = {task.index: [place.stored(task, draw=0)] for task in tests}
    assert contexts_of_others(place, tests[0], own) == own[tests[1].index]
    lone = arena(tiny, GoalReader(), offline_trajectories=2)
    (task,) = tiny.test_tasks
    borrowed = contexts_of_others(lone, task, {task.index: [lone.stored(task, draw=0)]})
    assert len(borrowed) == 3
    stored = {
        trajectory.rewards.tobytes()
        for trajectory in tiny.select(tasks=[task.index]).trajectories(task.index)
    }
    assert not stored & {trajectory.rewards.tobytes() for context in borrowed for trajectory in context}


def test_lanes_beyond_one_batch_keep_their_order(two_tests: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    def returns() -> list[float]:
        place = arena(two_tests, GoalReader())
        tasks = [*two_tests.tasks]
        contexts = [place.stored(task, draw=0) for task in tasks]
        return [trajectory.undiscounted_return for trajectory in place.adapted(tasks, contexts, episode=0)]

    whole = returns()
    monkeypatch.setattr("tcmrl_algo.evaluation.arena.MOST_LANES", 2)
    assert returns() == pytest.approx(whole)


def test_a_method_that_needs_trajectories_is_not_given_none(two_tests: Dataset) -> None:
    place = arena(two_tests, GoalReader(), episodes=2, random_episodes=0)
    with pytest.raises(TrainingError, match=r"^tcmrl cannot adapt to task 3 .*paper.*random_episodes"):
        PROTOCOLS.get("paper")().adapt(place, two_tests.test_tasks)


def test_a_stateful_method_starts_from_its_prior_and_adapts_within_the_episode(two_tests: Dataset) -> None:
    method, tests = GoalSeeker(), two_tests.test_tasks
    place = arena(two_tests, method, capabilities=STATEFUL, episodes=2, random_episodes=0)
    adaptations = PROTOCOLS.get("paper")().adapt(place, tests)
    assert method.seen == [[0, 0], [1, 1]]
    fixed = arena(two_tests, FixedPrior(), capabilities=STATEFUL).adapted(tests, [[], []], episode=0)
    for task, adaptation, unchanged in zip(tests, adaptations, fixed, strict=True):
        assert adaptation.returns[0] > unchanged.undiscounted_return + 1
        assert adaptation.returns[1] == pytest.approx(oracle(two_tests, task), abs=0.05)


class FixedPrior(GoalReader):
    """Walks to where GoalSeeker believes the goal to be at first."""

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        return GoalController(np.array([[0.0, 1.0]] * len(trajectories)))


def test_a_stateful_method_corrects_the_context_of_another_task(two_tests: Dataset) -> None:
    first, second = two_tests.test_tasks
    wrong = arena(two_tests, GoalReader()).stored(second, draw=0)
    returns = [
        arena(two_tests, method, capabilities=STATEFUL).adapted([first], [wrong], episode=0)[0]
        for method in (GoalReader(), GoalSeeker())
    ]
    misled, corrected = (trajectory.undiscounted_return for trajectory in returns)
    assert corrected > misled + 1
    assert corrected == pytest.approx(oracle(two_tests, first), abs=1)


def test_the_prior_is_no_context_of_another_task(two_tests: Dataset) -> None:
    place = arena(two_tests, GoalSeeker(), capabilities=STATEFUL, offline_trajectories=2)
    first, second = two_tests.test_tasks
    trained = [place.stored(task, draw=0) for task in two_tests.train_tasks]
    priors = {first.index: [[]], second.index: [[]]}
    assert contexts_of_others(place, first, priors) == trained
    mixed = {first.index: [place.stored(first, draw=0)], second.index: [[]]}
    assert contexts_of_others(place, first, mixed) == trained
    assert contexts_of_others(place, second, mixed) == mixed[first.index]


class Watched(GoalReader):
    """Records the task parameters that it receives."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[Tensor | None] = []

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        self.told.append(privileged)
        return super().adapt(trajectories)


@pytest.mark.parametrize("protocol", PROTOCOLS.names())
@pytest.mark.parametrize("names", [(), ("blind",), ("explores",), ("stateful",)], ids=str)
def test_task_parameters_reach_no_method_without_the_capability(
    two_tests: Dataset, protocol: str, names: tuple[str, ...]
) -> None:
    method, capabilities = Watched(), Capabilities(**dict.fromkeys(names, True))
    place = arena(two_tests, method, capabilities=capabilities, episodes=3, random_episodes=1)
    PROTOCOLS.get(protocol)().adapt(place, two_tests.test_tasks)
    assert method.told and set(method.told) == {None}


def test_a_privileged_method_is_given_the_parameters_of_every_lane(
    two_tests: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tcmrl_algo.evaluation.arena.MOST_LANES", 2)
    first, second = two_tests.test_tasks
    method, tasks = Watched(), [second, first, first]
    place = arena(two_tests, method, capabilities=Capabilities(privileged=True))
    context = place.stored(first, draw=0)
    place.adapted(tasks, [context] * 3, episode=0)
    expected = TaskParameters(two_tests.train_tasks)(tasks)
    assert [rows.tolist() for rows in method.told if rows is not None] == [
        expected[:2].tolist(), expected[2:].tolist()
    ]  # fmt: skip
    assert not (expected[0] == expected[1]).all()


def test_non_prior_acts_uniformly_for_half_of_all_steps() -> None:
    steps = [num_uniform_steps(episode, episodes=3, horizon=200) for episode in range(3)]
    assert steps == [200, 100, 0]  # steps 0 to 299 of 600
    assert [num_uniform_steps(episode, episodes=4, horizon=20) for episode in range(4)] == [20, 20, 0, 0]
    assert num_uniform_steps(0, episodes=1, horizon=20) == 20


def test_non_prior_knows_the_episodes_before_and_ignores_the_methods_own_exploration(
    two_tests: Dataset,
) -> None:
    class Stubborn(GoalReader):
        def explore(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
            raise AssertionError("no method collects in its own way")

    algorithm = Stubborn()
    place = arena(two_tests, algorithm, episodes=3, random_episodes=2)
    adaptations = PROTOCOLS.get("non_prior")().adapt(place, two_tests.test_tasks)
    assert algorithm.seen == [[1, 1], [2, 2]]  # the third context: the first two blocks alone
    for task, adaptation in zip(two_tests.test_tasks, adaptations, strict=True):
        ((first, second, third),) = adaptation.contexts
        goal = GOALS[task.index]
        expected = np.clip((goal - second.observations[:-1]) / 0.1, -1.0, 1.0)
        by_policy = np.isclose(second.actions, expected, atol=1e-5).all(axis=1)
        assert by_policy[10:].all() and not by_policy[:10].any()
        assert not np.isclose(first.actions, expected, atol=1e-5).all(axis=1).any()
        assert third.undiscounted_return == pytest.approx(oracle(two_tests, task), abs=0.05)
