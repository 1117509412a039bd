"""Meta-training: a dataset and a resolved configuration in, a run's folder out."""

import contextlib
import ctypes
import importlib.metadata
import json
import math
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, final, runtime_checkable

import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from tcmrl_algo.algorithms.core.method import Algorithm
from tcmrl_algo.algorithms.core.problem import MomentsRecord, TaskParameters, problem_of
from tcmrl_algo.algorithms.core.settings import TrainingConfig
from tcmrl_algo.training.batches import StagedBatches, open_batches
from tcmrl_algo.training.checkpoint import (
    EVALUATIONS,
    METRICS,
    Run,
    RunRecord,
    open_run,
    tensors_digest,
    write_run,
)
from tcmrl_algo.training.config import method_of, stage_plan
from tcmrl_data import CheckpointError, Dataset, Prefetch, TcmrlError, TrainingError
from tcmrl_data.foundation.errors import DivergenceError
from tcmrl_data.foundation.machine import DeferredInterrupts

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Of glibc's malloc.h; other C libraries have no `mallopt`, or ignore these."""
LARGEST_TENSOR = 1 << 30
MOST_FREE = (1 << 31) - 1


def keep_freed_memory() -> None:
    """Lets the process keep freed memory for its next tensors, up to its own peak.

    glibc gives large tensors back to the kernel as soon as they are freed; asking for them anew costs one
    page fault per 4 KiB, which was a tenth of a training step's time at the paper's sizes.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_TENSOR)
        mallopt(M_TRIM_THRESHOLD, MOST_FREE)


def log_evaluation(folder: Path, *, step: int, protocol: str, scores: Mapping[str, float | None]) -> None:
    """Appends mean scores of an evaluation to a run's `evaluations.jsonl`, and to its TensorBoard curves.

    A run that cannot be written to, such as one on a shared disk, is evaluated all the same.

    Args:
        scores: by name; None where there is none.
    """
    with contextlib.suppress(OSError):
        with (folder / EVALUATIONS).open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"step": step, "protocol": protocol, **scores}) + "\n")
        with SummaryWriter(str(folder / "tensorboard"), filename_suffix=f".{protocol}") as board:
            for name, value in scores.items():
                if value is not None:
                    board.add_scalar(f"return/{protocol}/{name}", value, step)


@final
class MetricsWriter:
    """Appends to `metrics.jsonl` and `tensorboard/` in a run's folder.

    Args:
        step: the checkpoint's step that training goes on from; what a killed run logged beyond it is dropped.
    """

    def __init__(self, folder: Path, *, step: int) -> None:
        self._file = folder / METRICS
        self._keep_until(step)
        self._stream = self._file.open("a", encoding="utf-8")
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, step: int, metrics: Mapping[str, float], *, stage: str) -> None:
        """Logs the metrics of a step of a stage."""
        self._stream.write(json.dumps({"step": step, "stage": stage, **metrics}) + "\n")
        self._stream.flush()
        for name, value in metrics.items():
            self._board.add_scalar(name, value, step)

    def __enter__(self) -> "MetricsWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()
        self._board.close()

    def _keep_until(self, step: int) -> None:
        if not self._file.is_file():
            return
        lines = self._file.read_text(encoding="utf-8").splitlines()
        kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
        self._file.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")


PACKAGES = ("torch", "numpy")
"""Whose versions results depend on."""
REMEDY = (
    "the last checkpoint, if any, is intact; lower optimizer.learning_rate or bound "
    "optimizer.gradient_norm with --set"
)
"""Against divergence."""

SHOWN_SECONDS = 1.0
"""Longest time between two reports; only logged steps are written down."""

PREFETCHED = 2
"""Batches that wait ready; results do not depend on it."""


@runtime_checkable
class Watch(Protocol):
    """Looks at a run every so many steps, and changes nothing of it."""

    every: int

    def __call__(self, record: RunRecord, tensors: Mapping[str, Tensor]) -> Mapping[str, float]:
        """Metrics of the run at this step, `watch/return` among them."""
        ...


@dataclass(frozen=True)
class TrainingProgress:
    """Where a training run stands.

    Attributes:
        stage: of training, to which the step belongs.
        rate: steps per second since the last report.
        data_share: share of that time spent waiting for batches.
        watched: the last `watch/return`, if a watch looks at the run.
    """

    step: int
    steps: int
    stage: str
    rate: float
    data_share: float
    metrics: Mapping[str, float]
    watched: float | None = None


@dataclass(frozen=True)
class TrainingReport:
    """The result of a finished training run.

    Attributes:
        seconds: wall-clock time of this call.
        digest: sha256 over all tensors, by which two runs compare.
    """

    run: Run
    step: int
    seconds: float
    digest: str


def ignore(progress: TrainingProgress) -> None:
    """Reports nothing."""


def keep_quiet(message: str) -> None:
    """Says nothing."""


def train_run(
    dataset: Dataset,
    out: str | Path,
    *,
    config: TrainingConfig,
    profile: str,
    seed: int = 0,
    steps: int | None = None,
    device: str = "cpu",
    memory_limit: int | None = None,
    watch: Watch | None = None,
    report: Callable[[TrainingProgress], None] = ignore,
    say: Callable[[str], None] = keep_quiet,
) -> TrainingReport:
    """Trains a new run.

    Args:
        dataset: what to learn from; only its training tasks are used.
        out: the run's folder, made here.
        profile: whose table it was; recorded.
        steps: where to stop, instead of `run.steps`; schedules keep the length that `run.steps` gives them.
        memory_limit: bytes of data beyond which the cache is used; half of the available memory if None.
        watch: looks at the run now and then; its metrics are logged. No tensor of the run depends on it.
        report: called after every logged step, and about once a second.
        say: told where data are read from, where that is not memory.

    Raises:
        CheckpointError: the folder holds a run already.
        SelectionError: fewer than two training tasks, or too few snapshots or trajectories.
        TrainingError: an unusable device.
        DivergenceError: a loss that is not finite, or beyond the method's limits.

    Example:
        >>> dataset = tcmrl_data.open_dataset("data/point-robot")  # doctest: +SKIP
        >>> config = resolve(dataset.manifest.training["quick"], place="quick")  # doctest: +SKIP
        >>> train_run(dataset, "runs/first", config=config, profile="quick", seed=1)  # doctest: +SKIP
    """
    if (Path(out) / "run.json").exists():
        raise CheckpointError(
            f"{out} holds a run already; add --resume to go on with it, or name another --out"
        )
    batches = open_batches(
        dataset,
        config.settings.run,
        stage_plan(config),
        seed=seed,
        device=usable_device(device),
        memory_limit=memory_limit,
        say=say,
    )
    record = RunRecord(
        environment=dataset.name,
        dataset=str(dataset.path.resolve()),
        root=dataset.manifest.root,
        profile=profile,
        seed=seed,
        steps=config.settings.run.steps if steps is None else steps,
        device=device,
        config=config,
        privileged=method_of(config)[0].capabilities.privileged,
        moments=MomentsRecord.of(batches.moments()),
        versions={name: importlib.metadata.version(name) for name in PACKAGES},
    )
    algorithm = create_algorithm(record, dataset)
    run = write_run(Path(out), record)  # only now: what cannot start leaves nothing behind
    try:
        return _train(run, algorithm, batches, start=0, watch=watch, report=report)
    except TcmrlError:
        raise  # such as a diverged loss, whose metrics say how
    except Exception:  # of a method's code: there is nothing to go on with, and the next try is not blocked
        if not run.checkpoints():
            (run.folder / "run.json").unlink()
        raise


def resume_run(
    out: str | Path,
    dataset: Dataset,
    *,
    steps: int | None = None,
    device: str | None = None,
    memory_limit: int | None = None,
    watch: Watch | None = None,
    report: Callable[[TrainingProgress], None] = ignore,
    say: Callable[[str], None] = keep_quiet,
) -> TrainingReport:
    """Goes on from a run's newest checkpoint; ends as an uninterrupted run of the same length would have.

    A run that was killed before its first checkpoint begins anew.

    Args:
        steps: another place to stop.
        device: another device.
        say: told from which step training goes on; otherwise as for `train_run`.

    Raises:
        CheckpointError: no run, another dataset, or already further than `steps`.
        TrainingError: an unusable device.
        DivergenceError: a loss that is not finite, or beyond the method's limits.
    """
    run = open_run(out)
    run.check_dataset(dataset)
    changes = {"steps": steps, "device": device, "dataset": str(dataset.path.resolve())}
    record = run.record.model_copy(update={key: value for key, value in changes.items() if value is not None})
    start = run.checkpoints()[-1].step if run.checkpoints() else 0
    if start > record.steps:
        raise CheckpointError(f"{out} is at step {start} already, beyond --stop-at {record.steps}")
    batches = open_batches(
        dataset,
        record.config.settings.run,
        stage_plan(record.config),
        seed=record.seed,
        device=usable_device(record.device),
        memory_limit=memory_limit,
        say=say,
    )
    algorithm = create_algorithm(record, dataset)
    if start == record.steps:
        say(f"{out} has all of its {start:,} steps; to train with other settings, name another --out")
    else:
        say(f"going on from step {start:,}" if start else "no checkpoint was saved: starting at step 0")
    if start:
        algorithm.load_tensors(run.newest().tensors())
    run = write_run(run.folder, record)
    return _train(run, algorithm, batches, start=start, watch=watch, report=report)


def create_algorithm(record: RunRecord, dataset: Dataset) -> Algorithm:
    """A run's algorithm with its networks at their start, for training or for a checkpoint's tensors."""
    settings = record.config.settings
    torch.set_num_threads(settings.run.threads)
    method, config = method_of(record.config)
    training_tasks = dataset.train_tasks
    privileged = TaskParameters(training_tasks) if method.capabilities.privileged else None
    problem = problem_of(
        dataset.environment,
        record.moments,
        seed=record.seed,
        stages=stage_plan(record.config),
        training_tasks=[task.index for task in training_tasks],
        privileged=privileged(training_tasks) if privileged else None,
        device=usable_device(record.device),
    )
    return method.create(problem, settings, config)


def usable_device(name: str) -> torch.device:
    """The torch device of a name, tried out.

    Raises:
        TrainingError: it cannot be used here.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise TrainingError(f"--device {name!r} cannot be used here: {reason}") from None
    return device


def _train(
    run: Run,
    algorithm: Algorithm,
    batches: StagedBatches,
    *,
    start: int,
    watch: Watch | None,
    report: Callable[[TrainingProgress], None],
) -> TrainingReport:
    """The loop: batch n - 1 makes step n; signals take effect after a checkpoint of their step."""
    settings, last = run.record.config.settings.run, run.record.steps
    stages, window_length = stage_plan(run.record.config), run.record.config.settings.batch.window_length
    keep_freed_memory()
    began = time.perf_counter()
    logged_at, logged_step, logged_wait, shown_at = began, start, 0.0, began
    watched: float | None = None
    with (
        DeferredInterrupts() as interrupts,
        MetricsWriter(run.folder, step=start) as writer,
        Prefetch(batches.batch, range(start, last), depth=PREFETCHED) as stream,
    ):
        for step in range(start + 1, last + 1):
            metrics = algorithm.update(next(stream), step)
            _check_sizes(metrics, algorithm.limits(), step)
            now = time.perf_counter()
            is_watched = watch is not None and step % watch.every == 0
            is_logged = step % settings.log_every == 0 or step == last or is_watched
            if is_logged or now - shown_at > SHOWN_SECONDS:
                values = {name: float(value) for name, value in metrics.items()}
                seconds = max(now - logged_at, 1e-9)
                rate, share = (step - logged_step) / seconds, (stream.waited - logged_wait) / seconds
                stage = stages.at(step).stage
                if is_logged:
                    about = {"data/short_trajectories": float(batches.short_trajectories(window_length))}
                    times = {"time/steps_per_second": rate, "time/data_share": share}
                    seen = watch(run.record, algorithm.tensors()) if watch and is_watched else {}
                    watched = seen.get("watch/return", watched)
                    writer.write(step, values | about | times | dict(seen), stage=stage)
                    logged_at, logged_step, logged_wait = time.perf_counter(), step, stream.waited
                report(TrainingProgress(step, last, stage, rate, share, values, watched))
                shown_at = time.perf_counter()
            stopping = interrupts.received
            if step % settings.checkpoint_every == 0 or step == last or interrupts.checkpoint_wanted:
                _check_finite(algorithm.tensors(), step)
                run.save(step, algorithm.tensors())
                interrupts.checkpoint_written()
            if stopping:
                break  # the signal takes effect as the block ends
    return TrainingReport(run, last, time.perf_counter() - began, tensors_digest(algorithm.tensors()))


def _check_sizes(metrics: Mapping[str, Tensor], limits: Mapping[str, float], step: int) -> None:
    """Stops training where a metric is NaN or beyond its limit, one synchronisation for all of them."""
    largest = [limits.get(name, sys.float_info.max) for name in metrics]
    sizes = torch.stack([*metrics.values()]).double().abs().tolist()
    for name, size, limit in zip(metrics, sizes, largest, strict=True):
        if math.isnan(size) or size > limit:
            what = f"is {size:.3g}, beyond {limit:.3g}," if name in limits else "is not finite"
            raise DivergenceError(f"{name} {what} at step {step}; {REMEDY}")


def _check_finite(values: Mapping[str, Tensor], step: int) -> None:
    """Stops training where a tensor holds NaN or infinity, one synchronisation for all of them."""
    bad = [torch.isfinite(value).all() for value in values.values()]
    if bool(torch.stack(bad).all()):
        return
    name = next(name for name, finite in zip(values, bad, strict=True) if not finite)
    raise DivergenceError(f"{name} is not finite at step {step}; {REMEDY}")
