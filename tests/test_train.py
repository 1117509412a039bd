"""Training: determinism, resuming, checkpoints, metrics, and `tcmrl train`."""

import importlib.metadata
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from tcmrl_cli.train import tcmrl

import tcmrl_algo
from tcmrl_algo import open_run, resume_run, train_run
from tcmrl_algo.algorithms.core.context import ContextAlgorithm
from tcmrl_algo.algorithms.core.method import METHODS
from tcmrl_algo.evaluation.arena import Arena
from tcmrl_algo.training.checkpoint import list_runs
from tcmrl_algo.training.train import TrainingProgress
from tcmrl_data import CheckpointError, Dataset, SelectionError, Task, TrainingError
from tests.commands import Call, assert_refused
from tests.datasets import with_tasks
from tests.small_training import SMALL, config_of
from tests.terminal import as_in_terminal

PROGRAM = tcmrl

Train = Callable[..., tcmrl_algo.TrainingReport]


@pytest.fixture
def start(tiny: Dataset, tmp_path: Path) -> Train:
    """Trains a small run on the tiny dataset in a new folder."""

    def start(name: str, *overrides: str, algorithm: str | None = None, **more: Any) -> Any:
        config = config_of(tiny, *overrides, algorithm=algorithm)
        return train_run(tiny, tmp_path / name, config=config, profile="quick", **more)

    return start


@pytest.mark.parametrize("algorithm", METHODS.names())
def test_one_seed_gives_the_same_parameters_after_40_steps(start: Train, algorithm: str) -> None:
    first = start("first", algorithm=algorithm, steps=40, seed=3)
    torch.manual_seed(12345)  # the global state has no influence
    second = start("second", algorithm=algorithm, steps=40, seed=3)
    assert first.digest == second.digest
    digests = {start(f"seed {seed}", algorithm=algorithm, steps=1, seed=seed).digest for seed in (3, 4)}
    assert len(digests) == 2


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("algorithm", METHODS.names())
def test_every_method_trains_and_resumes_on_a_gpu_as_on_the_cpu(
    start: Train, tiny: Dataset, algorithm: str
) -> None:
    runs = [
        start(device, "run.log_every=1", algorithm=algorithm, steps=2, device=device, seed=3).run.folder
        for device in ("cpu", "cuda")
    ]
    on_cpu, on_gpu = (_metrics(folder)[0] for folder in runs)
    assert on_gpu.pop("stage") == on_cpu.pop("stage")
    assert on_gpu == pytest.approx(on_cpu, rel=1e-3, abs=1e-5)
    assert resume_run(runs[1], tiny, steps=4).step == 4


def test_precision_reaches_training_and_keeps_it_repeatable(start: Train) -> None:
    first = start("first", "run.precision=bfloat16", steps=20)
    assert start("second", "run.precision=bfloat16", steps=20).digest == first.digest
    assert start("third", "run.precision=float32", steps=20).digest != first.digest


@pytest.mark.parametrize("brac", ["off", pytest.param("policy", marks=pytest.mark.check)])
def test_resuming_at_50_gives_the_same_parameters_at_100(start: Train, tiny: Dataset, brac: str) -> None:
    mode = f"actor_critic.brac.mode={brac}"
    straight = start("straight", mode, steps=100)
    half = start("half", mode, steps=50)
    assert half.digest != straight.digest
    resumed = resume_run(half.run.folder, tiny, steps=100)
    assert resumed.digest == straight.digest
    assert open_run(half.run.folder).newest().step == 100
    lines = [_metrics(report.run.folder) for report in (straight, half)]
    assert lines[0] == lines[1]


def test_a_run_killed_between_checkpoints_resumes_from_the_last(
    start: Train, tiny: Dataset, tmp_path: Path
) -> None:
    class Killed(Exception):
        pass

    def kill(progress: TrainingProgress) -> None:
        if progress.step >= 40:
            raise Killed

    with pytest.raises(Killed):
        start("killed", steps=60, report=kill)
    killed = open_run(tmp_path / "killed")
    assert killed.newest().step == 25
    assert _metrics(killed.folder)[-1]["step"] == 40
    resumed = resume_run(killed.folder, tiny)
    straight = start("straight", steps=60)
    assert resumed.digest == straight.digest
    assert _metrics(killed.folder) == _metrics(straight.run.folder)  # lines after step 25 are dropped


def test_an_error_of_a_method_before_the_first_checkpoint_blocks_no_next_run(
    start: Train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ContextAlgorithm, "loss", lambda *_: torch.zeros(2) @ torch.zeros(3))
        with pytest.raises(RuntimeError, match="size"):
            start("run", steps=30)
    assert start("run", steps=10).step == 10


def _metrics(folder: Path) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if not name.startswith("time/")} for line in lines]


def test_a_run_records_what_it_is_a_function_of(start: Train, tiny: Dataset) -> None:
    report = start("run", steps=10, seed=7)
    record = open_run(report.run.folder).record
    assert (record.seed, record.steps, record.profile) == (7, 10, "quick")
    assert record.root == tiny.manifest.root
    assert record.config == config_of(tiny)
    assert record.versions["torch"] == importlib.metadata.version(
        "torch"
    )  # torch says "+cu130" of PyPI's build


def test_metrics_are_logged_as_lines_and_to_tensorboard(start: Train) -> None:
    folder = start("run", steps=25).run.folder
    lines = _metrics(folder)
    assert [line["step"] for line in lines] == [10, 20, 25]
    assert {"loss/positive", "loss/negative", "loss/sparsity", "loss/contrastive", "loss/critic"} <= set(
        lines[0]
    )
    assert list((folder / "tensorboard").glob("events*"))
    raw = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert all(0 <= line["time/data_share"] <= 1 for line in raw)
    assert {line["data/short_trajectories"] for line in raw} == {0.0}


def test_only_the_newest_checkpoints_stay(start: Train, tiny: Dataset) -> None:
    run = start("run", steps=30).run
    (run.folder / ".staging" / "step_000000055.killed").mkdir()
    resume_run(run.folder, tiny, steps=80)
    found = run.checkpoints()
    assert len(list((run.folder / "checkpoints").iterdir())) == 2
    assert list((run.folder / ".staging").iterdir()) == []
    assert [checkpoint.step for checkpoint in found] == [75, 80]
    assert sorted(path.name for path in found[0].folder.iterdir()) == [
        "checkpoint.json",
        "tensors.safetensors",
    ]


def test_a_damaged_checkpoint_is_refused(start: Train, tiny: Dataset) -> None:
    run = start("run", steps=10).run
    file = run.newest().folder / "tensors.safetensors"
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(bytes(content))
    with pytest.raises(CheckpointError, match="damaged"):
        resume_run(run.folder, tiny, steps=20)


def test_a_run_goes_on_with_its_own_dataset_alone(start: Train, tiny: Dataset) -> None:
    run = start("run", steps=10).run
    manifest = tiny.manifest.model_copy(update={"root": "0" * 64})
    other = Dataset(tiny.folder, manifest)
    with pytest.raises(CheckpointError, match="root 000000000000"):
        resume_run(run.folder, other, steps=20)
    with pytest.raises(CheckpointError, match="at step 10 already"):
        resume_run(run.folder, tiny, steps=5)


def test_a_run_is_never_overwritten(start: Train) -> None:
    start("run", steps=10)
    with pytest.raises(CheckpointError, match="--resume"):
        start("run", steps=10)


def test_what_cannot_start_leaves_nothing(start: Train, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="--device 'nonsense'"):
        start("run", device="nonsense")
    with pytest.raises(SelectionError, match="steps>=9999"):
        start("run", "run.snapshots=steps>=9999")
    with pytest.raises(SelectionError, match="trajectories"):
        start("run", "batch.context_trajectories=[50]")
    assert not (tmp_path / "run").exists()


def test_fewer_than_two_training_tasks_are_refused(tiny: Dataset, tmp_path: Path) -> None:
    train, test = tiny.train_tasks[0], tiny.test_tasks[0]
    lone = with_tasks(tiny, {train.index, test.index})
    with pytest.raises(SelectionError, match="at least 2 training tasks"):
        train_run(lone, tmp_path / "run", config=config_of(tiny), profile="quick")


def test_a_loss_that_is_not_finite_stops_with_its_name_and_step(start: Train, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"is not finite at step \d+"):
        start("run", "optimizer.learning_rate=1e30", steps=50)
    assert not list((tmp_path / "run").glob("checkpoints/step_*"))


def test_an_exploding_q_stops_with_its_name_and_step_and_keeps_the_last_checkpoint(
    start: Train, tmp_path: Path
) -> None:
    wild = ("actor_critic.clip_targets=false", "actor_critic.divergence_factor=2", "actor_critic.tau=1")
    rates = ("optimizer.learning_rate=0.3", "run.checkpoint_every=1")
    with pytest.raises(TrainingError, match=r"actor_critic/largest_q is .*, beyond .* at step \d+") as caught:
        start("run", *wild, *rates, steps=400)
    step = int(str(caught.value).partition("at step ")[2].partition(";")[0])
    assert open_run(tmp_path / "run").newest().step == step - 1  # the last one before
    assert all(tensor.isfinite().all() for tensor in open_run(tmp_path / "run").newest().tensors().values())


def test_contexts_may_come_from_other_snapshots_than_transitions(start: Train, tiny: Dataset) -> None:
    digests = {
        start(str(index), f"run.snapshots={own}", *other, steps=3).digest
        for index, (own, other) in enumerate(
            [
                ("last", ()),
                ("all", ()),
                ("last", ["run.context_snapshots=all"]),
                ("all", ["run.context_snapshots=last"]),
            ]
        )
    }
    assert len(digests) == 4


def test_a_slow_step_is_reported_before_it_is_logged(start: Train, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tcmrl_algo.training.train.SHOWN_SECONDS", 0.0)
    seen: list[TrainingProgress] = []
    folder = start("run", steps=25, report=seen.append).run.folder
    assert [progress.step for progress in seen] == list(range(1, 26))
    assert all(progress.rate > 0 and "loss/critic" in progress.metrics for progress in seen)
    assert [line["step"] for line in _metrics(folder)] == [10, 20, 25]


@pytest.mark.parametrize("algorithm", ["tcmrl", "macaw", "task_known"])
def test_a_watched_run_has_the_tensors_of_an_unwatched_one(
    start: Train, tiny: Dataset, tmp_path: Path, algorithm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    straight = start("straight", algorithm=algorithm, steps=20)
    played: list[int] = []
    adapted = Arena.adapted

    def play(arena: Arena, tasks: Sequence[Task], contexts: Sequence[Any], **more: Any) -> Any:
        played.extend(task.index for task in tasks)
        return adapted(arena, tasks, contexts, **more)

    monkeypatch.setattr(Arena, "adapted", play)
    seen: list[TrainingProgress] = []
    watch = tcmrl_algo.TrainingWatch(tiny, every=8)
    watched = start("watched", algorithm=algorithm, steps=20, watch=watch, report=seen.append)
    assert watched.digest == straight.digest
    assert set(played) <= {task.index for task in tiny.train_tasks}
    lines = {line["step"]: line for line in _metrics(watched.run.folder)}
    returns = {step: line["watch/return"] for step, line in lines.items() if "watch/return" in line}
    assert sorted(returns) == [8, 16] and sorted(lines) == [8, 10, 16, 20]
    assert seen[-1].watched == returns[16]
    assert watch.seconds > 0
    (row,) = (row for row in list_runs(tmp_path) if row["path"] == str(watched.run.folder))
    assert row["metrics"]["watch/return"] == returns[16]


def test_watching_says_which_tasks_and_what_it_took(tiny_folder: Path, tmp_path: Path, call: Call) -> None:
    sets = [word for value in (*SMALL, "run.steps=10") for word in ("--set", value)]
    code, _, errors = call("train", tiny_folder, "--watch", 5, "--out", tmp_path / "run", *sets)
    assert code == 0
    assert re.search(r"watching training tasks [0-9, ]+ every 5 steps: uniform actions -[0-9.]+", errors)
    assert re.search(r"watching took .* of ", errors)
    assert re.search(r"-[0-9]+", call("runs", tmp_path)[1])


def test_the_memory_limit_changes_where_data_are_and_no_result(
    start: Train, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "cache"))
    said: list[str] = []
    straight = start("memory", steps=20, say=said.append)
    assert said == []
    half = start("cache", steps=10, memory_limit=1000, say=said.append)
    assert "exceed the memory limit" in said[0]
    assert list((tmp_path / "cache" / "rows").iterdir())
    assert resume_run(half.run.folder, tiny, steps=20, memory_limit=1000).digest == straight.digest


@pytest.mark.parametrize("depth", [0, 5])
def test_results_do_not_depend_on_prefetching(
    start: Train, depth: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = start("two", steps=15).digest
    monkeypatch.setattr("tcmrl_algo.training.train.PREFETCHED", depth)
    assert start("other", steps=15).digest == expected


def test_train_command_prints_one_json_document(
    tiny_folder: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    settings = [argument for text in SMALL for argument in ("--set", text)]
    code, output, errors = call(
        "train", tiny_folder / "manifest.json", "--seed", 2, "--stop-at", 20, *settings, "--json", "--quiet"
    )
    document = json.loads(output)
    assert (code, errors) == (0, "")
    assert set(document) == {
        "run", "algorithm", "environment", "profile", "seed", "steps", "seconds", "digest"
    }  # fmt: skip
    assert document["run"] == "runs/point-robot-tcmrl-seed2"
    code, output, errors = call("train", tiny_folder, "--seed", 2, "--stop-at", 30, "--resume")
    assert code == 0
    assert "30 steps" in output
    assert "tcmrl evaluate runs/point-robot-tcmrl-seed2" in errors


def test_train_command_refuses_bad_input_in_one_line(tiny_folder: Path, tmp_path: Path, call: Call) -> None:
    out = ("--out", tmp_path / "run")
    assert_refused(call("train", tmp_path / "none", *out), "none")
    assert_refused(call("train", tiny_folder, "--algo", "tcmlr", *out), "tcmlr", "tcmrl")
    assert_refused(call("train", tiny_folder, "--set", "tcmrl.latent=wide", *out), "latent", "wide")
    assert_refused(call("train", tiny_folder, "--set", "run.snapshots=steps>=1", "--set", "x=1", *out), "x=1")
    assert_refused(call("train", tiny_folder, "--set", "run.snapshots='steps>=999'", *out), "steps>=999")
    assert_refused(call("train", tiny_folder, "--resume", *out), "no run")
    assert_refused(call("train", tiny_folder, "--resume", "--set", "run.steps=3", *out), "no run")
    assert_refused(call("train", tiny_folder, "--stop-at", "0", *out), "--stop-at")
    assert_refused(call("train", tiny_folder, "--memory-limit", "much", *out), "much", "2G")
    assert not (tmp_path / "run").exists()


def test_the_list_of_runs_says_how_far_they_are(start: Train, tmp_path: Path, call: Call) -> None:
    assert json.loads(call("runs", tmp_path, "--json")[1]) == {"runs": []}
    folder = start("first", steps=10, seed=3).run.folder
    lines = [
        '{"step": 5, "protocol": "paper", "final": 1.0}',
        '{"step": 10, "protocol": "idaq", "final": -2.5}',
    ]
    (folder / "evaluations.jsonl").write_text("\n".join([*lines, '{"st']))
    (tmp_path / "second").mkdir()
    (tmp_path / "second/run.json").write_text("{")
    first, second = json.loads(call("runs", tmp_path, "--json")[1])["runs"]
    assert (first["path"], first["algorithm"], first["seed"]) == (str(folder), "tcmrl", 3)
    assert (first["step"], first["steps"], first["evaluation"]["final"]) == (10, 10, -2.5)
    assert "run.json" in second["error"]
    narrow = as_in_terminal(tcmrl, "runs", tmp_path, columns=40).output
    assert first["path"] in narrow  # in one piece, to be copied
    output = call("runs", tmp_path)[1]
    assert "tcmrl on point-robot, seed 3" in output and "10/10" in output and "idaq -2.50" in output
    assert first["root"][:12] in output
    loss = f"{first['metrics']['loss/critic']:.4g}"
    assert loss in call("runs", tmp_path, "--metric", "loss/critic")[1] and loss not in output
    assert_refused(call("runs", tmp_path / "nothing"), "nothing", "is not a folder")


def test_resume_refuses_another_seed(start: Train, tiny_folder: Path, call: Call) -> None:
    folder = start("run", steps=10, seed=1).run.folder
    result = call("train", tiny_folder, "--resume", "--seed", 2, "--out", folder)
    assert_refused(result, "--seed 1", "not 2")
