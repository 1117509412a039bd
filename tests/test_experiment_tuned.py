"""Experiments with tuned settings, and with runs of earlier versions."""

import json
from pathlib import Path
from typing import Any

import pytest
from tcmrl_cli.train import tcmrl

from tcmrl_algo import add_tunings, run_experiment, tuned_settings
from tcmrl_algo.experiment.plan import plan_runs
from tcmrl_algo.experiment.results import Job
from tcmrl_algo.experiment.spec import Experiment, read_experiment
from tcmrl_algo.experiment.tunings import RECORD, Trial, Tuning
from tcmrl_data import CheckpointError, TrainingError
from tcmrl_data.foundation.records import write_record
from tests import experiments
from tests.commands import Call, assert_refused, in_process

METHODS = {"TCMRL": {"algorithm": "tcmrl"}}

pytestmark = pytest.mark.usefixtures("in_process")


def _experiment(dataset: Path, **changes: Any) -> Experiment:
    given = {"methods": METHODS, "seeds": [0], "protocols": ["offline"], "claims": []} | changes
    return read_experiment(experiments.tables(dataset, **given), place="test")


def test_a_run_from_before_a_setting_existed_has_its_default(tiny_folder: Path, tmp_path: Path) -> None:
    """Its record may say of a shared training too."""
    (before,) = run_experiment(_experiment(tiny_folder), tmp_path).results
    (file,) = tmp_path.glob("runs/*.json")
    document = json.loads(file.read_text()) | {"training_of": "another, TCMRL"}
    del document["identity"]["training"]["actor_critic"]["cloning"]
    file.write_text(json.dumps(document))
    again = run_experiment(_experiment(tiny_folder), tmp_path)
    assert (again.present, again.results[0].digest) == (1, before.digest)
    cloned = experiments.SMALL | {"actor_critic": {"hidden": [8], "cloning": 1.0}}
    with pytest.raises(CheckpointError, match=r"actor_critic\.cloning 0\.0, this experiment has 1\.0"):
        run_experiment(_experiment(tiny_folder, training=cloned), tmp_path)


def _tune(folder: Path, name: str, *, trials: int = 2, score: float | None = 0.5) -> None:
    algorithm = name.rsplit("-", 1)[1]
    values = {"optimizer.learning_rate": 0.002, "actor_critic.gamma": 0.7}
    ended = Trial(number=0, drawn={}, values={}, score=None if score is None else 0.1, error="diverged")
    best = Trial(number=1, drawn={}, values=values, score=score, error=None if score else "diverged")
    blank = Tuning(
        algorithm=algorithm,
        environment="point-robot",
        profile="quick",
        root="0" * 64,
        seed=0,
        seeds=(0,),
        steps=40,
        protocols=("offline",),
        training_tasks=(0,),
        held_out=(1,),
        space={},
        identity={},
        versions={},
    )
    more = [Trial(number=number, drawn={}, values={}, score=0.0) for number in range(2, trials)]
    (folder / name).mkdir(parents=True)
    write_record(folder / name / RECORD, blank.with_trials([ended, best, *more]))


def test_what_a_file_sets_goes_over_tuned_settings(tiny_folder: Path, tmp_path: Path) -> None:
    _tune(tmp_path, "point-robot-tcmrl")
    methods = {
        "tuned": {"algorithm": "tcmrl"},
        "own": {"algorithm": "tcmrl", "training": {"actor_critic": {"gamma": 0.5}}},
    }
    experiment = _experiment(tiny_folder, methods=methods)
    found = tuned_settings(experiment, tmp_path)
    plans = plan_runs(experiment, data=None, out=tmp_path, tuned=found)
    assert [_searched(plan) for plan in plans] == [(0.002, 0.7), (0.002, 0.5)]
    assert plans[0].tuned == plans[1].tuned == found["point-robot"]["tcmrl"]
    assert (found["point-robot"]["tcmrl"].trials, found["point-robot"]["tcmrl"].score) == (2, 0.5)
    place = {"dataset": str(tiny_folder), "training": {"optimizer": {"learning_rate": 0.1}}}
    experiment = _experiment(tiny_folder, methods=methods, environments={"point-robot": place})
    plans = plan_runs(experiment, data=None, out=tmp_path, tuned=found)
    assert [_searched(plan) for plan in plans] == [(0.1, 0.7), (0.1, 0.5)]


def test_a_table_of_tunings_gives_the_settings_of_their_folder(tiny_folder: Path, tmp_path: Path) -> None:
    for name, trials in (("point-robot-tcmrl", 3), ("point-robot-focal", 3), ("failed-tcmrl", 2)):
        _tune(tmp_path, name, trials=trials, **({"score": None} if name.startswith("failed") else {}))
    table = tmp_path / "tuning.csv"
    folders = sorted(path for path in tmp_path.iterdir() if path.is_dir())
    assert len(add_tunings(table, folders)) == 8
    assert len(add_tunings(table, folders[:1])) == 2  # in place of the same rows
    both = METHODS | {"FOCAL": {"algorithm": "focal"}}
    experiment = _experiment(tiny_folder, methods=both)
    assert tuned_settings(experiment, table) == tuned_settings(experiment, tmp_path)
    with pytest.raises(TrainingError, match=r"tuning.csv: point-robot-corro holds no .* --out tuning/point"):
        tuned_settings(_experiment(tiny_folder, methods={"CORRO": {"algorithm": "corro"}}), table)
    places = {"point-robot": {"dataset": str(tiny_folder), "profile": "quick", "tuning": "failed"}}
    with pytest.raises(TrainingError, match="no trial ended well"):
        tuned_settings(_experiment(tiny_folder, environments=places), table)


def _searched(plan: Job) -> tuple[float, float]:
    return plan.config.settings.optimizer.learning_rate, plan.config.settings.actor_critic.gamma


def test_an_environment_takes_the_tuning_that_it_names(tiny_folder: Path, tmp_path: Path) -> None:
    _tune(tmp_path, "elsewhere-tcmrl")
    places = {"point-robot": {"dataset": str(tiny_folder), "profile": "quick", "tuning": "elsewhere"}}
    found = tuned_settings(_experiment(tiny_folder, environments=places), tmp_path)
    assert found["point-robot"]["tcmrl"].overrides[0] == "optimizer.learning_rate=0.002"


def test_missing_unequal_and_failed_tunings_are_refused(
    tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = METHODS | {"FOCAL": {"algorithm": "focal"}}
    _tune(tmp_path, "point-robot-tcmrl")
    with pytest.raises(TrainingError, match=r"point-robot-focal holds no tuning; `tcmrl tune --algo focal"):
        tuned_settings(_experiment(tiny_folder, methods=both), tmp_path)
    assert list(tuned_settings(_experiment(tiny_folder, methods=both), tmp_path, only=["TCMRL"])) == [
        "point-robot"
    ]
    _tune(tmp_path, "point-robot-focal", trials=3)
    with pytest.raises(TrainingError, match=r"equal effort"):
        tuned_settings(_experiment(tiny_folder, methods=both), tmp_path)
    fixed = {"optimizer": {"learning_rate": 1e-3}, "actor_critic": {"entropy": 0.1}}
    control = {"algorithm": "no_context", "training": fixed}
    found = tuned_settings(_experiment(tiny_folder, methods=METHODS | {"no context": control}), tmp_path)
    assert list(found["point-robot"]) == ["tcmrl"]
    cloned = {"optimizer": fixed["optimizer"], "actor_critic": {"kind": "bc"}}
    control = control | {"training": cloned}
    found = tuned_settings(_experiment(tiny_folder, methods=METHODS | {"no context": control}), tmp_path)
    assert list(found["point-robot"]) == ["tcmrl"]
    control = control | {"training": {"optimizer": fixed["optimizer"]}}
    with pytest.raises(TrainingError, match="point-robot-no_context holds no tuning"):
        tuned_settings(_experiment(tiny_folder, methods=METHODS | {"no context": control}), tmp_path)
    _tune(tmp_path / "failed", "point-robot-tcmrl", score=None)
    with pytest.raises(TrainingError, match="no trial ended well"):
        tuned_settings(_experiment(tiny_folder), tmp_path / "failed")
    call: Call = in_process(tcmrl, capsys)
    assert_refused(call("experiment", "tour", "--tuned", tmp_path / "none"), "holds no tuning")
