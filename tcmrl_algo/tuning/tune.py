"""Tunes a method on held-out training tasks: proposes, trains and scores trials, resumably."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_algo.experiment.config import PAPER_PROTOCOLS
from tcmrl_algo.experiment.planning import check_same
from tcmrl_algo.training.train import usable_device
from tcmrl_algo.tuning.holding_out import open_view
from tcmrl_algo.tuning.plan import TuningPlan, plan_tuning
from tcmrl_algo.tuning.proposals import GENERATION, known_to, propose
from tcmrl_algo.tuning.record import RECORD, Trial, Tuning, read_tuning
from tcmrl_algo.tuning.trials import run_trials
from tcmrl_data import Dataset, Profile, TrainingError
from tcmrl_data.engine.base import BaseEngine, make_engine
from tcmrl_data.foundation.disk import lock_file, make_folders
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.foundation.records import write_record


@dataclass(frozen=True)
class EndedTrial:
    """A trial that ended in this call.

    Attributes:
        trial: what it drew and how it ended.
        done, total: trials ended by now, and all of them.
        best: highest score by now; None without any.
        seconds_left: until all have ended, if the rest goes at the pace so far.
    """

    trial: Trial
    done: int
    total: int
    best: float | None
    seconds_left: float


@dataclass(frozen=True)
class TuningReport:
    """How a call of `tune_method` ended.

    Attributes:
        out: the folder.
        tuning: the record of all trials.
        present: how many trials had ended before.
        failed: `run: reason` of runs that crashed; the same call repeats them.
        seconds: wall-clock time of this call.
    """

    out: Path
    tuning: Tuning
    present: int
    failed: tuple[str, ...]
    seconds: float


def ignore(event: EndedTrial) -> None:
    """Reports nothing."""


def tune_method(
    dataset: Dataset,
    out: str | Path,
    *,
    algorithm: str,
    trials: int,
    profile: Profile | None = None,
    steps: int | None = None,
    seeds: Sequence[int] = (0,),
    seed: int = 0,
    held_out: Sequence[int] | None = None,
    protocols: Sequence[str] = PAPER_PROTOCOLS,
    overrides: Sequence[str] = (),
    workers: int | None = None,
    device: str = "cpu",
    engine: str | BaseEngine = "local",
    report: Callable[[EndedTrial], None] = ignore,
) -> TuningReport:
    """Searches a method's settings, and writes all trials and the best one to `out/tuning.json`.

    A trial trains on the training tasks without the held-out ones and is scored on these: by the mean over
    seeds, protocols and held-out tasks of the normalised return (`TaskResult.normalized`), under which
    uniform actions have 0 and the task's reference has 1. The dataset's test tasks are never read. Trial 0
    takes the training table as it is. The same call goes on after an interruption, and adds trials if
    `trials` is larger; the result is that of one uninterrupted call, whatever `workers` is.

    Args:
        dataset: what to learn from.
        out: the folder, made where it does not exist.
        algorithm: the method; its `search` says what is searched.
        trials: how many, the first included. Compare methods by equal numbers.
        profile: whose training table; the one the dataset was built with if None.
        steps: training steps of every trial, instead of `run.steps`; schedules are scaled to them.
        seeds: every trial is trained with each.
        seed: of the proposals.
        held_out: training tasks to score on; a fifth of them, evenly spaced, if None.
        protocols: of evaluation.
        overrides: `section.key=value` texts that all trials share; what they set is not searched.
        workers: runs at a time, which share the cores as threads; one per core if None.
        device: a torch device.
        engine: what runs them, by name or made before; `workers` says how the cores are shared either way.
        report: called as trials end.

    Raises:
        SelectionError: too few training tasks, or held-out tasks that are none.
        TrainingError: settings that do not validate or leave nothing to search, or a task without a return
            of uniform actions.
        CheckpointError: the folder holds trials of other settings or data.
        MissingPackageError: Optuna is not installed.

    Example:
        >>> dataset = tcmrl_data.open_dataset("data/point-robot")  # doctest: +SKIP
        >>> done = tune_method(dataset, "tuning/focal", algorithm="focal", trials=16)  # doctest: +SKIP
        >>> done.tuning.best_trial.overrides  # doctest: +SKIP
        ('optimizer.learning_rate=0.00142', 'actor_critic.entropy=0.0312', 'focal.epsilon=0.054')
    """
    began, out = time.perf_counter(), Path(out)
    usable_device(device)
    if trials < 1:
        raise TrainingError(f"{trials} trials are too few; ask for 1 or more")
    plan = plan_tuning(
        dataset,
        algorithm=algorithm,
        profile=profile or dataset.manifest.profile,
        steps=steps,
        seeds=seeds,
        seed=seed,
        held_out=held_out,
        protocols=protocols,
        overrides=overrides,
    )
    tuning = _continued(plan, out)
    workers = workers or available_cores()
    runner = make_engine(engine, workers)
    make_folders(out)
    with lock_file(out / ".lock", f"tuning {out}"):
        view = open_view(dataset, out, plan.tuning.held_out)
        present = len([trial for trial in tuning.trials[:trials] if trial.is_done])
        done, failed = present, []
        for first in range(0, trials, GENERATION):
            numbers = range(first, min(first + GENERATION, trials))
            tuning = _proposed(tuning, numbers)
            write_record(out / RECORD, tuning)
            waiting = [tuning.trials[number] for number in numbers if not tuning.trials[number].is_done]
            for ended in run_trials(plan, view, out, waiting, workers=workers, device=device, engine=runner):
                if isinstance(ended, str):
                    failed.append(ended)
                    continue
                tuning = tuning.with_trials([ended])
                write_record(out / RECORD, tuning)
                done += 1
                pace = (time.perf_counter() - began) / (done - present)
                best = tuning.best_trial
                report(EndedTrial(ended, done, trials, best.score if best else None, pace * (trials - done)))
            if failed:  # later generations are proposed from all results of this one
                break
    return TuningReport(out, tuning, present, tuple(failed), time.perf_counter() - began)


def _continued(plan: TuningPlan, out: Path) -> Tuning:
    """The record in a folder, or a new one without trials.

    Raises:
        CheckpointError: it is of other settings or data.
    """
    if not (out / RECORD).is_file():
        return plan.tuning
    before = read_tuning(out)
    check_same(before.identity, plan.tuning.identity, place=out / RECORD)
    return plan.tuning.with_trials(before.trials)


def _proposed(tuning: Tuning, numbers: Sequence[int]) -> Tuning:
    """The record with the trials of these numbers, in which what was proposed before stays as it was."""
    added = []
    for number in numbers[max(0, len(tuning.trials) - numbers[0]) :]:
        drawn = propose(
            tuning.space,
            known_to(number, tuning.trials),
            number=number,
            seed=tuning.seed,
            environment=tuning.environment,
        )
        values = {key: dimension.value(drawn[key]) for key, dimension in tuning.space.items()}
        added.append(Trial(number=number, drawn=drawn, values=values))
    return tuning.with_trials(added)
