"""Policies in other tasks, what a context is worth, and how visible the task is, by known numbers."""

import json
from pathlib import Path

import numpy as np
import pytest

from tcmrl_data import Dataset, SelectionError, TcmrlError, measure_transfer, measure_worth
from tcmrl_data.behavior.base import GaussianDescription, Snapshot
from tcmrl_data.quality.measured import PartSteps
from tcmrl_data.quality.transfer import Transfer, TransferTask
from tcmrl_data.quality.worth import Half, Sample, context_worth, draw_sample, visibility
from tcmrl_data.store.part import References
from tcmrl_data.store.tables import PartKey
from tests.commands import Call, assert_refused
from tests.graded import graded_dataset, made_dataset
from tests.test_coverage import episode


def walker(x: float) -> Snapshot:
    """A policy without layers and noise that moves by 0.1 x along the first axis."""
    description = GaussianDescription(observation="stored", observation_dim=2, action_dim=2, hidden=())
    tensors = {
        "mean.weight": np.zeros((2, 2), np.float32),
        "mean.bias": np.array([20.0 * x, 0.0], np.float32),
        "log_std.weight": np.zeros((2, 2), np.float32),
        "log_std.bias": np.full(2, -20.0, np.float32),
    }
    return Snapshot(5, description, tensors)


REFERENCES = References(uniform=-30.0, oracle=-4.5, scripted=None)


def walkers(folder: Path, references: References = REFERENCES) -> Dataset:
    """Tasks 0 and 99, whose goals are (1, 0) and (-1, 0), and policies that walk 20 steps right and left."""
    keys = {PartKey(0, 5): walker(1.0), PartKey(99, 5): walker(-1.0)}
    episodes = {key: [episode([0.0, 1.0]), episode([0.0, 1.0])] for key in keys}
    return made_dataset(folder, episodes, references=references, snapshots=keys)


@pytest.fixture
def opposite(tmp_path: Path) -> Dataset:
    return walkers(tmp_path / "opposite")


def test_a_policy_gets_the_same_far_from_its_task_whoever_looks(opposite: Dataset) -> None:
    """Towards the goal 0.9 … 0 and beyond it 0.1 … 1.0, together 10; away from it 1.1 … 3.0, together 41."""
    done = []
    found = measure_transfer(opposite, episodes=2, progress=lambda now, total: done.append((now, total)))
    np.testing.assert_allclose(found.returns, [[-10.0, -41.0], [-41.0, -10.0]], atol=1e-4)
    np.testing.assert_allclose(found.scores, np.array([[20.0, -11.0], [-11.0, 20.0]]) / 25.5, atol=1e-4)
    assert [task.task for task in found.tasks] == [0, 99]
    assert done == [(4, 8), (8, 8)]


def test_worth_is_what_the_best_single_policy_leaves(opposite: Dataset) -> None:
    """Own -10; one policy -10 and -41, on average -25.5; uniform -30 and oracle -4.5: 15.5 of 25.5."""
    found = measure_worth(opposite, episodes=1)
    (train,) = found.splits
    assert (train.own, train.single, train.best) == pytest.approx((-10.0, -25.5, -4.5), abs=1e-4)
    assert train.worth == pytest.approx(15.5 / 25.5, abs=1e-5)
    assert (train.low, train.high, found.single_task) == (None, None, 0)


def row(task: int, split: str, uniform: float | None = 0.0, best: float = 10.0) -> TransferTask:
    document = {"task": task, "split": split, "step": 5, "run": "main", "uniform": uniform, "best": best}
    return TransferTask.model_validate(document)


def transfer_of(tasks: list[TransferTask], returns: list[list[float]]) -> Transfer:
    heading = {"label": None, "environment": "point-robot", "root": "0" * 64}
    counts = {"seed": 0, "episodes": 1, "deterministic": False, "left_out": 0}
    matrix = tuple(map(tuple, returns))
    return Transfer(**heading, **counts, tasks=tuple(tasks), returns=matrix, scores=matrix)


def test_the_single_policy_is_chosen_on_training_tasks_alone() -> None:
    """Task 7's policy has the best mean of training tasks, 5.5; the test task's would have 9 everywhere."""
    tasks = [row(3, "train"), row(7, "train"), row(9, "test", best=20.0)]
    single, (train, test) = context_worth(
        transfer_of(tasks, [[8.0, 2.0, 6.0], [4.0, 7.0, 1.0], [9.0, 9.0, 9.0]])
    )
    assert single == 7
    assert (train.own, train.single, train.worth) == pytest.approx((7.5, 5.5, 0.2))
    assert (test.own, test.single, test.worth) == pytest.approx((9.0, 1.0, 0.4))


def test_worth_needs_references_with_a_range() -> None:
    for unknown in (row(1, "train", uniform=None), row(1, "train", uniform=30.0)):
        _, (train,) = context_worth(transfer_of([row(0, "train"), unknown], [[1.0, 0.0], [0.0, 1.0]]))
        assert (train.worth, train.low, train.high) == (None, None, None)


def test_the_interval_of_worth_is_over_tasks() -> None:
    """Task 0 has the single policy and gains nothing of 10, five others gain 2 each."""
    tasks = [row(i, "train") for i in range(6)]
    _, (train,) = context_worth(transfer_of(tasks, (np.ones((6, 6)) + 2.0 * np.eye(6)).tolist()))
    assert train.low is not None and train.high is not None and train.worth is not None
    assert train.worth == pytest.approx(5 * 2.0 / 60.0)
    assert 0.0 <= train.low < train.worth < train.high <= 0.2


def half(rewards: list[float], changes: list[float]) -> Half:
    """Transitions in one place."""
    return Half(np.zeros((len(rewards), 2)), np.array(rewards)[:, None], np.array(changes)[:, None])


def test_a_task_that_only_itself_predicts_is_plain_to_see() -> None:
    """Rewards are 1 and 0: no error from the same task, 1 from the other. Changes do not differ."""
    change = [1.0, 2.0]
    samples = [Sample(half([value] * 2, change), half([value] * 2, change), 1.0) for value in (1.0, 0.0)]
    reward, dynamics = visibility(samples, np.random.default_rng(0))
    assert reward == 1.0
    assert dynamics == pytest.approx(0.0)


def test_visibility_compares_squared_errors_of_both_predictions() -> None:
    """Task 0 knows rewards 1 and 3, task 1 knows 6 and 6. Of rewards 4 and 6 the same task misses 2 and 0,
    the other task 2 and 4: 1 - 4 / 20."""
    samples = [
        Sample(half([1.0, 3.0], [0.0] * 2), half([4.0], [0.0]), 1.0),
        Sample(half([6.0, 6.0], [0.0] * 2), half([6.0], [0.0]), 1.0),
    ]
    reward, dynamics = visibility(samples, np.random.default_rng(0))
    assert reward == pytest.approx(1 - 4 / 20)
    assert dynamics is None
    assert visibility(samples[:1], np.random.default_rng(0)) == (None, None)


def test_neighbours_are_near_in_standard_deviations() -> None:
    """The second column is 1,000 times as wide, and rewards follow the first one."""
    generator = np.random.default_rng(0)
    samples = []
    for task in range(2):
        inputs = generator.normal(size=(400, 2)) * [1.0, 1_000.0]
        halves = [
            Half(part, np.sign(part[:, :1]) * (1 - 2 * task), np.zeros((200, 1)))
            for part in np.split(inputs, 2)
        ]
        samples.append(Sample(*halves, 1.0))
    reward, _ = visibility(samples, generator)
    assert reward is not None and reward > 0.9


def test_no_episode_predicts_itself() -> None:
    places = np.repeat(np.arange(4.0), 3)[:, None]
    steps = PartSteps(places, places, np.tile([0.0, 0.0, 1.0], 4), places + 1, (3, 3, 3, 3))
    sample = draw_sample(steps, 4, np.random.default_rng(0))
    assert sample is not None
    assert set(sample.known.inputs[:, 0]) <= {0.0, 2.0} and len(sample.known.inputs) == 4
    assert set(sample.asked.inputs[:, 0]) <= {1.0, 3.0} and len(sample.asked.inputs) == 4
    assert sample.rewarded == pytest.approx(1 / 3)
    assert set(sample.asked.changes[:, 0]) == {1.0}
    single = PartSteps(places[:3], places[:3], np.zeros(3), places[:3], (3,))
    assert draw_sample(single, 4, np.random.default_rng(0)) is None


def test_a_policys_own_return_is_that_of_its_stored_episodes(tiny: Dataset) -> None:
    """Stored means of six episodes lie near means of 40 new ones: four standard errors apart at most."""
    found = measure_transfer(tiny, episodes=40)
    for place, task in enumerate(found.tasks):
        stored = tiny.entry(PartKey(task.task, task.step))
        error = max(stored.std, 0.3) * np.sqrt(1 / 6 + 1 / 40)
        assert abs(found.returns[place][place] - stored.mean) < 4 * error


def test_the_same_seed_gives_the_same_numbers_and_another_one_does_not(tiny: Dataset) -> None:
    first, again, other = (measure_worth(tiny, seed=seed, transitions=20) for seed in (0, 0, 1))
    assert first == again
    assert first.splits != other.splits
    assert [split.split for split in first.splits] == ["train", "test"]
    assert {stage.step for stage in first.stages} == {0, 100, 150}
    assert {stage.reward for stage in first.stages if stage.split == "test"} == {None}


def test_how_many_lanes_fit_changes_nothing_that_can_be_seen(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = measure_transfer(tiny, episodes=3, deterministic=True)
    monkeypatch.setattr("tcmrl_data.quality.transfer.MOST_LANES", 2)
    parted = measure_transfer(tiny, episodes=3, deterministic=True)
    np.testing.assert_allclose(whole.returns, parted.returns, atol=1e-4)
    once = measure_transfer(tiny, episodes=1, deterministic=True)
    np.testing.assert_allclose(whole.returns, once.returns, atol=1e-4)


def test_fewer_tasks_keep_both_splits(tiny: Dataset) -> None:
    found = measure_transfer(tiny, tasks=2, episodes=1)
    assert [task.split for task in found.tasks] == ["train", "test"]
    assert found.left_out == 3
    assert len(measure_transfer(tiny, tasks=9, episodes=1).tasks) == 5


def test_parts_without_policies_and_single_tasks_are_refused(tmp_path: Path, tiny: Dataset) -> None:
    with pytest.raises(TcmrlError, match="holds no policy"):
        measure_transfer(graded_dataset(tmp_path / "graded"))
    with pytest.raises(SelectionError, match="two complete tasks"):
        measure_worth(graded_dataset(tmp_path / "one", tasks=[0]))
    with pytest.raises(SelectionError, match="neighbours"):
        measure_worth(tiny, transitions=2)


@pytest.mark.parametrize("what", ["transfer", "worth"])
def test_the_command_prints_what_python_gives(
    call: Call, opposite: Dataset, tmp_path: Path, what: str
) -> None:
    measure = {"transfer": measure_transfer, "worth": measure_worth}[what]
    picture = tmp_path / "picture.png"
    code, output, _ = call("inspect", what, opposite.folder, "--json", "--plot", picture, "--seed", 3)
    assert (code, json.loads(output)) == (0, measure(opposite, seed=3).model_dump(mode="json"))
    assert picture.read_bytes()[:4] == b"\x89PNG"
    printed = call("inspect", what, opposite.folder)[1]
    assert "60.8%" in printed if what == "worth" else "-41.00" in printed
    assert_refused(call("inspect", what, opposite.folder, "--plot", tmp_path / "no.gif"), "no.gif", ".png")


def test_a_worth_above_all_is_explained(call: Call, tmp_path: Path) -> None:
    """15.5 are gained over the best single policy. The best return is -2: 18 above -20, 13 above -15."""
    for uniform, shown in ((-20.0, "86.1%"), (-15.0, "119.2%")):
        references = References(uniform=uniform, oracle=None, scripted=None)
        dataset = walkers(tmp_path / shown, references)
        code, printed, remarks = call("inspect", "worth", dataset.folder)
        assert code == 0 and shown in printed
        assert ("A worth above 100%" in remarks) == (uniform == -15.0)
