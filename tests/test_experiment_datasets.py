"""Datasets of an experiment: missing ones, other profiles, and folds of the tasks."""

import functools
import json
from pathlib import Path
from typing import Any

import pytest
from tcmrl_cli.train import tcmrl

import tcmrl_data
from tcmrl_algo import load_experiment, run_experiment, write_report
from tcmrl_algo.experiment import datasets
from tcmrl_algo.experiment.datasets import missing_datasets
from tcmrl_algo.experiment.plan import plan_runs
from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.experiment.spec import Experiment, read_experiment
from tcmrl_data import SelectionError, TrainingError
from tcmrl_data.foundation.records import read_record
from tests import experiments
from tests.commands import Call, assert_refused
from tests.conftest import TINY

PROGRAM = tcmrl

pytestmark = pytest.mark.usefixtures("in_process")


def _small(dataset: Path, **changes: Any) -> Experiment:
    return read_experiment(experiments.tables(dataset, **changes), place="test")


def test_missing_datasets_are_all_named_with_their_commands(tmp_path: Path, call: Call) -> None:
    data = tmp_path / "data"
    missing = missing_datasets(load_experiment("table2"), data)
    assert [(found.environment, found.profile) for found in missing] == [
        ("point-robot", "paper"),
        ("point-robot-wind", "paper"),
        ("sparse-point-robot", "paper"),
        ("half-cheetah-vel", "reduced"),
    ]
    commands = [f"`{found.command}`" for found in missing]
    assert (
        commands[3] == f"`tcmrl-data build half-cheetah-vel --profile reduced --out {data}/half-cheetah-vel`"
    )
    assert_refused(call("experiment", "table2", "--data", data), *commands, "--build")
    assert not (tmp_path / "results").exists()


def test_another_profile_changes_data_training_and_steps(tmp_path: Path) -> None:
    paper = load_experiment("negative_rewards").at_profile("paper")
    assert {missing.profile for missing in missing_datasets(paper, tmp_path)} == {"paper"}
    assert paper.environments["half-cheetah-vel"].profile == "paper"
    assert "steps" not in paper.training["run"]  # the profile's steps, not those of the file
    weights = load_experiment("negative_rewards").training["tcmrl"]["weights"]
    assert paper.training["tcmrl"]["weights"] == weights


def test_a_dataset_of_another_profile_is_used_only_if_it_is_named_itself(
    tiny_folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "point-robot").symlink_to(tiny_folder, target_is_directory=True)
    content = experiments.tables(tiny_folder)
    content["environments"] = {"point-robot": {"profile": "quick", "dataset_profile": "reduced"}}
    experiment = read_experiment(content, place="test")
    with pytest.raises(SelectionError, match=r"profile 'quick', the experiment needs 'reduced'.*--data"):
        plan_runs(experiment, data=tmp_path, out=tmp_path)
    assert len(plan_runs(experiment, data=tiny_folder, out=tiny_folder)) == 4


def test_a_folder_that_is_given_goes_before_what_the_file_names(tiny_folder: Path, tmp_path: Path) -> None:
    experiment = _small(tiny_folder)
    assert len(plan_runs(experiment, data=None, out=tmp_path)) == 4
    with pytest.raises(SelectionError, match=f"no dataset at {tmp_path / 'point-robot'}"):
        plan_runs(experiment, data=tmp_path, out=tmp_path)


def test_only_chosen_environments_are_run(tiny_folder: Path, call: Call) -> None:
    content = experiments.tables(tiny_folder)
    content["environments"]["half-cheetah-vel"] = {"dataset": "nowhere"}
    experiment = read_experiment(content, place="test")
    runs = plan_runs(experiment, data=None, out=tiny_folder, environments=["point-robot"])
    assert {run.environment for run in runs} == {"point-robot"}
    with pytest.raises(TrainingError, match=r"'point-robt'.*'half-cheetah-vel'"):
        plan_runs(experiment, data=None, out=tiny_folder, environments=["point-robt"])


def test_folds_test_every_task_once_with_every_seed(tiny_folder: Path, tmp_path: Path) -> None:
    experiment = _small(tiny_folder, folds=2, seeds=[3])
    runs = plan_runs(experiment, data=None, out=tmp_path)
    assert [(run.method, run.seed, run.fold) for run in runs] == [
        ("TCMRL", 3, 0),
        ("no context", 3, 0),
        ("TCMRL", 3, 1),
        ("no context", 3, 1),
    ]
    assert len({run.id for run in runs}) == 4
    assert runs[0].identity != runs[2].identity  # folds share the root of their source
    tested = [
        {task.index for task in tcmrl_data.open_dataset(run.dataset).test_tasks} for run in (runs[0], runs[2])
    ]
    assert not tested[0] & tested[1]
    assert tested[0] | tested[1] == {task.index for task in tcmrl_data.open_dataset(tiny_folder).tasks}
    again = plan_runs(experiment, data=None, out=tmp_path)
    assert [run.identity for run in again] == [run.identity for run in runs]
    with pytest.raises(SelectionError, match="5 tasks do not make 6 folds"):
        plan_runs(_small(tiny_folder, folds=6), data=None, out=tmp_path)


@pytest.mark.check
def test_an_experiment_with_folds_is_run_continued_and_reported(tiny_folder: Path, tmp_path: Path) -> None:
    methods = {"A": {"algorithm": "no_context"}}
    claim = {"text": "", "better": "A", "worse": "A", "against": "shuffled", "protocols": ["offline"]}
    experiment = _small(tiny_folder, folds=2, seeds=[0, 1], methods=methods, claims=[claim])
    out = tmp_path / "out"
    report = run_experiment(experiment, out, workers=2)
    assert (report.failed, len(report.results)) == ((), 4)
    assert run_experiment(experiment, out).present == 4
    result = read_record(RunResult, out / "runs/point-robot--a--seed1--fold1.json")
    assert (result.seed, result.fold) == (1, 1)
    written = write_report([out], tmp_path / "report")
    (verdict,) = written.verdicts
    assert verdict.pairs == ((0, 0), (0, 1), (1, 0), (1, 1))
    assert verdict.covers == "2 seeds × 2 folds, 5 test tasks"
    assert "2 seeds × 2 folds, 5 test tasks" in written.report.read_text()


@pytest.mark.check
def test_build_makes_what_is_missing_and_then_runs(
    tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the recipe of the profile, but for fewer steps and episodes."""
    monkeypatch.setattr(datasets, "load_recipe", functools.partial(tcmrl_data.load_recipe, overrides=TINY))
    content = experiments.tables(tmp_path / "data", seeds=[0], claims=[])
    content["methods"] = {"A": {"algorithm": "no_context"}}
    file = experiments.write_file(tmp_path / "small.toml", content)
    code, output, _ = call("experiment", file, "--out", tmp_path / "out", "--build", "--json", "--quiet")
    assert (code, json.loads(output)["ran"]) == (0, 1)
    assert tcmrl_data.open_dataset(tmp_path / "data").manifest.profile == "quick"


def test_data_may_be_a_view_file(tiny_folder: Path, tmp_path: Path) -> None:
    view = tmp_path / "half.json"
    tcmrl_data.derive_dataset(tiny_folder, view=view, snapshots="last")
    experiment = _small(tiny_folder, environments={"point-robot": {"profile": "quick"}})
    planned = plan_runs(experiment, data=view, out=tmp_path)
    assert {run.dataset for run in planned} == {str(view)}
    assert {run.root for run in planned} == {tcmrl_data.open_dataset(view).manifest.root}
    (missing,) = missing_datasets(experiment, tmp_path / "none.json")
    assert missing.folder == tmp_path / "none.json" / "point-robot"
