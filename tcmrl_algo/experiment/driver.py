"""Runs an experiment: plans it whole, skips what is done, goes on with what was killed, keeps one table."""

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_algo.config import TrainingConfig
from tcmrl_algo.experiment.config import Experiment
from tcmrl_algo.experiment.job import Job, result_file
from tcmrl_algo.experiment.plan import PlannedRun, check_same, plan_runs
from tcmrl_algo.experiment.results import (
    RunResult,
    read_record,
    read_results,
    table_text,
    write_record,
    write_text,
)
from tcmrl_data import CheckpointError, Unit, plugin

WORKER = "tcmrl_algo.experiment.job"


@dataclass(frozen=True)
class Finished:
    """A run that ended in this call.

    Attributes:
        id: of the run.
        result: what it left; None where it failed.
        error: why, where it failed.
        done, total: runs ended by now, and all runs of the experiment.
        seconds_left: until all are, if the rest goes at the pace so far.
    """

    id: str
    result: RunResult | None
    error: str | None
    done: int
    total: int
    seconds_left: float


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


def ignore(event: Finished) -> None:
    """Reports nothing."""


def run_experiment(
    experiment: Experiment,
    out: str | Path,
    *,
    data: str | Path = "data",
    only: Sequence[str] = (),
    seeds: Sequence[int] | None = None,
    steps: int | None = None,
    workers: int | None = None,
    device: str = "cpu",
    report: Callable[[Finished], None] = ignore,
) -> ExperimentReport:
    """Runs an experiment, or what is missing of it; nothing starts before everything is checked.

    Args:
        experiment: what to run.
        out: the results folder; a second call goes on in it.
        data: folder of datasets, one per environment.
        only: labels of methods; all where empty.
        seeds: instead of the experiment's.
        steps: training steps instead of `run.steps`.
        workers: runs at a time, one per core where None. Each gets its share of the cores as threads,
            whether or not there are so many runs; a run that was begun keeps the threads that it had, on
            which its last bits depend.
        device: a torch device, for runs that are not begun yet.
        report: called as runs end.

    Raises:
        TcmrlError: the plan does not hold, or the folder has runs of other settings or data.

    Example:
        >>> experiment = load_experiment("figure5")  # doctest: +SKIP
        >>> run_experiment(experiment, "results/figure5", workers=2).results  # doctest: +SKIP
    """
    began, out, cores = time.perf_counter(), Path(out), len(os.sched_getaffinity(0))
    plan = plan_runs(experiment, data=Path(data), only=only, seeds=seeds, steps=steps)
    workers = workers or cores
    threads = max(1, cores // workers)
    found = {run.id: _finished(run, out) for run in plan}
    jobs = {
        run.id: _job(run, experiment, out, threads=threads, device=device)
        for run in plan
        if found[run.id] is None
    }
    out.mkdir(parents=True, exist_ok=True)
    failed: list[str] = []
    with _lock(out):
        write_text(out / "experiment.json", experiment.model_dump_json(indent=1, by_alias=True) + "\n")
        for job in jobs.values():
            Path(job.folder).mkdir(parents=True, exist_ok=True)
            write_record(Path(job.folder) / "job.json", job)
        present = len(plan) - len(jobs)
        _write_table(out, experiment)
        for run_id, error in _run(jobs, workers):
            result = None if error else read_record(RunResult, result_file(out / "runs" / run_id))
            found[run_id] = result
            if error:
                failed.append(f"{run_id}: {error}")
            _write_table(out, experiment)
            ended = sum(each is not None for each in found.values()) + len(failed)
            pace = (time.perf_counter() - began) / (ended - present)
            report(Finished(run_id, result, error, ended, len(plan), pace * (len(plan) - ended)))
    results = tuple(each for each in found.values() if each is not None)
    return ExperimentReport(out, results, present, tuple(failed), time.perf_counter() - began)


def _finished(run: PlannedRun, out: Path) -> RunResult | None:
    """The result of a run that is done.

    Raises:
        CheckpointError: it was done with other settings or data.
    """
    file = result_file(out / "runs" / run.id)
    if not file.is_file():
        return None
    result = read_record(RunResult, file)
    check_same(result.identity, run.identity(), place=file)
    return result


def _job(run: PlannedRun, experiment: Experiment, out: Path, *, threads: int, device: str) -> Job:
    """What a worker is told of a run; one that was begun keeps its threads and device.

    Raises:
        CheckpointError: it was begun with other settings or data.
    """
    folder = (out / "runs" / run.id).resolve()
    if (folder / "job.json").is_file():
        before = read_record(Job, folder / "job.json")
        check_same(before.identity, run.identity(), place=folder)
        threads, device = before.config.settings.run.threads, before.device
    settings = run.config.settings
    bounded = settings.model_copy(update={"run": settings.run.model_copy(update={"threads": threads})})
    return Job(
        experiment=experiment.name,
        method=run.method,
        environment=run.environment,
        seed=run.seed,
        profile=run.profile,
        dataset=str(run.dataset),
        root=run.root,
        folder=str(folder),
        identity=run.identity(),
        config=TrainingConfig(settings=bounded, method=run.config.method),
        device=device,
        protocols=experiment.protocols,
        curve_points=experiment.curve_points,
    )


def _run(jobs: dict[str, Job], workers: int) -> Iterator[tuple[str, str | None]]:
    """Runs end in any order, each with its error or None; closing the iterator ends what still runs."""
    units = [
        Unit(
            run_id,
            job.model_dump(mode="json"),
            worker=WORKER,
            threads=job.config.settings.run.threads,
        )
        for run_id, job in jobs.items()
    ]
    engine = plugin("tcmrl_data.engine", "engine", "local").Engine(workers)
    with contextlib.closing(engine.run(units, lambda unit, message: None)) as results:
        for result in results:
            yield result.id, None if result.ok else result.error


@contextlib.contextmanager
def _lock(out: Path) -> Iterator[None]:
    """Keeps a second driver out of the results folder; the lock ends with this process."""
    with (out / ".lock").open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CheckpointError(f"another process runs an experiment in {out}; wait for its end") from None
        yield


def _write_table(out: Path, experiment: Experiment) -> None:
    rows = [row for result in read_results(out, experiment) for row in result.rows()]
    write_text(out / "table.csv", table_text(rows))
