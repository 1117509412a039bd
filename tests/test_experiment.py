"""Experiments: files, plans, runs in a results folder, resuming, and `tcmrl experiment`."""

import csv
import json
import shutil
import signal
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tcmrl_cli.train import tcmrl

import tcmrl_data
from tcmrl_algo import METHODS, experiment_names, load_experiment, open_run, run_experiment, train_run
from tcmrl_algo.experiment.job import code_commit, run_job
from tcmrl_algo.experiment.plan import plan_runs, resolve_method
from tcmrl_algo.experiment.results import RunResult, read_result, read_results
from tcmrl_algo.experiment.spec import Experiment, read_experiment
from tcmrl_algo.training.checkpoint import write_run
from tcmrl_data import SelectionError, TcmrlError, TrainingError
from tcmrl_data.foundation.machine import available_cores, processor
from tcmrl_data.foundation.records import read_record
from tests import experiments
from tests.commands import Call, assert_refused
from tests.directed import EXPERIMENT, Directions
from tests.terminal import as_in_terminal, assert_fits
from tests.workers import PATIENCE, command_line, marked_pids, wait_for

PROGRAM = tcmrl

CLAIM = {"text": "TCMRL ends higher", "better": "TCMRL", "worse": "no context"}
PARTS = ("final", "shuffled", "regret")
FILES = {f"point-robot--{method}--seed{seed}" for method in ("tcmrl", "no-context") for seed in (0, 1)}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, small_results: Path) -> Path:
    """The results folder of the small experiment; one of this process, because every call locks it."""
    return Path(shutil.copytree(small_results, tmp_path_factory.mktemp("results") / "small"))


def _small(dataset: Path, **changes: Any) -> Experiment:
    return read_experiment(experiments.tables(dataset, **changes), place="test")


def test_one_document_per_run_and_one_table(finished: Path, tiny_folder: Path) -> None:
    assert {path.stem for path in finished.glob("runs/*.json")} == FILES
    result = read_record(RunResult, finished / "runs/point-robot--tcmrl--seed1.json")
    run = open_run(finished / "runs/point-robot--tcmrl--seed1")
    assert result.root == tcmrl_data.open_dataset(tiny_folder).manifest.root
    assert (result.method, result.seed, result.steps) == ("TCMRL", 1, 40)
    assert result.config == run.record.config
    assert result.config.method["latent"] == 4
    assert [point.step for point in result.curve] == [20, 40]
    assert sum(point.timed_steps for point in result.curve) == 40
    assert list(result.evaluations) == ["offline", "paper"]
    assert result.evaluations["offline"]["mean_final"] == result.curve[-1].final
    assert result.training_seconds is not None and result.training_seconds > 0
    assert result.peak_memory is not None and result.peak_memory > 50e6
    assert result.threads == result.config.settings.run.threads == max(1, available_cores() // 2)
    assert {"torch", "tcmrl"} <= set(result.versions)
    assert result.behavior_seed == tcmrl_data.open_dataset(tiny_folder).manifest.seed
    assert (result.commit, result.processor) == (code_commit(), processor())
    rows = list(csv.DictReader((finished / "table.csv").read_text().splitlines()))
    assert [row["method"] for row in rows] == ["TCMRL"] * 4 + ["no context"] * 4
    assert float(rows[2]["final"]) == result.evaluations["offline"]["mean_final"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_runs_that_a_gpu_trained_are_evaluated_where_there_is_none(
    small_results: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    results = Path(shutil.copytree(small_results, tmp_path / "small"))
    file = results / "runs/point-robot--tcmrl--seed1.json"
    before = read_record(RunResult, file)
    file.unlink()
    run = open_run(file.with_suffix(""))
    write_run(run.folder, run.record.model_copy(update={"device": "cuda"}))
    run_experiment(_small(tiny_folder), results)
    result = read_record(RunResult, file)
    assert (result.digest, result.device, result.processor) == (before.digest, "cuda", None)
    assert result.evaluations == before.evaluations


def test_a_second_call_does_nothing_and_says_the_same(
    finished: Path, tiny_folder: Path, tmp_path: Path, call: Call
) -> None:
    file = experiments.write_file(tmp_path / "small.toml", experiments.tables(tiny_folder))
    before = {path: path.stat().st_mtime_ns for path in finished.glob("runs/*.json")}
    code, output, errors = call("experiment", file, "--out", finished, "--json")
    document = json.loads(output)
    assert (code, errors) == (0, "")
    assert (document["ran"], document["present"], document["failed"]) == (0, 4, [])
    assert len(document["rows"]) == 8
    assert {path: path.stat().st_mtime_ns for path in finished.glob("runs/*.json")} == before
    code, output, errors = call("experiment", file, "--out", finished)
    assert "TCMRL" in output and "0 runs done, 4 already present" in output


def test_tables_by_protocol_fit_a_terminal_with_every_number_whole(
    finished: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    file = experiments.write_file(tmp_path / "small.toml", experiments.tables(tiny_folder))
    shown = as_in_terminal(tcmrl, "experiment", file, "--out", finished)
    tables = shown.output[: shown.output.index(str(finished))]  # a line of words wraps, nothing is lost
    assert_fits(tables)
    lines = [line.split() for line in tables.splitlines()]
    for protocol in ("offline", "paper"):
        assert f"point-robot, protocol {protocol}: returns" in tables
        results = read_results(finished, _small(tiny_folder))
        rows = [row for result in results for row in result.rows() if row["protocol"] == protocol]
        for method in ("TCMRL", "no context"):
            values = [[row[part] for row in rows if row["method"] == method] for part in PARTS]
            means = [f"{sum(found) / len(found):,.2f}" for found in values]
            assert [*method.split(), "2", means[0], "–", *means[1:]] in lines


def test_other_settings_or_data_are_refused_by_name(
    finished: Path, tiny_folder: Path, tiny_copy: Callable[[], Path], tmp_path: Path, call: Call
) -> None:
    file = experiments.write_file(tmp_path / "small.toml", experiments.tables(tiny_folder))
    assert_refused(call("experiment", file, "--out", finished, "--steps", 80), "run.steps 40", "80", "--out")
    changed = experiments.tables(tiny_folder, curve_points=4)
    file = experiments.write_file(tmp_path / "curve.toml", changed)
    assert_refused(call("experiment", file, "--out", finished), "curve_points 2", "4")
    result = finished / "runs/point-robot--tcmrl--seed0.json"
    record = read_record(RunResult, result)
    other = finished.parent / "other"
    (other / "runs").mkdir(parents=True)
    forged = record.model_copy(update={"identity": record.identity | {"root": "0" * 64}})
    (other / "runs" / result.name).write_text(forged.model_dump_json())
    with pytest.raises(TcmrlError, match="root '000"):
        run_experiment(_small(tiny_folder), other)


def test_one_folder_never_holds_two_settings_of_a_method(
    finished: Path, tiny_folder: Path, tmp_path: Path, call: Call
) -> None:
    file = experiments.write_file(tmp_path / "small.toml", experiments.tables(tiny_folder))
    new = ["experiment", file, "--out", finished, "--seeds", "7"]
    assert_refused(call(*new, "--steps", 80), "run.steps 40", "80")
    changed = experiments.tables(tiny_folder)
    changed["methods"]["no context"]["training"]["run"]["log_every"] = 5
    file = experiments.write_file(tmp_path / "changed.toml", changed)
    assert_refused(
        call("experiment", file, "--out", finished, "--seeds", "7", "--only", "TCMRL"), "log_every 20"
    )
    assert {path.stem for path in finished.glob("runs/*.json")} == FILES


def test_only_and_seeds_choose_runs_and_the_table_keeps_the_rest(
    finished: Path, tiny_folder: Path, tmp_path: Path, call: Call
) -> None:
    file = experiments.write_file(tmp_path / "small.toml", experiments.tables(tiny_folder))
    arguments = ["--only", "TCMRL", "--seeds", "1", "--json"]
    code, output, _ = call("experiment", file, "--out", finished, *arguments)
    assert (code, json.loads(output)["present"]) == (0, 1)
    assert len((finished / "table.csv").read_text().splitlines()) == 9
    assert_refused(call("experiment", file, "--only", "TCMLR"), "'TCMLR'", "'no context'")
    assert_refused(call("experiment", file, "--seeds", "1-x"), "--seeds", "1-x")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"sedes": [0]}, ["sedes"]),
        ({"seeds": [0, 0]}, ["seeds", "distinct"]),
        ({"seeds": []}, ["seeds"]),
        ({"protocols": ["ofline"], "claims": []}, ["protocols", "'ofline'; did you mean offline"]),
        ({"claims": [CLAIM | {"protocols": ["idaq"]}]}, ["'idaq' is not evaluated", "offline, paper"]),
        ({"name": "../up"}, ["name"]),
        ({"schema": 2}, ["schema"]),
        ({"curve_points": 41}, ["41", "40"]),
        ({"methods": {"A": {"algorithm": "tcmlr"}}, "claims": []}, ["tcmlr", "tcmrl"]),
        ({"methods": {"A": {"algorithm": "tcmrl"}}}, ["claim", "'TCMRL'", "'A'"]),
        ({"methods": {"A b": {"algorithm": "tcmrl"}, "A-B": {"algorithm": "tcmrl"}}}, ["methods", "a-b"]),
        ({"training": {"tcmrl": {"latnet": 3}}}, ["latnet", "'TCMRL'"]),
        ({"training": {"run": {"steps": "many"}}}, ["steps", "many"]),
        (
            {"environments": {"point-robot": {"dataset": "nowhere"}}},
            ["nowhere", "tcmrl-data build point-robot"],
        ),
        ({"environments": {"point-robot": {"profile": "fast"}}}, ["fast", "quick"]),
        ({"environments": {"half-cheetah-vel": {}}}, ["half-cheetah-vel"]),
        ({"training": {"run": {"snapshots": "steps>=9999"}}}, ["9999"]),
        ({"training": {"run": {"context_snapshots": "best"}}}, ["best"]),
    ],
    ids=str,
)
def test_a_bad_file_is_refused_before_anything_starts(
    changes: dict[str, Any], expected: list[str], tiny_folder: Path, tmp_path: Path, call: Call
) -> None:
    content = experiments.tables(tiny_folder, **changes)
    for choice in content["environments"].values():
        choice.setdefault("dataset", str(tiny_folder))
    file = experiments.write_file(tmp_path / "bad.toml", content)
    assert_refused(call("experiment", file, "--out", tmp_path / "out"), *expected)
    assert not (tmp_path / "out").exists()


def test_unknown_names_and_broken_files_are_refused(tmp_path: Path, call: Call) -> None:
    assert_refused(call("experiment", "perspective"), "perspective", "did you mean perspectives")
    assert_refused(call("experiment"), "--list")
    assert_refused(call("experiment", tmp_path / "none.toml"), "none.toml")
    (tmp_path / "broken.toml").write_text("name = ")
    assert_refused(call("experiment", tmp_path / "broken.toml"), "no TOML")


def test_the_list_of_experiments_says_what_each_asks(call: Call) -> None:
    rows = json.loads(call("experiment", "--list", "--json")[1])["experiments"]
    assert [row["name"] for row in rows] == experiment_names()
    assert all(row["title"] and row["methods"] and row["seeds"] for row in rows)
    shown = as_in_terminal(tcmrl, "experiment", "--list")
    assert_fits(shown.output)
    assert all(name in shown.output for name in experiment_names())


def test_data_may_name_the_one_dataset_itself(tiny_folder: Path, tmp_path: Path) -> None:
    tour = load_experiment("tour")
    with pytest.raises(SelectionError, match=r"--profile quick --out data/demo.*--data"):
        plan_runs(tour, data=None, out=tmp_path)
    runs = plan_runs(tour, data=tiny_folder, out=tmp_path)
    assert {run.dataset for run in runs} == {str(tiny_folder.resolve())}
    assert len(runs) == 10


def test_a_methods_changes_go_over_the_environments_over_the_experiments(tiny_folder: Path) -> None:
    content = experiments.tables(tiny_folder)
    table = dict(tcmrl_data.load_recipe("point-robot").training)["quick"]

    def latent() -> Any:
        made = read_experiment(content, place="test")
        config = resolve_method(made, table, environment="point-robot", label="TCMRL", place="test")
        return config.method["latent"]

    assert latent() == 4  # the experiment's
    content["environments"]["point-robot"]["training"] = {"tcmrl": {"latent": 5}}
    assert latent() == 5
    content["methods"]["TCMRL"]["training"] = {"tcmrl": {"latent": 6}}
    assert latent() == 6


def test_the_process_of_a_run_makes_the_result_that_this_process_makes(
    finished: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    """All but the seconds and the memory."""
    (result,) = run_experiment(_small(tiny_folder), tmp_path, only=["TCMRL"], seeds=[1], workers=2).results
    here = read_record(RunResult, finished / "runs/point-robot--tcmrl--seed1.json")
    assert _without_costs(result) == _without_costs(here)


def _without_costs(result: RunResult) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(result.model_dump_json())
    for one in (document, *document["curve"]):
        for name in [name for name in one if name.endswith(("seconds", "memory"))]:
            del one[name]
    return document


@pytest.mark.usefixtures("in_process")
def test_a_failed_run_is_told_and_tried_again(tiny_folder: Path, tmp_path: Path, call: Call) -> None:
    content = experiments.tables(tiny_folder, seeds=[0])
    content["methods"] |= {
        "broken": {"algorithm": "tcmrl", "training": {"optimizer": {"learning_rate": 1e6}}}
    }
    file = experiments.write_file(tmp_path / "small.toml", content)
    out = tmp_path / "out"
    arguments = ["experiment", file, "--out", out, "--only", "broken"]
    code, output, errors = call(*arguments)
    assert code == 1
    assert "at step" in errors and "run the same command again" in errors
    assert "Next:" not in output + errors
    assert not list(out.glob("runs/*.json"))
    assert "at step" in (out / "runs/point-robot--broken--seed0/error.txt").read_text()
    assert call(*arguments, "--quiet")[0] == 1


@pytest.mark.check
@pytest.mark.usefixtures("in_process")
def test_what_never_began_takes_a_new_device_and_new_threads(
    tiny_folder: Path, tmp_path: Path, call: Call
) -> None:
    content = experiments.tables(tiny_folder, protocols=["offline"], curve_points=1, claims=[])
    file = experiments.write_file(tmp_path / "small.toml", content)
    arguments = ["experiment", file, "--out", tmp_path / "out", "--only", "TCMRL", "--seeds", "0"]
    assert_refused(call(*arguments, "--device", "cudda"), "--device 'cudda'")
    assert not (tmp_path / "out").exists()
    job = tmp_path / "out/runs/point-robot--tcmrl--seed0/job.json"
    cores = available_cores()
    for workers in (cores, 1):  # the first is killed before its run begins
        assert call(*arguments, "--workers", workers)[0] == 0
        assert json.loads(job.read_text())["config"]["settings"]["run"]["threads"] == cores // workers
        shutil.rmtree(job.parent / "checkpoints")
        (job.parent / "run.json").unlink()
        job.parent.with_name(f"{job.parent.name}.json").unlink()


@pytest.mark.check
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL], ids=str)
def test_a_stopped_experiment_leaves_no_process_and_ends_as_if_never_stopped(
    end: signal.Signals, tiny_folder: Path, tmp_path: Path
) -> None:
    """The run waits after its first steps; at the first report, no more than one checkpoint is there."""
    content = experiments.tables(tiny_folder)
    file = experiments.write_file(tmp_path / "small.toml", content)
    out = tmp_path / "out"
    arguments = ["experiment", str(file), "--out", str(out), "--only", "TCMRL", "--seeds", "1"]
    folder, own = out / "runs/point-robot--tcmrl--seed1", uuid.uuid4().hex
    directions = Directions(str(tmp_path / "directions"), at="steps", passes=1, driver=EXPERIMENT).hold()
    with command_line(*arguments, program="tcmrl", directions=directions, mark=own) as process:
        directions.wait(process)
        process.send_signal(end)
        _, errors = process.communicate(timeout=PATIENCE)
    wait_for(lambda: not marked_pids(own), "the end of all workers")
    assert process.returncode == (1 if end == signal.SIGINT else -signal.SIGKILL)
    assert ("to continue, run" in errors) == (end == signal.SIGINT)
    assert not folder.with_name(f"{folder.name}.json").exists()
    assert open_run(folder).newest().step in (10, 20)
    experiment = read_experiment(content, place="test")
    (resumed,) = run_experiment(experiment, out, only=["TCMRL"], seeds=[1]).results
    dataset = tcmrl_data.open_dataset(tiny_folder)
    straight = train_run(dataset, tmp_path / "straight", config=resumed.config, profile="quick", seed=1)
    assert resumed.digest == straight.digest
    assert [point.step for point in resumed.curve] == [20, 40]


def test_points_of_a_curve_name_the_stage_they_lie_in(tiny_folder: Path, tmp_path: Path) -> None:
    method = {"algorithm": "double_stages", "training": {"double_stages": {"model_steps": 20}}}
    experiment = _small(tiny_folder, methods={"staged": method}, seeds=[0], claims=[])
    (job,) = plan_runs(experiment, data=tiny_folder, out=tmp_path)
    run_job(job, lambda event: None)
    result = read_result(Path(job.folder))
    assert [(point.step, point.stage) for point in result.curve] == [(20, "model"), (40, "policy")]


def test_an_experiment_without_protocols_evaluates_by_the_papers_three(tiny_folder: Path) -> None:
    content = experiments.tables(tiny_folder)
    del content["protocols"]
    assert read_experiment(content, place="test").protocols == ("paper", "offline", "idaq")


def test_a_file_like_another_takes_what_it_leaves_out(tiny_folder: Path, tmp_path: Path) -> None:
    model = experiments.tables(tiny_folder)
    experiments.write_file(tmp_path / "model.toml", model)
    changes = {"like": "model.toml", "name": "other", "seeds": [7], "protocols": ["idaq"]}
    found = load_experiment(experiments.write_file(tmp_path / "other.toml", changes))
    del changes["like"]
    assert found == read_experiment(model | changes, place="test")
    experiments.write_file(tmp_path / "third.toml", {"like": "other.toml", "name": "third"})
    with pytest.raises(TrainingError, match=r"third.toml', like: other.toml is itself like model.toml"):
        load_experiment(tmp_path / "third.toml")
    experiments.write_file(tmp_path / "fourth.toml", {"like": 4, "name": "fourth"})
    with pytest.raises(TrainingError, match="name one experiment, not 4"):
        load_experiment(tmp_path / "fourth.toml")


def test_table2_compares_all_methods() -> None:
    own = {name for name, kind in METHODS.working().items() if kind.__module__.startswith("tcmrl_algo.")}
    assert {method.algorithm for method in load_experiment("table2").methods.values()} == own


def test_a_method_is_run_in_the_environments_that_it_names(tiny_folder: Path, tmp_path: Path) -> None:
    content = experiments.tables(tiny_folder, seeds=[0])
    content["environments"]["half-cheetah-vel"] = {}
    content["methods"]["no context"]["environments"] = ["half-cheetah-vel"]
    made = read_experiment(content, place="test")
    jobs = plan_runs(made, data=tiny_folder, out=tmp_path, environments=["point-robot"])
    assert [job.method for job in jobs] == ["TCMRL"]
    content["methods"]["no context"]["environments"] = ["hopper"]
    with pytest.raises(TrainingError, match="'no context' names no environment 'hopper'"):
        read_experiment(content, place="test")
