"""Controls of a dataset: policies that never adapt, behavior policies without noise, and `tcmrl controls`."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest
from tcmrl_cli.train import tcmrl

from tcmrl_algo import Controls, dataset_controls
from tcmrl_algo.evaluation import controls as controls_module
from tcmrl_algo.evaluation.controls import ControlBench, best_target, with_numbers
from tcmrl_data import (
    BelievingController,
    CheckpointError,
    Controller,
    Dataset,
    DeterministicController,
    Task,
    TrainingError,
    first_observation,
    hidden_entries,
    make_environment,
    roll_out,
)
from tcmrl_data.behavior.base import GaussianController
from tests.commands import in_process


@pytest.fixture(scope="module")
def found(tiny: Dataset) -> Controls:
    return dataset_controls(tiny)


def walk(dataset: Dataset, task: Task, controller: Controller) -> float:
    """Return of one episode; the point robot has no chance of its own."""
    lanes = dataset.environment.lanes([task.parameters])
    (episode,) = roll_out(
        dataset.environment, lanes, controller, reset_seeds=[0], noise=[np.random.default_rng(0)]
    )
    return episode.undiscounted_return


def silent(dataset: Dataset, task: int, step: int) -> Controller:
    """A stored policy without noise."""

    class Silent(Controller):
        def act(self, observations: Any, noise: Any) -> Any:
            return policy.act(observations, np.zeros_like(noise))

    policy = dataset.snapshot(task, step).controller(dataset.environment, [dataset.task(task).parameters])
    assert isinstance(policy, GaussianController)
    return Silent()


def test_the_fixed_snapshot_is_the_training_tasks_last_policy_that_does_best_there(
    tiny: Dataset, found: Controls
) -> None:
    means = {
        task.index: fmean(walk(tiny, other, silent(tiny, task.index, 150)) for other in tiny.train_tasks)
        for task in tiny.train_tasks
    }
    best = max(means, key=means.__getitem__)
    assert found.fixed_snapshot is not None
    assert (found.fixed_snapshot.task, found.fixed_snapshot.step) == (best, 150)
    assert found.fixed_snapshot.train_returns == pytest.approx(means, abs=1e-4)
    assert found.fixed_snapshot.train_return == pytest.approx(means[best], abs=1e-4)
    assert found.fixed_snapshot.average_return == pytest.approx(fmean(means.values()), abs=1e-4)
    (task,) = found.tasks
    expected = walk(tiny, tiny.test_tasks[0], silent(tiny, best, 150))
    assert task.fixed_snapshot == pytest.approx(expected, abs=1e-4)


def test_of_many_candidates_only_the_best_few_are_tried_in_all_tasks(
    tiny: Dataset, found: Controls, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tcmrl_algo.evaluation.controls.SCREENING_TASKS", 3)
    monkeypatch.setattr("tcmrl_algo.evaluation.controls.FINALISTS", 3)
    bench = ControlBench(tiny, lambda stage, done, total: None)
    screened, _ = bench.fixed_snapshot()
    bench.close()
    assert screened is not None and found.fixed_snapshot is not None
    assert len(screened.train_returns) == 3
    expected = {task: found.fixed_snapshot.train_returns[task] for task in screened.train_returns}
    assert screened.train_returns == pytest.approx(expected, abs=1e-4)  # means over all training tasks


def test_behavior_is_the_best_of_the_test_tasks_own_policies_without_noise(
    tiny: Dataset, found: Controls
) -> None:
    (test,), (task,) = tiny.test_tasks, found.tasks
    returns = {step: walk(tiny, test, silent(tiny, test.index, step)) for step in tiny.snapshots(test.index)}
    assert task.behavior == pytest.approx(max(returns.values()), abs=1e-4)
    assert task.behavior_step == max(returns, key=returns.__getitem__)
    references = tiny.references(test.index)
    assert (task.uniform, task.oracle) == (references.uniform, references.oracle)


def test_no_single_target_does_better_in_the_training_tasks(tiny: Dataset, found: Controls) -> None:
    assert found.fixed_target is not None

    def mean_return(goal: list[float]) -> float:
        parameters = {"goal": goal, "wind": [0.0, 0.0]}
        return fmean(
            walk(tiny, task, oracle) for task in tiny.train_tasks if (oracle := make_oracle(parameters))
        )

    def make_oracle(parameters: dict[str, Any]) -> Controller | None:
        return tiny.environment.oracle([parameters])

    fitted = found.fixed_target.parameters
    assert found.fixed_target.train_return == pytest.approx(mean_return(fitted["goal"]))
    grid = [mean_return([x, y]) for x in np.linspace(-1, 1, 7) for y in np.linspace(0, 1, 5)]
    assert found.fixed_target.train_return > max(grid) - 0.05
    assert fitted["wind"] == [0.0, 0.0]
    (task,) = found.tasks
    assert task.fixed == task.fixed_target  # which does better in training than any stored policy


def test_the_search_for_a_target_finds_a_maximum_and_keeps_what_tasks_share() -> None:
    tasks = [Task(i, "train", {"a": [float(i), 5.0], "b": float(-i), "name": "arm"}) for i in range(3)]
    calls = 0

    def mean_return(parameters: Any) -> float:
        nonlocal calls
        calls += 1
        assert (parameters["name"], parameters["a"][1]) == ("arm", 5.0)
        return -((parameters["a"][0] - 1.3) ** 2) - (parameters["b"] + 0.4) ** 2

    parameters, value = best_target(tasks, mean_return)
    assert parameters["a"][0] == pytest.approx(1.3, abs=1e-2)
    assert parameters["b"] == pytest.approx(-0.4, abs=1e-2)
    assert value == pytest.approx(0.0, abs=1e-3)
    assert calls < 220
    assert with_numbers({"b": [1, "x"], "a": 2.0}, iter([7.0, 8.0])) == {"a": 7.0, "b": [8.0, "x"]}


class Echo(Controller):
    """Shows what it observes."""

    view = "full"

    def act(self, observations: Any, noise: Any) -> Any:
        assert not noise.any()
        return observations


def test_a_fixed_policy_keeps_believing_in_its_own_task() -> None:
    hidden, values = np.array([False, True]), np.array([7.0, 8.0])
    controller = DeterministicController(BelievingController(Echo(), hidden, values))
    assert controller.view == "full"
    noise = controller.draw_noise(np.random.default_rng(0), 3, 2)
    assert noise.shape == (3, 2)
    assert controller.act(np.array([[1.0, 2.0], [3.0, 4.0]]), noise[0]).tolist() == [[1.0, 8.0], [3.0, 8.0]]


@pytest.mark.check
def test_the_entries_that_tell_a_hidden_goal_are_found() -> None:
    settings = {"name": "ml1/reach", "task_seed": 1337, "tasks": 50, "train": 40, "horizon": 500}
    environment = make_environment(settings)
    assert np.flatnonzero(hidden_entries(environment)).tolist() == [36, 37, 38]
    tasks = [
        Task(i, "train", parameters) for i, parameters in enumerate(environment.draw_parameters(2, 1337))
    ]
    first, second = (first_observation(environment, task)[36:] for task in tasks)
    assert not np.allclose(first, second)


def test_controls_are_measured_once_for_a_dataset_and_its_splits(
    tiny: Dataset, found: Controls, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*arguments: Any, **named: Any) -> Controls:
        raise AssertionError("measured again")

    monkeypatch.setattr(controls_module, "measure_controls", never)
    assert dataset_controls(tiny) == found
    other = Dataset(tiny.folder, tiny.manifest)
    other.tasks = tuple(replace(task, split="test") if task.index == 40 else task for task in tiny.tasks)
    with pytest.raises(AssertionError, match="measured again"):
        dataset_controls(other)


def test_controls_are_measured_where_they_cannot_be_kept(
    tiny: Dataset, found: Controls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(controls_module, "measure_controls", lambda dataset, *, report: found)
    assert dataset_controls(tiny) == found


def test_a_damaged_file_is_named(tiny: Dataset, found: Controls, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path))
    monkeypatch.setattr(controls_module, "measure_controls", lambda dataset, *, report: found)
    dataset_controls(tiny)
    (file,) = (tmp_path / "controls").iterdir()
    file.write_text("{")
    with pytest.raises(CheckpointError, match=r"controls/point-robot-.*; delete it"):
        dataset_controls(tiny)


def test_without_stored_policies_or_an_oracle_there_is_no_fixed_policy(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ControlBench, "_policy", lambda self, task, step, run: None)
    monkeypatch.setattr(type(tiny.environment), "oracle", lambda self, parameters: None)
    measured = controls_module.measure_controls(tiny)
    (task,) = measured.tasks
    assert measured.fixed_snapshot is measured.fixed_target is None
    assert task.behavior is task.fixed is task.fixed_snapshot is task.fixed_target is None
    assert measured.mean("fixed") is None
    assert measured.mean("uniform") == task.uniform


def test_a_dataset_without_test_tasks_has_no_controls(tiny: Dataset) -> None:
    dataset = Dataset(tiny.folder, tiny.manifest)
    dataset.tasks = tiny.train_tasks
    with pytest.raises(TrainingError, match="no training or no test task"):
        dataset_controls(dataset)


def test_the_command_shows_the_controls(
    tiny: Dataset, found: Controls, capsys: pytest.CaptureFixture[str], tiny_copy: Callable[[], Path]
) -> None:
    call = in_process(tcmrl, capsys)
    code, output, errors = call("controls", tiny_copy())
    assert code == 0
    (row,) = (line.split() for line in output.splitlines() if line.split()[:1] == ["mean"])
    names = ("uniform", "fixed_snapshot", "fixed_target", "behavior", "oracle")
    assert row[1:] == [f"{found.mean(name):,.2f}" for name in names]
    assert "fixed snapshot: task" in errors
    code, output, errors = call("controls", tiny.folder, "--json", "--quiet")
    assert (code, errors) == (0, "")
    assert Controls.model_validate_json(output) == found
    assert json.loads(output)["dataset_root"] == tiny.manifest.root
