"""Tuning: search spaces, proposals, held-out training tasks, `tcmrl tune`; no test task is read."""

import itertools
import json
import shutil
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
from tcmrl_cli.train import tcmrl

import tcmrl_data
from tcmrl_algo import (
    METHODS,
    Factors,
    Options,
    TuningReport,
    open_run,
    read_tuning,
    resolve_for,
    tune_method,
)
from tcmrl_algo.experiment.spec import override_texts
from tcmrl_algo.experiment.tune import (
    GENERATION,
    RANDOM_TRIALS,
    checked_tasks,
    evenly_spaced,
    held_out_tasks,
    known_to,
    plan_tuning,
    propose,
)
from tcmrl_algo.experiment.tunings import Dimension, Trial, space_on
from tcmrl_data import Dataset, SelectionError, TrainingError
from tcmrl_data.engine.local import InProcessEngine
from tcmrl_data.foundation.errors import CheckpointError, MissingPackageError
from tcmrl_data.store.part import References
from tests.commands import Call, assert_refused
from tests.experiments import SMALL
from tests.graded import graded_dataset

PROGRAM = tcmrl

pytest.importorskip("optuna")

pytestmark = pytest.mark.usefixtures("in_process")

SETTINGS = tuple(
    f"{section}.{key}={json.dumps(value)}" for section, table in SMALL.items() for key, value in table.items()
)
SPACE = {
    "optimizer.learning_rate": Dimension(kind="factors", own=1e-3, low=0.1, high=10.0),
    "tcmrl.weights.distance": Dimension(kind="options", own=0.1, options=(0.0, 0.1, 1.0)),
}


def without_test_parts(folder: Path) -> Path:
    """Damages every part of the test tasks beyond reading."""
    dataset = tcmrl_data.open_dataset(folder)
    keys = [key for task in dataset.test_tasks for key in dataset.parts.keys_of(task.index)]
    assert len(keys) > 1
    for key in keys:
        dataset.file_of(key).write_bytes(b"nobody may read this")
    dataset.file_of(keys[0]).unlink()
    return folder


@pytest.fixture(scope="module")
def tuned(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TuningReport]:
    """A dataset whose test tasks cannot be read, and a tuning of two trials on it."""
    folder = tmp_path_factory.mktemp("tuned")
    shutil.copytree(tiny_folder, folder / "data")
    dataset = tcmrl_data.open_dataset(without_test_parts(folder / "data"))
    events: list[tuple[Any, ...]] = []
    report = tune_method(
        dataset,
        folder / "tuning",
        algorithm="tcmrl",
        trials=2,
        protocols=("offline", "paper"),
        overrides=SETTINGS,
        workers=2,
        engine=InProcessEngine(),
        report=lambda *event: events.append(event),
    )
    assert [event[1:3] for event in events] == [(1, 2), (2, 2)]
    return folder / "data", report


def arguments(data: Path, out: Path, *, trials: int) -> list[object]:
    """The command that `tuned` stands for."""
    options = [text for setting in SETTINGS for text in ("--set", setting)]
    protocols = ["--protocol", "offline", "--protocol", "paper"]
    return ["tune", data, "--algo", "tcmrl", "--trials", trials, "--out", out, *options, *protocols]


def test_test_tasks_are_neither_trained_on_nor_scored_on_nor_read(tuned: tuple[Path, TuningReport]) -> None:
    data, report = tuned
    dataset = tcmrl_data.open_dataset(data)
    with pytest.raises(tcmrl_data.TcmrlError):
        dataset.select(split="test").trajectories(dataset.test_tasks[0].index)
    tuning = report.tuning
    training = {task.index for task in dataset.train_tasks}
    assert (report.failed, report.present) == ((), 0)
    assert set(tuning.training_tasks) | set(tuning.held_out) == training
    assert not set(tuning.training_tasks) & set(tuning.held_out)
    run = open_run(report.out / "runs" / "point-robot--trial-0000--seed0")
    seen = run.open_dataset()
    assert {task.index for task in seen.train_tasks} == set(tuning.training_tasks)
    assert {task.index for task in seen.test_tasks} == set(tuning.held_out)
    result = json.loads((report.out / "runs" / "point-robot--trial-0000--seed0.json").read_text())
    for protocol in ("offline", "paper"):
        assert [row["task"] for row in result["evaluations"][protocol]["tasks"]] == list(tuning.held_out)


def test_a_score_is_the_mean_over_protocols_and_the_best_trial_has_the_highest(
    tuned: tuple[Path, TuningReport],
) -> None:
    _, report = tuned
    tuning = read_tuning(report.out)
    assert tuning == report.tuning
    assert len(tuning.trials) == 2
    for trial in tuning.trials:
        (run,) = trial.runs
        result = json.loads(
            (report.out / "runs" / f"point-robot--trial-{trial.number:04d}--seed0.json").read_text()
        )
        means = {name: found["mean_normalized"] for name, found in result["evaluations"].items()}
        assert run.normalized == means
        assert list(means) == ["offline", "paper"]
        assert trial.score == pytest.approx(fmean(means.values()))
        table = result["config"]["settings"] | {"tcmrl": result["config"]["method"]}
        for key, value in trial.values.items():
            found = table
            for part in key.split("."):
                found = found[part]
            assert found == value
    scores = [trial.score for trial in tuning.trials if trial.score is not None]
    assert tuning.best == scores.index(max(scores))
    first, second = tuning.trials
    assert first.values["tcmrl.weights.distance"] == 0.1  # the table as it is
    assert first.values != second.values
    assert {"optuna", "torch", "tcmrl"} <= set(tuning.versions)


def test_the_same_command_does_nothing_again_and_prints_settings_that_train_takes(
    tuned: tuple[Path, TuningReport], call: Call
) -> None:
    data, report = tuned
    before = (report.out / "tuning.json").read_bytes()
    code, output, errors = call(*arguments(data, report.out, trials=2), "--quiet")
    assert (code, errors) == (0, "")
    assert "0 trials done, 2 already present" in output
    assert (report.out / "tuning.json").read_bytes() == before
    best = report.tuning.best_trial
    assert best is not None
    last = output.splitlines()[-1]
    assert last.startswith(f"tcmrl train {data} --algo tcmrl --profile quick --set")
    assert all(f"{text.split('=')[0]}=" in last for text in best.overrides)
    config = resolve_for(
        tcmrl_data.open_dataset(data),
        profile="quick",
        algorithm="tcmrl",
        overrides=[*SETTINGS, *best.overrides],
    )
    assert config.settings.optimizer.learning_rate == best.values["optimizer.learning_rate"]
    code, output, _ = call(*arguments(data, report.out, trials=2), "--json")
    document = json.loads(output)
    assert (code, document["best"], document["failed"]) == (0, report.tuning.best, [])


def test_other_settings_are_refused(tuned: tuple[Path, TuningReport], call: Call) -> None:
    data, report = tuned
    command = arguments(data, report.out, trials=2)
    assert_refused(call(*command, "--steps", 80), "run.steps 40", "80")
    assert_refused(call(*command, "--seeds", "0,1"), "seeds", "[0]", "[0, 1]")
    assert_refused(call(*command, "--held-out", "0"), "held_out")
    assert_refused(call(*command, "--held-out", "3"), "task 3 cannot be held out", "no training task")
    assert_refused(call(*command, "--protocol", "papr"), "papr", "paper")
    assert_refused(call(*command, "--set", "tcmrl.weights.distanc=1"), "distanc")


@pytest.mark.check
def test_an_interrupted_tuning_goes_on_and_ends_as_an_uninterrupted_one(
    tuned: tuple[Path, TuningReport], tmp_path: Path, call: Call
) -> None:
    """Trial 1 is put back to its first checkpoint, as if the machine had gone down."""
    data, report = tuned
    out = report.out.with_name("copy")  # beside it: the view names the dataset by a relative path
    shutil.copytree(report.out, out)
    first, second = report.tuning.trials
    waiting = second.model_copy(update={"runs": (), "score": None})
    record = report.tuning.with_trials([waiting])
    (out / "tuning.json").write_text(record.model_dump_json())
    (out / "runs" / "point-robot--trial-0001--seed0.json").unlink()
    shutil.rmtree(out / "runs" / "point-robot--trial-0001--seed0" / "checkpoints" / "step_000000040")
    code, output, _ = call(*arguments(data, out, trials=2), "--quiet")
    assert code == 0
    assert "1 trials done, 1 already present" in output
    assert read_tuning(out).trials == (first, second)


@pytest.mark.check
def test_a_trial_that_diverges_has_no_score_and_is_not_repeated(
    tuned: tuple[Path, TuningReport], tmp_path: Path
) -> None:
    dataset = tcmrl_data.open_dataset(tuned[0])

    def again() -> TuningReport:
        return tune_method(
            dataset,
            tmp_path / "tuning",
            algorithm="no_context",
            trials=1,
            overrides=(*SETTINGS, "optimizer.learning_rate=1e30"),
        )

    report = again()
    (trial,) = report.tuning.trials
    assert (trial.score, trial.runs, report.failed, report.tuning.best) == (None, (), (), None)
    assert trial.error is not None and "at step" in trial.error
    assert again().present == 1


def trials(*scores: float | None, space: dict[str, Dimension] = SPACE) -> list[Trial]:
    """Ended trials whose draws are spread over the space."""
    found = []
    for number, score in enumerate(scores):
        drawn = propose(space, [], number=number, seed=3, environment="made-up")
        error = "diverged" if score is None else None
        found.append(Trial(number=number, drawn=drawn, values=drawn, score=score, error=error))
    return found


def draws(known: list[Trial], numbers: range, *, seed: int = 0) -> list[dict[str, Any]]:
    return [propose(SPACE, known, number=number, seed=seed, environment="made-up") for number in numbers]


def test_the_first_trial_is_the_table_and_the_others_lie_in_the_space() -> None:
    first, *others = draws([], range(12))
    assert {key: dimension.value(first[key]) for key, dimension in SPACE.items()} == {
        "optimizer.learning_rate": 1e-3,
        "tcmrl.weights.distance": 0.1,
    }
    assert all(0.1 <= drawn["optimizer.learning_rate"] <= 10 for drawn in others)
    assert {drawn["tcmrl.weights.distance"] for drawn in others} == {0.0, 0.1, 1.0}
    assert len({drawn["optimizer.learning_rate"] for drawn in others}) == 11


def test_proposals_are_a_function_of_seed_number_and_earlier_generations() -> None:
    known = trials(*range(GENERATION))
    assert draws(known, range(4, 8)) == draws(known, range(4, 8))
    assert draws(known, range(4, 8)) != draws(known, range(4, 8), seed=1)
    running = Trial(number=6, drawn={}, values={})
    ended = Trial(number=5, drawn={}, values={}, score=1.0)
    assert known_to(7, [*known, ended, running]) == known
    assert known_to(3, known) == []
    assert known_to(8, [*known, ended, running]) == [*known, ended]


@pytest.mark.parametrize("bad", [None, -1.0])
def test_proposals_follow_the_scores_and_shun_what_diverged(bad: float | None) -> None:
    spread = [trial.drawn for trial in trials(*[0.0] * 40)]
    assert len(spread) > RANDOM_TRIALS
    known = [
        Trial(
            number=number,
            drawn=drawn,
            values=drawn,
            score=1.0 if drawn["tcmrl.weights.distance"] == 1.0 else bad,
            error="diverged" if bad is None and drawn["tcmrl.weights.distance"] != 1.0 else None,
        )
        for number, drawn in enumerate(spread)
    ]
    chosen = [drawn["tcmrl.weights.distance"] for drawn in draws(known, range(40, 60))]
    assert chosen.count(1.0) >= 15


def test_without_optuna_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'tcmrl\[tune\]'"):
        propose(SPACE, [], number=1, seed=0, environment="made-up")


def test_a_space_lies_around_the_tables_values(tiny: Dataset) -> None:
    config = resolve_for(
        tiny,
        profile="quick",
        algorithm="tcmrl",
        overrides=["tcmrl.weights.negative=0.3", "optimizer.learning_rate=1e-3"],
    )
    space = space_on(
        config,
        {
            "tcmrl.weights.negative": Options((0.0, 1.0)),
            "tcmrl.weights.distance": Options((0.1, 1.0)),
            "optimizer.learning_rate": Factors(0.5, 2.0),
            "tcmrl.weights.orthogonality": Factors(0.5, 2.0),  # 0 there, and times anything
        },
    )
    assert list(space) == ["tcmrl.weights.negative", "tcmrl.weights.distance", "optimizer.learning_rate"]
    assert space["tcmrl.weights.negative"].options == (0.3, 0.0, 1.0)
    assert space["tcmrl.weights.distance"].options == (0.1, 1.0)
    rate = space["optimizer.learning_rate"]
    assert (rate.own, rate.value(1.0), rate.value(1.23456)) == (1e-3, 1e-3, 0.00123)
    assert list(override_texts({"a.b": 0.5, "c": "x"})) == ["a.b=0.5", 'c="x"']
    for key, what, problem in [
        ("tcmrl.wieghts.negative", Factors(0.5, 2.0), "no setting"),
        ("tcmrl.weights", Options((1.0,)), "no setting"),
        ("tcmrl.extractor", Factors(0.5, 2.0), "no positive number"),
    ]:
        with pytest.raises(TrainingError, match=problem):
            space_on(config, {key: what})


def test_what_is_set_is_not_searched(tiny: Dataset, tmp_path: Path) -> None:
    def space(algorithm: str, *overrides: str) -> list[str]:
        plan = plan_tuning(
            tiny,
            algorithm=algorithm,
            profile="quick",
            steps=None,
            seeds=[0],
            seed=0,
            held_out=None,
            protocols=["offline"],
            overrides=overrides,
        )
        return list(plan.space)

    own = ["csro.penalty", "csro.distance_weight"]
    rate, entropy = "optimizer.learning_rate", "actor_critic.entropy"
    assert space("csro") == [rate, entropy, *own]
    assert space("csro", f"{rate}=2e-3", f"{entropy} = 0.3") == own
    assert space("csro", "csro.epsilon=0.2", "csro.penalty=2.0") == [rate, entropy, "csro.distance_weight"]
    assert space("tcmrl", "tcmrl.weights={distance=0.2}") == [rate, entropy]
    for kind in ("iql", "bc"):  # neither reads the entropy
        assert space("csro", f"actor_critic.kind={kind}") == [rate, *own]
    both = (f"{rate}=2e-3", f"{entropy}=0.3")
    with pytest.raises(TrainingError, match="nothing is left to search of no_context"):
        tune_method(tiny, tmp_path / "out", algorithm="no_context", trials=1, overrides=both)


@pytest.mark.parametrize("profile", ["quick", "paper"])
@pytest.mark.parametrize("name", METHODS.names())
def test_every_end_of_every_methods_space_validates(name: str, profile: Any, tiny: Dataset) -> None:
    config = resolve_for(tiny, profile=profile, algorithm=name)
    space = space_on(config, METHODS.get(name).search)
    assert space
    for key, dimension in space.items():
        ends = dimension.options if dimension.kind == "options" else (dimension.low, dimension.high)
        for drawn in ends:
            assert drawn is not None
            texts = list(override_texts({key: dimension.value(drawn)}))
            changed = resolve_for(tiny, profile=profile, algorithm=name, overrides=texts)
            assert (changed == config) is (dimension.value(drawn) == dimension.own)


@pytest.mark.parametrize(("length", "number"), [(80, 16), (16, 3), (4, 1), (7, 2)])
def test_held_out_tasks_are_evenly_spaced(length: int, number: int) -> None:
    places = evenly_spaced(range(length), number)
    gaps = [second - first for first, second in itertools.pairwise(places)]
    assert len(set(places)) == number
    assert max(gaps, default=0) - min(gaps, default=0) <= 1
    assert abs(fmean(places) - (length - 1) / 2) <= 0.5


def test_held_out_velocities_are_those_of_the_other_training_tasks() -> None:
    environment = tcmrl_data.load_recipe("half-cheetah-vel").make_environment()
    training = [task for task in tcmrl_data.draw_tasks(environment) if task.split == "train"]
    ordered = [task.index for task in tcmrl_data.in_order(environment, training)]
    held_out = evenly_spaced(ordered, len(ordered) // 5)
    velocities = {task.index: environment.ordering(task.parameters) or 0.0 for task in training}
    others = fmean(velocities[index] for index in ordered if index not in held_out)
    assert fmean(velocities[index] for index in held_out) == pytest.approx(others, abs=0.1)


def test_a_fifth_of_the_training_tasks_is_held_out_and_no_test_task(tmp_path: Path) -> None:
    dataset = graded_dataset(tmp_path / "data", tasks=range(14), scores={0: 0.0})
    held_out = held_out_tasks(dataset)
    assert len(held_out) == len(dataset.train_tasks) // 5 > 1
    assert set(held_out) < {task.index for task in dataset.train_tasks}


def test_impossible_held_out_tasks_are_refused(tmp_path: Path) -> None:
    dataset = graded_dataset(tmp_path / "data", tasks=[0, 1, 2, 3], scores={0: 0.0})
    assert checked_tasks(dataset, [2, 2]) == (2,)
    for tasks, problem in [([3], "no training task"), ([0, 1], "leave two or more"), ([], "hold out one")]:
        with pytest.raises(SelectionError, match=problem):
            checked_tasks(dataset, tasks)
    few = graded_dataset(tmp_path / "few", tasks=[0, 1, 3], scores={0: 0.0})
    with pytest.raises(SelectionError, match="2 training tasks, tuning needs 3"):
        held_out_tasks(few)


def test_tasks_without_uniform_returns_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    references = References(uniform=None, oracle=1.0, scripted=None)
    dataset = graded_dataset(tmp_path / "data", scores={0: 0.0}, references=references)
    with pytest.raises(TrainingError, match="no return of uniform actions is known of task"):
        tune_method(dataset, tmp_path / "out", algorithm="focal", trials=1)
    assert not (tmp_path / "out").exists()
    with pytest.raises(CheckpointError):
        read_tuning(tmp_path / "out")
