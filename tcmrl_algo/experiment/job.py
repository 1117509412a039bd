"""The process of a run: `python -m tcmrl_algo.experiment.job`, a JSON job on standard input.

It trains up to the next point of the learning curve, evaluates there, writes the point down, and so on; a
killed one goes on from the newest checkpoint and ends in the same tensors. An equal training of another
experiment is taken over instead of done again.
"""

import importlib.metadata
import subprocess
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from tcmrl_algo.algorithms.core.settings import EVALUATION_KEYS, LOGGING_KEYS
from tcmrl_algo.evaluation.evaluate import evaluate_run
from tcmrl_algo.experiment.plan import completed, with_threads
from tcmrl_algo.experiment.results import (
    DIVERGED,
    Curve,
    CurvePoint,
    Job,
    RunResult,
    RunSpec,
    SharedTraining,
    error_file,
    read_results,
    result_file,
)
from tcmrl_algo.experiment.spec import experiment_of
from tcmrl_algo.training.checkpoint import open_run, tensors_digest, write_run
from tcmrl_algo.training.config import stage_plan
from tcmrl_algo.training.train import TrainingProgress, resume_run, train_run
from tcmrl_data import CheckpointError, Dataset, open_dataset
from tcmrl_data.engine.local import Send
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import DivergenceError
from tcmrl_data.foundation.machine import processor
from tcmrl_data.foundation.records import read_record, write_record

CODE = Path(__file__).parents[2]
MEANS = ("final", "regret", "normalized", "shuffled")


def finished_trainings(folders: Iterable[str | Path]) -> list[RunResult]:
    """The finished runs in results folders that still have their tensors."""
    return [
        result.model_copy(update={"identity": completed(result.identity)})
        for folder in map(Path, folders)
        for result in read_results(folder, experiment_of(folder))
        if result.identity and result.folder is not None and (result.folder / "run.json").is_file()
    ]


def take_over(job: Job, trained: Sequence[RunResult]) -> Job:
    """The job with the tensors of an equal training in its folder; the job itself where there is none.

    Trainings are equal if dataset root, test tasks, seed, steps, device and all settings are, but for those
    that only evaluation or logging read; settings that are newer than a training have their defaults there.
    The code is taken to be the same. A learning curve is taken over
    only from a run with points at the same steps, evaluated in the same way.
    """
    folder = Path(job.folder)
    if (folder / "run.json").is_file():
        return job
    for result in trained:
        if _training_of(result.identity) != _training_of(job.identity) or result.device != job.device:
            continue
        assert result.folder is not None
        evaluated_alike = _evaluation_of(result.identity) == _evaluation_of(job.identity)
        points = {point.step: point for point in result.curve}
        *steps, last = job.points()
        is_curve_alike = evaluated_alike and job.protocols[:1] == tuple(result.evaluations)[:1]
        run = open_run(result.folder)
        if (steps and not (is_curve_alike and points.keys() >= set(steps))) or run.newest().step != last:
            continue
        config = with_threads(job.config, result.threads)
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


def run_job(job: Job, report: Send) -> str:
    """Does a run, or what is missing of it; the digest of its tensors.

    Raises:
        TcmrlError: it cannot be trained or evaluated.
    """
    folder, dataset = Path(job.folder), open_dataset(job.dataset)
    if dataset.manifest.root != job.root:
        raise CheckpointError(f"{job.dataset} was changed after this experiment began; start it anew")
    file = folder / "curve.json"
    curve = read_record(Curve, file).points if file.is_file() else ()
    shared = {} if job.shared is None else job.shared.evaluations
    evaluations: dict[str, dict[str, Any]] = {}
    stages = stage_plan(job.config)
    for step in job.points()[len(curve) :]:
        timed_steps, seconds = _train_to(step, job, dataset, report)
        began = time.perf_counter()
        is_last = step == job.points()[-1]
        evaluations = {
            protocol: shared[protocol]
            if is_last and protocol in shared
            else evaluate_run(
                folder, protocol=protocol, dataset_path=job.dataset, repeats=None if is_last else 1
            ).to_json()
            for protocol in (job.protocols if is_last else job.protocols[:1])
        }
        first = evaluations[job.protocols[0]]
        point = CurvePoint(
            step=step,
            stage=stages.at(step).stage,
            **{name: first[f"mean_{name}"] for name in MEANS},
            timed_steps=timed_steps,
            seconds=seconds,
            evaluation_seconds=time.perf_counter() - began,
            peak_memory=_peak_memory(),
            device_memory=torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0,
        )
        curve = (*curve, point)
        if step < job.points()[-1]:
            write_record(file, Curve(points=curve))
    result = _result(job, dataset, curve, evaluations)
    write_record(result_file(folder), result)
    return result.digest


def _train_to(step: int, job: Job, dataset: Dataset, report: Send) -> tuple[int, float]:
    """Trains up to a step; how many steps that took here, and how long."""
    folder = Path(job.folder)
    is_begun = (folder / "run.json").is_file()
    checkpoints = open_run(folder).checkpoints() if is_begun else []
    start = reported = checkpoints[-1].step if checkpoints else 0
    if start == step:
        return 0, 0.0

    def show(progress: TrainingProgress) -> None:
        nonlocal reported
        report({"kind": "steps", "count": progress.step - reported})
        reported = progress.step

    if is_begun:
        return step - start, resume_run(folder, dataset, steps=step, report=show).seconds
    done = train_run(
        dataset,
        folder,
        config=job.config,
        profile=job.profile,
        seed=job.seed,
        steps=step,
        device=job.device,
        report=show,
    )
    return step, done.seconds


def _result(
    job: Job, dataset: Dataset, curve: tuple[CurvePoint, ...], evaluations: dict[str, dict[str, Any]]
) -> RunResult:
    run = open_run(job.folder)
    timed, seconds = sum(point.timed_steps for point in curve), sum(point.seconds for point in curve)
    steps, shared = run.record.steps, job.shared
    memory = max(point.device_memory or point.peak_memory for point in curve)
    return RunResult(
        **{name: getattr(job, name) for name in RunSpec.model_fields if name not in ("config", "device")},
        algorithm=job.config.settings.run.algorithm,
        privileged=run.record.privileged,
        steps=steps,
        device=run.record.device,
        threads=run.record.config.settings.run.threads,
        config=run.record.config,
        versions=run.record.versions | {"tcmrl": importlib.metadata.version("tcmrl")},
        digest=tensors_digest(run.newest().tensors()),
        curve=curve,
        evaluations=evaluations,
        training_seconds=shared.training_seconds if shared else seconds * steps / timed if timed else None,
        evaluation_seconds=sum(point.evaluation_seconds for point in curve),
        peak_memory=shared.peak_memory if shared else memory,
        training_of=shared.training_of if shared else None,
        behavior_seed=dataset.manifest.seed,
        commit=code_commit(),
        processor=torch.cuda.get_device_name() if run.record.device.startswith("cuda") else processor(),
    )


def code_commit() -> str | None:
    """The commit of this package's code, as `RunResult.commit`."""
    if not (CODE / ".git").exists():
        return None
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        found = subprocess.run(describe, cwd=CODE, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def _peak_memory() -> int:
    """Bytes that this process held at most; Linux keeps count (`getrusage` would count the driver's too)."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return 0


def work(spec: dict[str, Any], report: Send) -> str:
    """Does the run of a job in JSON; the digest of its tensors, or `DIVERGED`."""
    job = Job.model_validate(spec)
    try:
        return run_job(job, report)
    except DivergenceError as error:
        replace_file(error_file(Path(job.folder)), f"{error}\n".encode())
        return DIVERGED
