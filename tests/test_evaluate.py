"""Meta-testing: the protocols, their controls, and `tcmrl evaluate`."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tcmrl_cli.evaluation import score_tables
from tcmrl_cli.frame import print_table
from tcmrl_cli.train import tcmrl
from torch import Tensor

from tcmrl_algo import Evaluation, TaskResult, evaluate_run, resolve, train_run
from tcmrl_algo.adaptation.arena import Arena
from tcmrl_algo.adaptation.evaluate import contexts_of_others
from tcmrl_algo.adaptation.protocols.base import PROTOCOLS
from tcmrl_algo.methods.base import Algorithm, Metrics
from tcmrl_algo.settings.run import RunSettings
from tcmrl_data import (
    Batch,
    CheckpointError,
    Controller,
    Dataset,
    Task,
    TrainingError,
    Trajectory,
)
from tests.commands import Call, assert_refused, in_process
from tests.plugin_packages import install
from tests.terminal import assert_fits, in_terminal

SMALL = ("batch.transitions=8", "actor_critic.hidden=[8]", "tcmrl.latent=4", "run.episodes=3")


class GoalController(Controller):
    """Walks to one goal per lane."""

    def __init__(self, goals: np.ndarray) -> None:
        self._goals = goals

    def act(self, observations: Any, noise: Any) -> Any:
        return np.clip((self._goals - observations) / 0.1, -1.0, 1.0)


class GoalReader(Algorithm):
    """Adapts perfectly: finds the goal that explains the rewards of the first trajectory it is given.

    Attributes:
        seen: the number of trajectories that each call of `adapt` got, lane by lane.
    """

    def __init__(self) -> None:
        self.seen: list[list[int]] = []

    def update(self, batch: Batch, step: int) -> Metrics:
        raise AssertionError("never trained")

    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        self.seen.append([len(lane) for lane in trajectories])
        angles = np.linspace(0.0, np.pi, 100)
        goals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        chosen = []
        for lane in trajectories:
            distances = np.linalg.norm(goals[:, None] - lane[0].observations[None, 1:], axis=-1)
            chosen.append(goals[np.abs(distances + lane[0].rewards).sum(axis=-1).argmin()])
        return GoalController(np.array(chosen))

    def tensors(self) -> dict[str, Tensor]:
        return {}

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        pass


@pytest.fixture(scope="module")
def trained(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    config = resolve(tiny.manifest.training["quick"], place="quick", overrides=SMALL)
    train_run(tiny, folder, config=config, profile="quick", steps=20)
    return folder


@pytest.fixture
def two_tests(tiny: Dataset) -> Dataset:
    """The tiny dataset with a second test task."""
    manifest = tiny.manifest
    moved = [
        each.model_copy(update={"split": "test"}) if each.index == 40 else each for each in manifest.tasks
    ]
    return Dataset(tiny.folder, manifest.model_copy(update={"tasks": tuple(moved)}))


def arena(dataset: Dataset, algorithm: Algorithm, **settings: Any) -> Arena:
    return Arena(dataset, algorithm, RunSettings(**settings), seed=0)


def oracle(dataset: Dataset, task: Task) -> float:
    found = dataset.references(task.index).oracle
    assert found is not None
    return found


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
            each.rewards.tobytes() for each in two_tests.select(tasks=[task.index]).trajectories(task.index)
        }
        drawn = [[each.rewards.tobytes() for each in context] for context in adaptation.contexts]
        assert [len(set(each)) for each in drawn] == [2, 2, 2]
        assert all(set(each) <= stored for each in drawn)
        assert len({tuple(each) for each in drawn}) > 1


def test_stored_contexts_come_from_the_snapshots_of_contexts(two_tests: Dataset) -> None:
    (task, *_) = two_tests.test_tasks
    place = arena(two_tests, GoalReader(), context_snapshots="last", offline_trajectories=6)
    last = two_tests.select(tasks=[task.index], snapshots="last").trajectories(task.index)
    stored = {each.rewards.tobytes() for each in place.stored(task, draw=0)}
    assert stored == {each.rewards.tobytes() for each in last}


def test_idaq_protocol_tries_training_contexts_and_keeps_the_best(two_tests: Dataset) -> None:
    place = arena(two_tests, GoalReader(), episodes=5)
    adaptations = PROTOCOLS.get("idaq")().adapt(place, two_tests.test_tasks)
    training = [oracle(two_tests, task) for task in two_tests.train_tasks]
    assert len(training) == 3
    for task, adaptation in zip(two_tests.test_tasks, adaptations, strict=True):
        # three training goals are tried, and then the goal that the best of them shows
        assert max(adaptation.returns[:3]) < oracle(two_tests, task) - 0.2
        assert adaptation.returns[3] == pytest.approx(oracle(two_tests, task), abs=0.05)
        assert len(adaptation.contexts) == len(adaptation.contexts[0]) == 1


def test_idaq_keeps_a_training_context_that_nothing_beats(two_tests: Dataset) -> None:
    class Stubborn(GoalReader):
        """Good under the first context it sees, bad under all others."""

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
    assert all(each is not mine for each in borrowed for mine in shared)


def test_contexts_of_others_are_never_the_tasks_own(two_tests: Dataset, tiny: Dataset) -> None:
    place = arena(two_tests, GoalReader(), offline_trajectories=2)
    tests = two_tests.test_tasks
    own = {task.index: [place.stored(task, draw=0)] for task in tests}
    assert contexts_of_others(place, tests[0], own) == own[tests[1].index]
    lone = arena(tiny, GoalReader(), offline_trajectories=2)
    (task,) = tiny.test_tasks
    borrowed = contexts_of_others(lone, task, {task.index: [lone.stored(task, draw=0)]})
    assert len(borrowed) == 3
    stored = {each.rewards.tobytes() for each in tiny.select(tasks=[task.index]).trajectories(task.index)}
    assert not stored & {each.rewards.tobytes() for context in borrowed for each in context}


def test_lanes_beyond_one_batch_keep_their_order(two_tests: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    def returns() -> list[float]:
        place = arena(two_tests, GoalReader())
        tasks = [*two_tests.tasks]
        contexts = [place.stored(task, draw=0) for task in tasks]
        return [each.undiscounted_return for each in place.adapted(tasks, contexts, episode=0)]

    whole = returns()
    monkeypatch.setattr("tcmrl_algo.adaptation.arena.MOST_LANES", 2)
    assert returns() == pytest.approx(whole)


@pytest.mark.parametrize("protocol", PROTOCOLS.names())
def test_evaluation_repeats_exactly_and_adds_up(trained: Path, tiny: Dataset, protocol: str) -> None:
    first = evaluate_run(trained, protocol=protocol)
    assert first == evaluate_run(trained, protocol=protocol)
    (task,) = first.tasks
    references = tiny.references(task.task)
    assert (task.oracle, task.random) == (references.oracle, references.uniform)
    assert task.regret == pytest.approx(oracle(tiny, tiny.test_tasks[0]) - task.final)
    expected = (task.final - task.random) / (oracle(tiny, tiny.test_tasks[0]) - task.random)
    assert task.normalized == pytest.approx(expected)
    assert task.reference == "oracle"
    assert len(task.returns) == 3
    assert first.mean_final == task.final
    assert first.mean_shuffled == task.shuffled


def test_without_an_oracle_regret_is_null_and_behavior_norms(
    trained: Path, tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    references = tiny.references(tiny.test_tasks[0].index)
    blind = references.model_copy(update={"oracle": None})
    monkeypatch.setattr(Dataset, "references", lambda self, task: blind)
    result = evaluate_run(trained, protocol="offline")
    (task,) = result.tasks
    assert task.oracle is task.regret is result.mean_regret is None
    assert task.reference == "behavior"
    expected = (task.final - references.uniform) / (references.behavior - references.uniform)
    assert task.normalized == pytest.approx(expected)


def test_success_is_the_share_of_final_episodes_that_succeed() -> None:
    from tcmrl_algo.adaptation.evaluate import _success

    flags = np.zeros(2, dtype=bool)
    plain = Trajectory(np.zeros((3, 1)), np.zeros((2, 1)), np.zeros(2), flags, flags)
    once = replace(plain, extras={"success": np.array([True, False])})
    never = replace(plain, extras={"success": np.array([False, False])})
    assert _success([once, never]) == 0.5
    assert _success([plain]) is None


def test_a_moved_dataset_is_found_by_path_and_checked_by_root(
    trained: Path, tiny_copy: Callable[[], Path], tmp_path: Path
) -> None:
    copied = tmp_path / "run"
    shutil.copytree(trained, copied)
    expected = evaluate_run(copied, protocol="idaq")
    record = json.loads((copied / "run.json").read_text())
    record["dataset"] = str(tmp_path / "gone")
    (copied / "run.json").write_text(json.dumps(record))
    with pytest.raises(CheckpointError, match=r"trained on .*gone, where nothing lies now.*--dataset"):
        evaluate_run(copied)
    assert evaluate_run(copied, protocol="idaq", dataset_path=tiny_copy()) == expected
    record["root"] = "f" * 64
    (copied / "run.json").write_text(json.dumps(record))
    with pytest.raises(CheckpointError, match="root"):
        evaluate_run(copied, dataset_path=tiny_copy())


def test_an_evaluation_becomes_points_of_the_runs_curves(trained: Path, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    copied = tmp_path / "run"
    shutil.copytree(trained, copied)
    (copied / "evaluations.jsonl").unlink(missing_ok=True)
    evaluation = evaluate_run(copied, protocol="offline")
    board = EventAccumulator(str(copied / "tensorboard")).Reload()
    (point,) = board.Scalars("return/offline/final")
    assert (point.step, point.value) == (20, pytest.approx(evaluation.mean_final))
    assert "return/offline/shuffled" in board.Tags()["scalars"]
    line = json.loads((copied / "evaluations.jsonl").read_text())
    assert (line["step"], line["protocol"], line["final"]) == (20, "offline", evaluation.mean_final)


def test_a_run_trained_on_another_device_is_evaluated_on_the_cpu(trained: Path, tmp_path: Path) -> None:
    copied = tmp_path / "run"
    shutil.copytree(trained, copied)
    expected = evaluate_run(copied)
    record = json.loads((copied / "run.json").read_text())
    (copied / "run.json").write_text(json.dumps(record | {"device": "cuda:7"}))
    assert evaluate_run(copied) == expected


def test_a_dataset_without_test_tasks_cannot_be_evaluated(
    trained: Path, tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Dataset, "test_tasks", ())
    with pytest.raises(TrainingError, match="no test task"):
        evaluate_run(trained)


def test_a_run_without_checkpoint_cannot_be_evaluated(trained: Path, tmp_path: Path) -> None:
    copied = tmp_path / "run"
    shutil.copytree(trained, copied)
    shutil.rmtree(copied / "checkpoints")
    with pytest.raises(CheckpointError, match="no checkpoint"):
        evaluate_run(copied)


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    return in_process(tcmrl, capsys)


def test_evaluate_command_prints_the_documented_json(trained: Path, call: Call) -> None:
    code, output, errors = call(
        "evaluate", trained, "--protocol", "offline", "--episodes", 4, "--json", "--quiet"
    )
    document = json.loads(output)
    assert (code, errors) == (0, "")
    assert set(document) == {
        "algorithm", "environment", "seed", "protocol", "tasks",
        "mean_final", "mean_regret", "mean_normalized", "mean_shuffled",
    }  # fmt: skip
    (task,) = document["tasks"]
    assert set(task) == {
        "task", "split", "returns", "final", "oracle", "random",
        "regret", "normalized", "reference", "success", "shuffled",
    }  # fmt: skip
    assert len(task["returns"]) == 4
    assert task["split"] == "test"
    assert task["success"] is None


def test_evaluate_command_compares_all_protocols(trained: Path, call: Call) -> None:
    code, output, _ = call("evaluate", trained, "--protocol", "all")
    assert code == 0
    for text in ("paper", "adapted", "regret", "other", "uniform", "oracle", "mean"):
        assert text in output
    code, output, _ = call("evaluate", trained, "--protocol", "all", "--json")
    assert [each["protocol"] for each in json.loads(output)] == PROTOCOLS.names()


def test_evaluations_by_every_protocol_fit_a_terminal_with_every_number_whole(trained: Path) -> None:
    shown = in_terminal("tcmrl", "evaluate", trained, "--protocol", "all", "--quiet")
    assert shown.code == 0
    assert_fits(shown.output)
    for protocol in PROTOCOLS.names():
        evaluation = evaluate_run(trained, protocol=protocol)
        (task,) = evaluation.tasks
        numbers = [task.random, task.oracle, task.final, task.shuffled, task.regret]
        row = [f"{value:,.2f}" for value in numbers if value is not None]
        lines = [line.split() for line in shown.output.splitlines()]
        assert lines.count([protocol, *row]) == 1  # the means by protocol
        assert f"protocol {protocol}: returns by test task" in shown.output
        assert [str(task.task), *row] in lines


def test_long_returns_of_twenty_tasks_fit_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    task = TaskResult(
        task=0, split="test", returns=[], final=-1234.56, oracle=-1023.45, random=-9876.54,
        regret=1000.0, normalized=0.9, reference="oracle", success=0.25, shuffled=-1234.57,
    )  # fmt: skip
    tasks = [replace(task, task=index) for index in range(20)]
    result = Evaluation("a_method", "walker-rand-params", 10, "offline", tasks, 0.0, None, None, 0.0)
    for table in score_tables([result, replace(result, protocol="a_new_protocol")]):
        print_table(table)  # to a pipe: as wide as its columns
    output = capsys.readouterr().out
    assert_fits(output)
    assert output.count("-9,876.54") == 2 + 2 * 21


def test_one_protocol_shows_its_tasks_and_their_mean(trained: Path, call: Call) -> None:
    code, output, _ = call("evaluate", trained, "--protocol", "offline")
    lines = [line.split() for line in output.splitlines()]
    assert code == 0
    assert [line[0] for line in lines if len(line) == 6] == ["task", "3", "mean"]
    assert "offline: returns by test task" in " ".join(output.split())


def test_help_names_the_installed_protocols_without_importing_torch() -> None:
    code = (
        "import sys; from tcmrl_cli.train import tcmrl; "
        "tcmrl(['evaluate', '--help'], standalone_mode=False); assert 'torch' not in sys.modules"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ", ".join(PROTOCOLS.names()) in " ".join(shown.stdout.split())


PLUGIN = """
from tcmrl_algo import Adaptation, Protocol

class Plugin(Protocol):
    name = "borrowed"

    def adapt(self, arena, tasks):
        context = arena.stored(arena.dataset.train_tasks[0], draw=0)
        episodes = arena.adapted(tasks, [context] * len(tasks), episode=0)
        return [Adaptation([episode.undiscounted_return], [context]) for episode in episodes]
"""


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package of somebody else with a protocol, and another that cannot be imported."""
    modules = {"borrowed_protocol": PLUGIN, "torn_protocol": "import no_such_module"}
    lines = "borrowed = borrowed_protocol:Plugin\ntorn = torn_protocol:Plugin"
    install(tmp_path, "foreign", modules=modules, declares={"tcmrl.protocols": lines})
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("foreign")
def test_a_protocol_of_another_package_evaluates_beside_ours(trained: Path, call: Call) -> None:
    code, output, errors = call("evaluate", trained, "--protocol", "all", "--json")
    assert code == 0
    assert [document["protocol"] for document in json.loads(output)] == sorted(
        ["borrowed", "idaq", "offline", "paper"]
    )
    assert "left out: protocol 'torn' of package 'foreign' is broken: ModuleNotFoundError" in errors
    assert_refused(call("evaluate", trained, "--protocol", "torn"), "'torn'", "no_such_module")
    assert_refused(call("evaluate", trained, "--protocol", "borowed"), "did you mean borrowed")


def test_a_training_table_with_an_unknown_protocol_is_refused(tiny: Dataset) -> None:
    table = tiny.manifest.training["quick"]
    with pytest.raises(TrainingError, match=r"here, run.protocol: .*'papr'; did you mean paper\?"):
        resolve(table, place="here", overrides=["run.protocol=papr"])


def test_evaluate_command_refuses_bad_input_in_one_line(trained: Path, tmp_path: Path, call: Call) -> None:
    for arguments, expected in (
        ((tmp_path / "none",), "no run.json"),
        ((trained, "--dataset", tmp_path / "none"), "none"),
        ((trained, "--protocol", "oflin"), "unknown protocol 'oflin'; did you mean offline"),
        ((trained, "--episodes", "0"), "--episodes"),
    ):
        code, output, errors = call("evaluate", *arguments)
        assert (code, output) == (2, "")
        (line,) = errors.strip().splitlines()
        assert line.startswith("Error: ")
        assert expected in line


def test_evaluation_serialises() -> None:
    evaluation = Evaluation("tcmrl", "point-robot", 0, "idaq", [], 0.0, None, None, 0.0)
    assert json.loads(json.dumps(evaluation.to_json()))["mean_regret"] is None
