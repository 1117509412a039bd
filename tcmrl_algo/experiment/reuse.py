"""Takes over trainings of other results folders: experiments with a method in common train it once."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tcmrl_algo.algorithms.core.settings import EVALUATION_KEYS, LOGGING_KEYS
from tcmrl_algo.experiment.config import experiment_of, run_id
from tcmrl_algo.experiment.job import Curve, Job, SharedTraining
from tcmrl_algo.experiment.planning import completed
from tcmrl_algo.experiment.results import RunResult, read_results
from tcmrl_algo.training.checkpoint import open_run, write_run
from tcmrl_data.foundation.records import write_record

Trained = Sequence[tuple[RunResult, Path]]
"""Finished runs, each with its folder."""


def finished_trainings(folders: Iterable[str | Path]) -> Trained:
    """The finished runs in results folders that still have their tensors.

    Raises:
        CheckpointError: no experiment was run in one of the folders.
    """
    found = []
    for folder in map(Path, folders):
        experiment = experiment_of(folder)
        for result in read_results(folder, experiment):
            run = folder / "runs" / run_id(result.environment, result.method, result.seed, result.fold)
            if result.identity and (run / "run.json").is_file():
                found.append((result.model_copy(update={"identity": completed(result.identity)}), run))
    return found


def take_over(job: Job, trained: Trained) -> Job:
    """The job with the tensors of an equal training in its folder; the job itself where there is none.

    Trainings are equal if dataset root, test tasks, seed, steps, device and all settings are, but for those
    that only evaluation or logging read; settings that are newer than a training have their defaults there.
    The code is taken to be the same. A learning curve is taken over
    only from a run with points at the same steps, evaluated in the same way.
    """
    folder = Path(job.folder)
    if (folder / "run.json").is_file():
        return job
    for result, source in trained:
        if _training_of(result.identity) != _training_of(job.identity) or result.device != job.device:
            continue
        evaluated_alike = _evaluation_of(result.identity) == _evaluation_of(job.identity)
        points = {point.step: point for point in result.curve}
        *steps, last = job.points()
        is_curve_alike = evaluated_alike and job.protocols[:1] == tuple(result.evaluations)[:1]
        run = open_run(source)
        if (steps and not (is_curve_alike and points.keys() >= set(steps))) or run.newest().step != last:
            continue
        run_settings = job.config.settings.run.model_copy(update={"threads": result.threads})
        settings = job.config.settings.model_copy(update={"run": run_settings})
        config = job.config.model_copy(update={"settings": settings})
        write_record(folder / "curve.json", Curve(points=tuple(points[step] for step in steps)))
        copied = write_run(folder, run.record.model_copy(update={"config": config, "dataset": job.dataset}))
        copied.save(last, run.newest().tensors())
        shared = SharedTraining(
            training_of=f"{result.experiment}, {result.method}",
            training_seconds=result.training_seconds,
            peak_memory=result.peak_memory,
            evaluations=result.evaluations if evaluated_alike else {},
        )
        return job.model_copy(update={"config": config, "shared": shared})
    return job


def _training_of(identity: dict[str, Any]) -> dict[str, Any]:
    """What the tensors of a run are a function of."""
    tables = identity["training"]
    run = {key: value for key, value in tables["run"].items() if key not in EVALUATION_KEYS | LOGGING_KEYS}
    shared = {key: identity[key] for key in ("root", "test_tasks", "seed")}
    return shared | {"training": tables | {"run": run}}


def _evaluation_of(identity: dict[str, Any]) -> dict[str, Any]:
    """What an evaluation is a function of, beside tensors and protocol."""
    run = identity["training"]["run"]
    return {key: run[key] for key in EVALUATION_KEYS - {"protocol"}}
