"""The process of a run: `python -m tcmrl_algo.experiment.job`, a JSON job on standard input.

It trains up to the next point of the learning curve, evaluates there, writes the point down, and so on; a
killed one goes on from the newest checkpoint and ends in the same tensors.
"""

import importlib.metadata
import subprocess
import time
from pathlib import Path
from typing import Any

import torch

from tcmrl_algo.evaluation.evaluate import evaluate_run
from tcmrl_algo.experiment.results import (
    DIVERGED,
    Curve,
    CurvePoint,
    Job,
    RunResult,
    RunSpec,
    error_file,
    result_file,
)
from tcmrl_algo.training.checkpoint import open_run, tensors_digest
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
    evaluations: dict[str, dict[str, Any]] = {}
    stages = stage_plan(job.config)
    for step in job.points()[len(curve) :]:
        timed_steps, seconds = _train_to(step, job, dataset, report)
        began = time.perf_counter()
        is_last = step == job.points()[-1]
        evaluations = {
            protocol: evaluate_run(
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
    steps = run.record.steps
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
        training_seconds=seconds * steps / timed if timed else None,
        evaluation_seconds=sum(point.evaluation_seconds for point in curve),
        peak_memory=max(point.device_memory or point.peak_memory for point in curve),
        behavior_seed=dataset.manifest.seed,
        commit=code_commit(),
        processor=_trained_by(run.record.device),
    )


def _trained_by(device: str) -> str | None:
    """Model name of what trained; None for a graphics card that another machine has."""
    if not device.startswith("cuda"):
        return processor()
    return torch.cuda.get_device_name() if torch.cuda.is_available() else None


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
