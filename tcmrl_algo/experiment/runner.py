"""Runs an experiment: plans all runs, skips finished ones, resumes killed ones, and writes one table."""

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_algo.experiment.config import Experiment, run_id
from tcmrl_algo.experiment.job import Job
from tcmrl_algo.experiment.planning import PlannedRun, TunedSettings, check_same, plan_runs
from tcmrl_algo.experiment.results import RunResult, error_file, read_results, result_file, table_text
from tcmrl_algo.experiment.reuse import finished_trainings, take_over
from tcmrl_algo.training.config import TrainingConfig
from tcmrl_algo.training.train import usable_device
from tcmrl_data import TrainingError
from tcmrl_data.engine.base import BaseEngine, Unit, make_engine
from tcmrl_data.foundation.disk import lock_file, make_folders, replace_file
from tcmrl_data.foundation.records import read_record, write_record

WORKER = "tcmrl_algo.experiment.job"


@dataclass(frozen=True)
class EndedRun:
    """A run that ended in this call.

    Attributes:
        id: of the run.
        result: what it left; None where it failed.
        error: why, where it failed.
        done, total: runs ended by now, and all runs of the experiment.
        seconds_left: until all are, if the rest goes at the pace so far; None until every worker ended a run.
    """

    id: str
    result: RunResult | None
    error: str | None
    done: int
    total: int
    seconds_left: float | None


@dataclass(frozen=True)
class ExperimentReport:
    """How a call of `run_experiment` ended.

    Attributes:
        out: the results folder.
        results: of all runs that are finished, in the order of the plan.
        present: how many of them were finished before.
        failed: `run: reason` of those that ended in an error.
        seconds: wall-clock time of this call.
    """

    out: Path
    results: tuple[RunResult, ...]
    present: int
    failed: tuple[str, ...]
    seconds: float


def ignore(event: EndedRun) -> None:
    """Reports nothing."""


def run_experiment(
    experiment: Experiment,
    out: str | Path,
    *,
    data: str | Path = "data",
    only: Sequence[str] = (),
    environments: Sequence[str] = (),
    seeds: Sequence[int] | None = None,
    steps: int | None = None,
    workers: int | None = None,
    device: str = "cpu",
    engine: str | BaseEngine = "local",
    tuned: TunedSettings | None = None,
    reuse: Sequence[str | Path] = (),
    report: Callable[[EndedRun], None] = ignore,
) -> ExperimentReport:
    """Runs an experiment, without the runs that are finished; checks all of it before the first run starts.

    Args:
        experiment: what to run.
        out: the results folder; a second call goes on in it.
        data: folder of datasets, one per environment; or one dataset.
        only: labels of methods; all where empty.
        environments: names of environments; all where empty.
        seeds: instead of the experiment's.
        steps: training steps instead of `run.steps`.
        workers: runs at a time, one per core where None. Each gets its share of the cores as threads,
            whether or not there are so many runs; a run that was begun keeps the threads that it had, on
            which its last bits depend.
        device: a torch device, for runs that are not begun yet.
        engine: what runs them, by name or made before; `workers` says how the cores are shared either way.
        tuned: settings by environment and algorithm, as `tuned_settings` reads them.
        reuse: other results folders, whose finished trainings are taken over where they are the same, so
            that only what was not evaluated there is done.
        report: called as runs end.

    Raises:
        TcmrlError: the plan does not hold, or the folder has runs of other settings or data.

    Example:
        >>> experiment = load_experiment("perspectives")  # doctest: +SKIP
        >>> run_experiment(experiment, "results/perspectives", workers=2).results  # doctest: +SKIP
    """
    began, out, cores = time.perf_counter(), Path(out), len(os.sched_getaffinity(0))
    usable_device(device)
    every = plan_runs(
        experiment,
        data=Path(data),
        views=out / "folds",
        environments=environments,
        seeds=seeds,
        steps=steps,
        tuned=tuned,
    )
    before = _finished(every, out, experiment)
    plan = _chosen(every, experiment, only)
    workers = workers or cores
    threads = max(1, cores // workers)
    found = {run.id: before.get(run.id) for run in plan}
    jobs = {
        run.id: _job(run, experiment, out, threads=threads, device=device)
        for run in plan
        if found[run.id] is None
    }
    make_folders(out)
    trained = finished_trainings(reuse)
    failed: list[str] = []
    with lock_file(out / ".lock", f"experiment {out}"):
        write_record(out / "experiment.json", experiment)
        jobs = {name: take_over(job, trained) for name, job in jobs.items()}
        for job in jobs.values():
            write_record(Path(job.folder) / "job.json", job)
            error_file(Path(job.folder)).unlink(missing_ok=True)
        present = len(plan) - len(jobs)
        _write_table(out, experiment)
        for name, error in _run(jobs, make_engine(engine, workers)):
            folder = out / "runs" / name
            result = None if error else read_record(RunResult, result_file(folder))
            found[name] = result
            if error:
                failed.append(f"{name}: {error}")
                replace_file(error_file(folder), f"{error}\n".encode())
            _write_table(out, experiment)
            ended = sum(result is not None for result in found.values()) + len(failed)
            pace = (time.perf_counter() - began) / (ended - present)
            is_known = ended - present >= min(workers, len(jobs))
            left = pace * (len(plan) - ended) if is_known else None
            report(EndedRun(name, result, error, ended, len(plan), left))
    results = tuple(result for result in found.values() if result is not None)
    return ExperimentReport(out, results, present, tuple(failed), time.perf_counter() - began)


def _chosen(plan: Sequence[PlannedRun], experiment: Experiment, only: Sequence[str]) -> list[PlannedRun]:
    """The runs of the methods of these labels; all where there are none.

    Raises:
        TrainingError: no method has such a label.
    """
    unknown = [label for label in only if label not in experiment.methods]
    if unknown:
        known = ", ".join(map(repr, experiment.methods))
        raise TrainingError(f"--only {unknown[0]!r}: {experiment.name} has no such method; they are {known}")
    return [run for run in plan if not only or run.method in only]


def _finished(plan: Sequence[PlannedRun], out: Path, experiment: Experiment) -> dict[str, RunResult]:
    """Results that the folder holds, by run, of other seeds than the planned ones too.

    Raises:
        CheckpointError: one of them differs from the planned runs in more than its seed.
    """
    planned = {(run.environment, run.method, run.fold): run.identity() for run in plan}
    found = {}
    for result in read_results(out, experiment):
        name = run_id(result.environment, result.method, result.seed, result.fold)
        identity = planned.get((result.environment, result.method, result.fold), result.identity)
        check_same(result.identity, identity | {"seed": result.seed}, place=result_file(out / "runs" / name))
        found[name] = result
    return found


def _job(run: PlannedRun, experiment: Experiment, out: Path, *, threads: int, device: str) -> Job:
    """What a worker is told of a run; one that has begun training keeps its threads and device.

    Raises:
        CheckpointError: it was begun with other settings or data.
    """
    folder, shared = (out / "runs" / run.id).resolve(), None
    if (folder / "run.json").is_file() and (folder / "job.json").is_file():
        before = read_record(Job, folder / "job.json")
        check_same(before.identity, run.identity(), place=folder)
        threads, device, shared = before.config.settings.run.threads, before.device, before.shared
    settings = run.config.settings
    bounded = settings.model_copy(update={"run": settings.run.model_copy(update={"threads": threads})})
    return Job(
        experiment=experiment.name,
        method=run.method,
        environment=run.environment,
        seed=run.seed,
        fold=run.fold,
        profile=run.profile,
        dataset=str(run.dataset),
        root=run.root,
        folder=str(folder),
        identity=run.identity(),
        config=TrainingConfig(settings=bounded, method=run.config.method),
        device=device,
        protocols=experiment.protocols,
        curve_points=experiment.curve_points,
        tuned=run.tuned,
        shared=shared,
    )


def _run(jobs: dict[str, Job], engine: BaseEngine) -> Iterator[tuple[str, str | None]]:
    """Yields the id of every run as it ends, with its error or None; closing the iterator ends the others."""
    units = [
        Unit(
            name,
            job.model_dump(mode="json"),
            worker=WORKER,
            threads=job.config.settings.run.threads,
        )
        for name, job in jobs.items()
    ]
    with contextlib.closing(engine.run(units, lambda unit, message: None)) as results:
        for result in results:
            yield result.id, None if result.ok else result.error


def _write_table(out: Path, experiment: Experiment) -> None:
    rows = [row for result in read_results(out, experiment) for row in result.rows()]
    replace_file(out / "table.csv", table_text(rows).encode())
