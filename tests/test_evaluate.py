"""Meta-testing: scores of a run and of its controls, and `tcmrl evaluate`."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli.evaluation import score_tables
from tcmrl_cli.frame import print_table
from tcmrl_cli.train import tcmrl

from tcmrl_algo import PROTOCOLS, Evaluation, TaskResult, evaluate_run, open_run, resolve, train_run
from tcmrl_algo.evaluation.evaluate import check_plot
from tcmrl_data import (
    CheckpointError,
    Dataset,
    TcmrlError,
    TrainingError,
    Trajectory,
)
from tests.adapters import oracle
from tests.commands import Call, assert_refused
from tests.environments import environment_of
from tests.plugin_packages import install
from tests.terminal import as_in_terminal, assert_fits

PROGRAM = tcmrl

SMALL = ("batch.transitions=8", "actor_critic.hidden=[8]", "tcmrl.latent=4", "run.episodes=3")


@pytest.fixture(scope="module")
def trained(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    config = resolve(tiny.manifest.training["quick"], place="quick", overrides=SMALL)
    train_run(tiny, folder, config=config, profile="quick", steps=20)
    return folder


@pytest.mark.parametrize("protocol", PROTOCOLS.names())
def test_evaluation_repeats_exactly_and_adds_up(trained: Path, tiny: Dataset, protocol: str) -> None:
    first = evaluate_run(trained, protocol=protocol)
    assert first == evaluate_run(trained, protocol=protocol)
    (task,) = first.tasks
    references = tiny.references(task.task)
    assert (task.oracle, task.random) == (references.oracle, references.uniform)
    best = oracle(tiny, tiny.task(task.task))
    assert task.regret == pytest.approx(best - task.final)
    expected = (task.final - task.random) / (best - task.random)
    assert task.normalized == pytest.approx(expected)
    assert task.reference == "oracle"
    assert len(task.returns) == 3
    assert first.mean_final == task.final
    assert first.mean_shuffled == task.shuffled


def test_in_training_tasks_a_policy_returns_what_it_would_if_they_were_test_tasks(
    trained: Path, tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    (task,) = evaluate_run(trained, protocol="offline_train").tasks
    assert (task.task, task.split) == (tiny.train_tasks[0].index, "train")
    assert (task.behavior, task.fixed, task.reference) == (None, None, "oracle")
    monkeypatch.setattr(Dataset, "test_tasks", tiny.train_tasks[:1])
    (expected,) = evaluate_run(trained, protocol="offline").tasks
    assert (task.final, task.returns) == (expected.final, expected.returns)


def test_an_evaluation_in_training_tasks_says_so(trained: Path, call: Call) -> None:
    code, output, _ = call("evaluate", trained, "--protocol", "offline_train", "--quiet")
    assert code == 0
    assert "means over 1 training tasks" in output
    assert "offline_train: returns by training task" in output
    assert "test task" not in output


def test_a_random_first_stage_is_repeated_and_averaged(trained: Path) -> None:
    once, often = (evaluate_run(trained, protocol="paper", repeats=repeats) for repeats in (1, 4))
    (single,), (mean,) = once.tasks, often.tasks
    assert (once.repeats, often.repeats) == (1, 4)
    assert single.finals == [single.final]
    assert mean.finals[0] == pytest.approx(single.final)
    assert len(set(mean.finals)) == 4  # every repeat meets random episodes of its own
    assert mean.final == pytest.approx(np.mean(mean.finals))
    assert mean.returns[0] != pytest.approx(single.returns[0])
    assert often.adaptation_curve == pytest.approx(mean.returns)
    assert (
        evaluate_run(trained, protocol="paper").repeats
        == open_run(trained).record.config.settings.run.repeats
    )


def test_final_returns_are_told_apart_by_repeat() -> None:
    from tcmrl_algo.evaluation.evaluate import _finals

    flags = np.zeros(1, dtype=bool)
    episodes = [
        Trajectory(np.zeros((2, 1)), np.zeros((1, 1)), np.array([value]), flags, flags)
        for value in (1.0, 2.0, 4.0, 3.0, 6.0, 8.0)  # two rounds under three contexts
    ]
    assert _finals(episodes, [1, 2]) == [2.0, 5.0]  # contexts' means 2, 4, 6
    assert _finals(episodes, [3]) == [4.0]


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
    assert task.behavior is not None  # the noise-free return, beside a noise-free adapted policy
    assert task.behavior != pytest.approx(references.behavior)
    expected = (task.final - references.uniform) / (task.behavior - references.uniform)
    assert task.normalized == pytest.approx(expected)


def test_success_is_the_share_of_final_episodes_that_succeed() -> None:
    from tcmrl_algo.evaluation.evaluate import _success

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
    shutil.rmtree(copied / "tensorboard")  # earlier tests evaluated the run too
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


def test_evaluate_command_prints_the_documented_json(trained: Path, call: Call) -> None:
    code, output, errors = call(
        "evaluate", trained, "--protocol", "offline", "--episodes", 4, "--json", "--quiet"
    )
    document = json.loads(output)
    assert (code, errors) == (0, "")
    assert set(document) == {
        "algorithm", "environment", "seed", "protocol", "repeats", "tasks", "adaptation_curve",
        "mean_final", "mean_regret", "mean_normalized", "mean_shuffled", "mean_behavior", "mean_fixed",
        "privileged",
    }  # fmt: skip
    (task,) = document["tasks"]
    assert set(task) == {
        "task", "split", "returns", "final", "finals", "oracle", "random", "behavior", "fixed",
        "regret", "normalized", "reference", "success", "shuffled",
    }  # fmt: skip
    assert len(task["returns"]) == 4
    assert task["split"] == "test"
    assert task["success"] is None


def test_a_changed_random_stage_reaches_methods_that_explore(
    trained: Path, tiny: Dataset, tmp_path: Path
) -> None:
    """A CSRO whose first stage is uniform makes the episodes of a method that does not explore."""
    overrides = (*SMALL, "run.random_episodes=1", "csro.random_share=1")
    config = resolve(tiny.manifest.training["quick"], place="quick", algorithm="csro", overrides=overrides)
    train_run(tiny, tmp_path / "csro", config=config, profile="quick", steps=2)
    changed = {"protocol": "paper", "episodes": 4, "random_episodes": 3, "repeats": 1}
    found, expected = (evaluate_run(folder, **changed) for folder in (tmp_path / "csro", trained))
    assert found.adaptation_curve[:3] == pytest.approx(expected.adaptation_curve[:3])


def test_evaluate_command_changes_the_random_stage(trained: Path, call: Call) -> None:
    options = ("--protocol", "paper", "--random-episodes", 1, "--repeats", 2, "--json", "--quiet")
    code, output, _ = call("evaluate", trained, *options)
    document = json.loads(output)
    assert (code, document["repeats"]) == (0, 2)
    assert document == evaluate_run(trained, protocol="paper", random_episodes=1, repeats=2).to_json()
    more = evaluate_run(trained, protocol="paper", random_episodes=2, repeats=2)
    first, second, *_ = document["adaptation_curve"]
    assert more.adaptation_curve[0] == pytest.approx(first)
    assert more.adaptation_curve[1] != pytest.approx(second)


def test_plot_draws_the_paths_in_the_test_tasks(trained: Path, call: Call, tmp_path: Path) -> None:
    file = tmp_path / "paths.svg"
    code, _, errors = call("evaluate", trained, "--protocol", "offline", "--plot", file, "--quiet")
    assert code == 0, errors
    assert "<svg" in file.read_text(encoding="utf-8")[:1000]
    assert_refused(call("evaluate", trained, "--plot", tmp_path / "paths.gif", "--quiet"), ".png, .svg")
    assert_refused(call("evaluate", trained, "--protocol", "all", "--plot", file, "--quiet"), "--protocol")
    assert list(tmp_path.iterdir()) == [file]


def test_paths_without_a_plane_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(TcmrlError, match="half-cheetah-vel has no paths in a plane"):
        check_plot(tmp_path / "paths.png", environment_of("half-cheetah-vel"))


def test_evaluations_by_every_protocol_fit_a_terminal_with_every_number_whole(trained: Path) -> None:
    shown = as_in_terminal(tcmrl, "evaluate", trained, "--protocol", "all", "--quiet")
    assert shown.code == 0
    assert_fits(shown.output)
    assert "offline_train" not in shown.output  # its tasks are others
    for protocol in sorted(set(PROTOCOLS.names()) - {"offline_train"}):
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
        task=0, split="test", returns=[], final=-1234.56, finals=[-1234.56], oracle=-1023.45, random=-9876.54,
        behavior=-1050.0, fixed=-4321.0,
        regret=1000.0, normalized=0.9, reference="oracle", success=0.25, shuffled=-1234.57,
    )  # fmt: skip
    tasks = [replace(task, task=index) for index in range(20)]
    result = Evaluation(
        "a_method", "walker-rand-params", 10, "offline", 1, tasks, [], 0.0, None, None, 0.0, 0.0, 0.0, True
    )
    for table in score_tables([result, replace(result, protocol="a_new_protocol")]):
        print_table(table)  # to a pipe: as wide as its columns
    output = capsys.readouterr().out
    assert_fits(output)
    assert output.count("-9,876.54") == 1 + 2 + 2 * 21  # controls, means, tasks and their mean


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
    """A third-party package with a protocol, and another that cannot be imported."""
    modules = {"borrowed_protocol": PLUGIN, "torn_protocol": "import no_such_module"}
    lines = "borrowed = borrowed_protocol:Plugin\ntorn = torn_protocol:Plugin"
    install(tmp_path, "foreign", modules=modules, declares={"tcmrl.protocols": lines})
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("foreign")
def test_a_protocol_of_another_package_evaluates_beside_ours(trained: Path, call: Call) -> None:
    code, output, errors = call("evaluate", trained, "--protocol", "all", "--json")
    assert code == 0
    assert [document["protocol"] for document in json.loads(output)] == sorted(
        ["borrowed", "idaq", "idaq_literal", "non_prior", "offline", "paper"]
    )
    assert "left out: protocol 'torn' of package 'foreign' is broken: ModuleNotFoundError" in errors
    assert_refused(call("evaluate", trained, "--protocol", "torn"), "'torn'", "no_such_module")
    assert_refused(call("evaluate", trained, "--protocol", "borowed"), "did you mean borrowed")


def test_a_training_table_with_an_unknown_protocol_is_refused(tiny: Dataset) -> None:
    table = tiny.manifest.training["quick"]
    with pytest.raises(TrainingError, match=r"here, run.protocol: .*'papr'; did you mean paper\?"):
        resolve(table, place="here", overrides=["run.protocol=papr"])


def train_briefly(name: str, dataset: Dataset, folder: Path) -> Path:
    """A run of three steps."""
    table = {"run": {"steps": 3, "episodes": 2, "random_episodes": 0}, "batch": {"transitions": 8}}
    config = resolve(table, place="here", algorithm=name)
    train_run(dataset, folder, config=config, profile="quick")
    return folder


def test_a_privileged_control_is_marked_wherever_its_returns_stand(
    trained: Path, tiny: Dataset, tmp_path: Path, call: Call
) -> None:
    folder = train_briefly("task_known", tiny, tmp_path / "run")
    code, output, errors = call("evaluate", folder, "--protocol", "all")
    assert code == 0
    assert "task_known (privileged) on point-robot" in " ".join(output.split())
    assert "privileged: a control that observes the task parameters" in errors
    assert json.loads(call("evaluate", folder, "--json")[1])["privileged"] is True
    assert open_run(folder).record.privileged
    assert not open_run(trained).record.privileged
    assert json.loads(call("evaluate", trained, "--json")[1])["privileged"] is False


def test_a_stateful_method_is_evaluated_from_its_prior(tiny: Dataset, tmp_path: Path) -> None:
    folder = train_briefly("borel", tiny, tmp_path / "run")
    for protocol in PROTOCOLS.names():
        evaluation = evaluate_run(folder, protocol=protocol)
        assert [len(task.returns) for task in evaluation.tasks] == [2]
        assert evaluation == evaluate_run(folder, protocol=protocol)


def test_evaluate_command_refuses_bad_input_in_one_line(trained: Path, tmp_path: Path, call: Call) -> None:
    for arguments, expected in (
        ((tmp_path / "none",), "no run.json"),
        ((trained, "--dataset", tmp_path / "none"), "none"),
        ((trained, "--protocol", "oflin"), "unknown protocol 'oflin'; did you mean offline"),
        ((trained, "--episodes", "0"), "--episodes"),
    ):
        assert_refused(call("evaluate", *arguments), expected)
