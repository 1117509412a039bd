"""Runs an experiment: skips finished runs, resumes killed ones, several at once, and writes one table.

A call that has nothing to do says so without importing torch, which takes longer than all the rest.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcmrl_algo.experiment.datasets import open_datasets
from tcmrl_algo.experiment.results import (
    DIVERGED,
    Job,
    RunResult,
    TunedSettings,
    error_file,
    read_result,
    read_results,
    table_text,
)
from tcmrl_algo.experiment.spec import Experiment
from tcmrl_data import TrainingError
from tcmrl_data.engine.base import BaseEngine, Unit, make_engine
from tcmrl_data.foundation.disk import lock_file, make_folders, replace_file
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.records import Frozen, digest, read_record, write_record

WORKER = "tcmrl_algo.experiment.job"
PACKAGE = Path(__file__).parents[1]

Report = Callable[[RunResult | str, int, int, float | None], None]
"""Receives a run as it ends, or `run: reason` where it failed; how many have ended, of how many; and the
seconds until all have, if the rest goes at the pace so far, None until every worker has ended a run."""


@dataclass(frozen=True)
class ExperimentReport:
    """How a call of `run_experiment` ended.

    Attributes:
        results: of all runs that are finished, in the order of the plan.
        present: how many of them were finished before.
        failed: `run: reason` of those that ended in an error.
        diverged: the reason of those whose training diverged, by run.
    """

    out: Path
    results: tuple[RunResult, ...]
    present: int
    failed: tuple[str, ...]
    diverged: Mapping[str, str]
    seconds: float


def run_experiment(
    experiment: Experiment,
    out: str | Path,
    *,
    data: str | Path | None = None,
    only: Sequence[str] = (),
    environments: Sequence[str] = (),
    seeds: Sequence[int] | None = None,
    steps: int | None = None,
    overrides: Sequence[str] = (),
    workers: int | None = None,
    device: str = "cpu",
    engine: str | BaseEngine = "local",
    tuned: TunedSettings | None = None,
    report: Report | None = None,
) -> ExperimentReport:
    """Runs an experiment, without the runs that are finished; checks all of it before the first run starts.

    Args:
        out: the results folder; a second call goes on in it.
        data: folder of datasets, one per environment; or one dataset. If left out, the datasets that the
            experiment's file names, else those in `data`.
        only: labels of methods; all where empty.
        environments: names of environments; all where empty.
        seeds: instead of the experiment's.
        steps: training steps instead of `run.steps`.
        overrides: `section.key=value` texts for all runs, which the experiment's own changes go over.
        workers: runs at a time, one per core where None. Each gets its share of the cores as threads,
            whether or not there are so many runs; a run that was begun keeps the threads that it had, on
            which its last bits depend.
        device: a torch device, for runs that are not begun yet.
        engine: what runs them, by name or made before; `workers` says how the cores are shared either way.
        tuned: settings by environment and algorithm, as `tuned_settings` reads them.

    Raises:
        TcmrlError: the plan does not hold, or the folder has runs of other settings or data.

    Example:
        >>> experiment = load_experiment("perspectives")  # doctest: +SKIP
        >>> run_experiment(experiment, "results/perspectives", workers=2).results  # doctest: +SKIP
    """
    began, out, cores = time.perf_counter(), Path(out), available_cores()
    call = {
        "experiment": experiment.to_json(),
        "only": list(only),
        "environments": list(environments),
        "seeds": None if seeds is None else list(seeds),
        "steps": steps,
        "overrides": list(overrides),
        "tuned": None
        if tuned is None
        else {
            name: {algorithm: one.model_dump(mode="json") for algorithm, one in settings.items()}
            for name, settings in tuned.items()
        },
    }
    data = None if data is None else Path(data)
    datasets = open_datasets(experiment.on(environments), data)
    call["roots"] = {name: dataset.manifest.root for name, dataset in datasets.items()}
    if (names := _nothing_to_do(out, call)) is not None:
        results = tuple(read_result(out / "runs" / name) for name in names)
        return ExperimentReport(out, results, len(results), (), {}, time.perf_counter() - began)

    from tcmrl_algo.experiment.plan import plan_runs
    from tcmrl_algo.training.train import usable_device

    usable_device(device)
    workers = workers or cores
    every = plan_runs(
        experiment,
        data=data,
        out=out,
        environments=environments,
        seeds=seeds,
        steps=steps,
        overrides=overrides,
        tuned=tuned,
        threads=max(1, cores // workers),
        device=device,
    )
    before = _finished(every, out, experiment)
    plan = _chosen(every, experiment, only)
    found = {job.id: before.get(job.id) for job in plan}
    jobs = {job.id: _begun(job) for job in plan if found[job.id] is None}
    make_folders(out)
    failed: list[str] = []
    diverged: dict[str, str] = {}
    with lock_file(out / ".lock", f"experiment {out}"):
        write_record(out / "experiment.json", experiment)
        for job in jobs.values():
            write_record(Path(job.folder) / "job.json", job)
            error_file(Path(job.folder)).unlink(missing_ok=True)
        present = len(plan) - len(jobs)
        _write_table(out, experiment)
        for name, error, is_diverged in _run(jobs, make_engine(engine, workers)):
            if is_diverged:
                diverged[name] = error or ""
            ended = read_result(Path(jobs[name].folder)) if error is None else f"{name}: {error}"
            if isinstance(ended, str):
                failed.append(ended)
                replace_file(error_file(Path(jobs[name].folder)), f"{error}\n".encode())
            else:
                found[name] = ended
            _write_table(out, experiment)
            done = sum(result is not None for result in found.values()) + len(failed)
            pace = (time.perf_counter() - began) / (done - present)
            is_known = done - present >= min(workers, len(jobs))
            if report is not None:
                report(ended, done, len(plan), pace * (len(plan) - done) if is_known else None)
        if not failed:
            write_record(out / LAST_CALL, LastCall(state=_state(out, call), runs=tuple(found)))
    results = tuple(result for result in found.values() if result is not None)
    return ExperimentReport(out, results, present, tuple(failed), diverged, time.perf_counter() - began)


class LastCall(Frozen):
    """`last_call.json` of a results folder: of a call that left nothing to do.

    Attributes:
        state: digest of what it was asked, of this package's files and of the results.
        runs: ids, in the order of the plan.
    """

    state: str
    runs: tuple[str, ...]


LAST_CALL = "last_call.json"


def _nothing_to_do(out: Path, call: Mapping[str, Any]) -> tuple[str, ...] | None:
    """The finished runs, if the last call was the same and neither results nor code were changed since."""
    file = out / LAST_CALL
    if not file.is_file():
        return None
    last = read_record(LastCall, file, remedy="; delete it")
    return last.runs if last.state == _state(out, call) else None


def _state(out: Path, call: Mapping[str, Any]) -> str:
    files = {
        str(file.relative_to(folder)): [file.stat().st_size, file.stat().st_mtime_ns]
        for folder, pattern in (
            (out, "*.json"),
            (out, "table.csv"),
            (out, "runs/*.json"),
            (PACKAGE, "**/*.py"),
        )
        for file in folder.glob(pattern)
        if file.name != LAST_CALL
    }
    return digest([dict(call), files])


def _chosen(plan: Sequence[Job], experiment: Experiment, only: Sequence[str]) -> list[Job]:
    """The runs of the methods of these labels; all where there are none."""
    unknown = [label for label in only if label not in experiment.methods]
    if unknown:
        known = ", ".join(map(repr, experiment.methods))
        raise TrainingError(f"--only {unknown[0]!r}: {experiment.name} has no such method; they are {known}")
    return [run for run in plan if not only or run.method in only]


def _finished(plan: Sequence[Job], out: Path, experiment: Experiment) -> dict[str, RunResult]:
    """Results that the folder holds, by run, of other seeds than the planned ones too."""
    from tcmrl_algo.experiment.plan import check_same

    planned = {(job.environment, job.method, job.fold): job.identity for job in plan}
    found = {}
    for result in read_results(out, experiment):
        identity = planned.get((result.environment, result.method, result.fold), result.identity)
        check_same(
            result.identity, identity | {"seed": result.seed}, place=out / "runs" / f"{result.id}.json"
        )
        found[result.id] = result
    return found


def _begun(job: Job) -> Job:
    """The job; one that has begun training keeps its threads and its device."""
    from tcmrl_algo.experiment.plan import check_same, with_threads

    folder = Path(job.folder)
    if not ((folder / "run.json").is_file() and (folder / "job.json").is_file()):
        return job
    before = read_record(Job, folder / "job.json")
    check_same(before.identity, job.identity, place=folder)
    config = with_threads(job.config, before.config.settings.run.threads)
    return job.model_copy(update={"config": config, "device": before.device})


def _run(jobs: dict[str, Job], engine: BaseEngine) -> Iterator[tuple[str, str | None, bool]]:
    """Yields every run as it ends: its id, its error or None, and whether it diverged.

    Closing the iterator ends the runs that go on.
    """
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
            is_diverged = result.digest == DIVERGED
            told = error_file(Path(jobs[result.id].folder))
            yield result.id, told.read_text("utf-8").strip() if is_diverged else result.error, is_diverged


def _write_table(out: Path, experiment: Experiment) -> None:
    rows = [row for result in read_results(out, experiment) for row in result.rows()]
    replace_file(out / "table.csv", table_text(rows).encode())
