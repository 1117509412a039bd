"""A small experiment on the tiny dataset, for the tests of experiments and of reports."""

from functools import cache
from pathlib import Path
from typing import Any

import tomlkit

from tcmrl_algo import TrainingConfig, resolve, run_experiment, write_report
from tcmrl_algo.experiment.results import CurvePoint, RunResult
from tcmrl_algo.experiment.spec import read_experiment, run_id
from tcmrl_algo.report.write import Page, compose, measure_paths
from tcmrl_data import load_recipe
from tcmrl_data.engine.local import InProcessEngine
from tcmrl_data.foundation.records import write_record

SMALL = {
    "run": {"steps": 40, "log_every": 10, "checkpoint_every": 10, "episodes": 2, "random_episodes": 1},
    "batch": {"transitions": 8},
    "actor_critic": {"hidden": [8]},
    "tcmrl": {"latent": 4, "encoder_hidden": [8], "tce_hidden": [8], "estimator_hidden": [8]},
}


def tables(dataset: Path, **changes: Any) -> dict[str, Any]:
    """The tables of an experiment file: two methods, two seeds, a curve of two points."""
    return {
        "schema": 1,
        "name": "small",
        "title": "TCMRL and its control",
        "source": "Figure 4",
        "seeds": [0, 1],
        "environments": {"point-robot": {"dataset": str(dataset), "profile": "quick"}},
        "methods": {
            "TCMRL": {"algorithm": "tcmrl"},
            "no context": {"algorithm": "no_context", "training": {"run": {"log_every": 20}}},
        },
        "training": SMALL,
        "protocols": ["offline", "paper"],
        "curve_points": 2,
        "claims": [
            {"text": "TCMRL ends higher", "better": "TCMRL", "worse": "no context"},
            {
                "text": "It attends to rewards",
                "better": "TCMRL",
                "worse": "TCMRL",
                "metric": "attention_nonzero",
                "against": "attention_zero",
            },
        ],
    } | changes


@cache
def _config() -> TrainingConfig:
    table = {str(name): table for name, table in load_recipe("point-robot").training.items()}["quick"]
    return resolve(table, place="test")


def made_result(
    method: str,
    seed: int = 0,
    final: float = 0.0,
    *,
    fold: int | None = None,
    protocols: tuple[str, ...] = ("offline",),
    **changes: Any,
) -> RunResult:
    """The result of a run that never was, with the same returns under all protocols."""
    task = {"task": fold or 0, "final": final, "oracle": 0.0, "random": -20.0, "returns": [final, final]}
    means = {"final": final, "regret": -final, "normalized": 1 + final / 20, "shuffled": final - 1.0}
    evaluation = {"tasks": [task]} | {f"mean_{name}": value for name, value in means.items()}
    fields: dict[str, Any] = {
        "experiment": "small",
        "method": method,
        "algorithm": "tcmrl",
        "privileged": False,
        "environment": "point-robot",
        "seed": seed,
        "fold": fold,
        "profile": "quick",
        "dataset": "/data/somewhere",
        "root": "0" * 64,
        "steps": 40,
        "device": "cpu",
        "threads": 1,
        "identity": {"root": "0" * 64, "seed": seed},
        "config": _config(),
        "versions": {"torch": "2"},
        "digest": "1" * 64,
        "curve": (),
        "evaluations": dict.fromkeys(protocols, evaluation),
        "training_seconds": 1.0 / 3.0,
        "evaluation_seconds": 2.0,
        "peak_memory": 10**8,
    }
    return RunResult(**(fields | changes))


def with_setting(result: RunResult, section: str, **values: Any) -> RunResult:
    """The result with other values in a section that all methods share."""
    settings = result.config.settings
    changed = getattr(settings, section).model_copy(update=values)
    config = result.config.model_copy(update={"settings": settings.model_copy(update={section: changed})})
    return result.model_copy(update={"config": config})


def write_results(folder: Path, content: dict[str, Any], results: list[RunResult]) -> Path:
    """A results folder of an experiment with such results."""
    experiment = read_experiment(content, place="test")
    (folder / "runs").mkdir(parents=True)
    write_record(folder / "experiment.json", experiment)
    for result in results:
        name = run_id(result.environment, result.method, result.seed, result.fold)
        write_record(folder / "runs" / f"{name}.json", result)
    return folder


def made_report(folder: Path) -> Page:
    """The report, with its figures, on an experiment of two methods and five seeds that never was."""
    content = tables(folder, seeds=[0, 1, 2, 3, 4], protocols=["offline"])
    finals = {"TCMRL": [1.0, 2.0, 3.0, 4.0, 5.0], "no context": [0.0, 0.5, 0.25, 0.0, 0.125]}
    shared: dict[str, Any] = {
        "stage": "train",
        "regret": None,
        "normalized": None,
        "shuffled": 0.0,
        "timed_steps": 20,
    }
    shared |= {"peak_memory": 10**8, "device_memory": 0}
    curve = [
        CurvePoint(step=step, final=step / 10, seconds=1.0, evaluation_seconds=1.0, **shared)
        for step in (20, 40)
    ]
    results = [
        made_result(method, seed, final, curve=curve)
        for method, values in finals.items()
        for seed, final in enumerate(values)
    ]
    made, out = write_results(folder / "made", content, results), folder / "report"
    write_report([made], out)
    return compose(measure_paths([made]), out)[0]


def run_small(dataset: Path, out: Path) -> None:
    """Runs the small experiment, whose folder is then as `tests/conftest.py` hands it out."""
    experiment = read_experiment(tables(dataset), place="test")
    events: list[tuple[Any, ...]] = []
    report = run_experiment(
        experiment, out, workers=2, engine=InProcessEngine(), report=lambda *event: events.append(event)
    )
    assert (report.present, report.failed, len(report.results)) == (0, (), 4)
    assert [event[1:3] for event in events] == [(done, 4) for done in (1, 2, 3, 4)]
    assert events[-1][3] == 0


def write_file(file: Path, content: dict[str, Any]) -> Path:
    """The tables as a TOML file."""
    file.write_text(tomlkit.dumps(content), encoding="utf-8")
    return file
