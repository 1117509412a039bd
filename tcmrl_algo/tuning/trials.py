"""Trains and scores trials, several runs at a time."""

import contextlib
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean

from tcmrl_algo.experiment.job import Job
from tcmrl_algo.experiment.planning import check_same
from tcmrl_algo.experiment.results import AGAIN, RunResult, error_file, result_file
from tcmrl_algo.tuning.plan import TuningPlan
from tcmrl_algo.tuning.record import Trial, TrialRun
from tcmrl_data import Dataset, TrainingError
from tcmrl_data.engine.base import BaseEngine, Unit
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.records import read_record, write_record

WORKER = "tcmrl_algo.tuning.job"


def run_trials(
    plan: TuningPlan,
    view: Dataset,
    out: Path,
    trials: Sequence[Trial],
    *,
    workers: int,
    device: str,
    engine: BaseEngine,
) -> Iterator[Trial | str]:
    """Yields every trial as it ends, or why a run of it crashed; closing the iterator ends what runs.

    Args:
        plan: what all trials share.
        view: the training tasks, of which the held-out ones are the test tasks.
        out: folder of the tuning.
        trials: those to do; runs of theirs that ended before are taken over.
        workers: runs at a time, which share the cores as threads.
        device: a torch device.
        engine: what runs them.

    Raises:
        CheckpointError: a finished run is of other settings.
        TrainingError: settings that do not validate, or returns that cannot be normalised.
    """
    threads = max(1, available_cores() // workers)
    jobs = {
        (trial.number, seed): _job(plan, view, out, trial, seed=seed, threads=threads, device=device)
        for seed in plan.tuning.seeds
        for trial in trials
    }
    waiting = {key: job for key, job in jobs.items() if not _is_finished(job)}
    for job in waiting.values():
        write_record(Path(job.folder) / "job.json", job)
        error_file(Path(job.folder)).unlink(missing_ok=True)
    missing = {trial.number: {key for key in waiting if key[0] == trial.number} for trial in trials}
    folders = {key: Path(job.folder) for key, job in jobs.items()}
    yield from (_scored(plan, trial, folders) for trial in trials if not missing[trial.number])
    with contextlib.closing(_run(waiting, engine)) as results:
        for key, crash in results:
            if crash is not None:
                yield f"{folders[key].name}: {crash}"
                continue
            missing[key[0]].remove(key)
            if not missing[key[0]]:
                (ended,) = (trial for trial in trials if trial.number == key[0])
                yield _scored(plan, ended, folders)


def _job(
    plan: TuningPlan, view: Dataset, out: Path, trial: Trial, *, seed: int, threads: int, device: str
) -> Job:
    tuning = plan.tuning
    return Job(
        experiment=f"tuning of {tuning.algorithm}",
        method=f"trial {trial.number}",
        environment=tuning.environment,
        seed=seed,
        profile=tuning.profile,
        dataset=str(view.path.resolve()),
        root=view.manifest.root,
        folder=str((out / "runs" / f"trial{trial.number:04d}-seed{seed}").resolve()),
        identity=tuning.identity | {"seed": seed, "values": dict(trial.values)},
        config=plan.config(trial.values, threads=threads),
        device=device,
        protocols=tuning.protocols,
        curve_points=1,
    )


def _is_finished(job: Job) -> bool:
    """Whether a run has left a result.

    Raises:
        CheckpointError: it was made with other settings or data.
    """
    file = result_file(Path(job.folder))
    if not file.is_file():
        return False
    check_same(read_record(RunResult, file, remedy=AGAIN).identity, job.identity, place=file)
    return True


def _run(
    jobs: Mapping[tuple[int, int], Job], engine: BaseEngine
) -> Generator[tuple[tuple[int, int], str | None], None, None]:
    """Yields the trial and the seed of every run as it ends, and the reason if it crashed."""
    keys = {Path(job.folder).name: key for key, job in jobs.items()}
    units = [
        Unit(
            name,
            jobs[key].model_dump(mode="json"),
            worker=WORKER,
            threads=jobs[key].config.settings.run.threads,
        )
        for name, key in keys.items()
    ]
    with contextlib.closing(engine.run(units, lambda unit, message: None)) as results:
        for result in results:
            yield keys[result.id], None if result.ok else result.error


def _scored(plan: TuningPlan, trial: Trial, folders: Mapping[tuple[int, int], Path]) -> Trial:
    """The trial with the results of its runs; with the reason instead where one of them diverged."""
    runs = []
    for seed in plan.tuning.seeds:
        folder = folders[trial.number, seed]
        if not result_file(folder).is_file():
            return trial.model_copy(update={"error": error_file(folder).read_text(encoding="utf-8").strip()})
        runs.append(_trial_run(read_record(RunResult, result_file(folder), remedy=AGAIN)))
    score = fmean(value for run in runs for value in run.normalized.values())
    return trial.model_copy(update={"runs": tuple(runs), "score": score})


def _trial_run(result: RunResult) -> TrialRun:
    for protocol, evaluation in result.evaluations.items():
        if evaluation["mean_normalized"] is None:
            raise TrainingError(
                f"{result.method}: a held-out task has no normalised return under {protocol}; hold out others"
            )
    return TrialRun(
        seed=result.seed,
        normalized={name: found["mean_normalized"] for name, found in result.evaluations.items()},
        final={name: found["mean_final"] for name, found in result.evaluations.items()},
        digest=result.digest,
    )
