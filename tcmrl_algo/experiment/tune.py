"""Tunes a method: an experiment whose methods are trials, on held-out training tasks.

Trials are proposed in generations and trained by `run_experiment` on a view of the training tasks, in which
the held-out ones are the test tasks. The dataset's own test tasks are not in the view.
"""

import importlib.metadata
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from tcmrl_algo.algorithms.core.method import METHODS, SettingValue
from tcmrl_algo.algorithms.core.settings import PROTOCOL_GROUP
from tcmrl_algo.experiment.plan import check_same, training_tables
from tcmrl_algo.experiment.results import RunResult
from tcmrl_algo.experiment.run import run_experiment
from tcmrl_algo.experiment.spec import PAPER_PROTOCOLS, Experiment, read_experiment, run_id
from tcmrl_algo.experiment.tunings import (
    RECORD,
    Dimension,
    Trial,
    TrialRun,
    Tuning,
    read_tuning,
    searched,
    space_on,
)
from tcmrl_algo.training.config import resolve_for
from tcmrl_algo.training.train import PACKAGES, usable_device
from tcmrl_data import (
    NO_TASK,
    Dataset,
    Profile,
    Purpose,
    SelectionError,
    TrainingError,
    apply_overrides,
    derive_dataset,
    in_order,
    keyed_seed,
    open_dataset,
)
from tcmrl_data.engine.base import BaseEngine
from tcmrl_data.foundation.disk import lock_file, make_folders
from tcmrl_data.foundation.errors import MissingPackageError
from tcmrl_data.foundation.plugins import check_declared
from tcmrl_data.foundation.records import write_record

FEWEST_TASKS = 3
"""Two training tasks, so that tasks can be told apart, and one to score on."""
SHARE = 5
"""One training task in so many is held out."""
VIEW = "held_out.json"
GENERATION = 4
"""Trials that are proposed together, from the results of all earlier generations.

So what is proposed depends neither on how many trials run at a time nor on which of them ends first.
"""
RANDOM_TRIALS = 8
"""Ended trials before which proposals are drawn at random (Optuna's default: 10)."""

Report = Callable[[Trial, int, int, float | None, float], None]
"""Receives a trial that ended; how many have, of how many; the highest score by now, None without any; and
the seconds until all have ended, if the rest goes at the pace so far."""


@dataclass(frozen=True)
class TuningReport:
    """How a call of `tune_method` ended.

    Attributes:
        present: how many trials had ended before.
        failed: `run: reason` of runs that crashed; the same call repeats them.
    """

    out: Path
    tuning: Tuning
    present: int
    failed: tuple[str, ...]
    seconds: float


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
    report: Report | None = None,
) -> TuningReport:
    """Searches a method's settings, and writes all trials and the best one to `out/tuning.json`.

    A trial trains on the training tasks without the held-out ones and is scored on these: by the mean over
    seeds, protocols and held-out tasks of the normalised return (`TaskResult.normalized`), under which
    uniform actions have 0 and the task's reference has 1. The dataset's test tasks are never read. Trial 0
    takes the training table as it is. The same call goes on after an interruption, and adds trials if
    `trials` is larger; the result is that of one uninterrupted call, whatever `workers` is.

    Args:
        out: the folder, made where it does not exist.
        algorithm: the method; its `search` says what is searched.
        trials: how many, the first included. Compare methods by equal numbers.
        profile: whose training table; the one the dataset was built with if None.
        steps: training steps of every trial, instead of `run.steps`; schedules are scaled to them.
        seeds: every trial is trained with each.
        seed: of the proposals.
        held_out: training tasks to score on; a fifth of them, evenly spaced, if None.
        overrides: `section.key=value` texts that all trials share; what they set is not searched.
        workers: runs at a time, which share the cores as threads; one per core if None.
        engine: what runs them, by name or made before; `workers` says how the cores are shared either way.

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
    planned = plan_tuning(
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
    tuning = _continued(planned, out)
    make_folders(out)
    with lock_file(out / ".tuning.lock", f"tuning {out}"):
        view = held_out_view(dataset, out, tuning.held_out)
        present = done = len([trial for trial in tuning.trials[:trials] if trial.is_done])
        runs: dict[int, list[RunResult]] = {}
        failed: list[str] = []

        def end(trial: Trial) -> None:
            nonlocal tuning, done
            tuning, done = tuning.with_trials([trial]), done + 1
            write_record(out / RECORD, tuning)
            if report is not None:
                pace = (time.perf_counter() - began) / (done - present)
                best = tuning.best_trial
                report(trial, done, trials, best.score if best else None, pace * (trials - done))

        def ended(run: RunResult | str, *_: Any) -> None:
            if isinstance(run, RunResult):
                number = _number(run)
                runs.setdefault(number, []).append(run)
                if len(runs[number]) == len(seeds):
                    end(_scored(tuning.trials[number], runs[number]))

        for first in range(0, trials, GENERATION):
            numbers = range(first, min(first + GENERATION, trials))
            tuning = _proposed(tuning, numbers)
            write_record(out / RECORD, tuning)
            waiting = [number for number in numbers if not tuning.trials[number].is_done]
            if not waiting:
                continue
            made = run_experiment(
                trials_experiment(tuning),
                out,
                data=view.path_on_disk,
                only=[_label(number) for number in waiting],
                overrides=overrides,
                steps=tuning.steps,
                workers=workers,
                device=device,
                engine=engine,
                report=ended,
            )
            for number in waiting:  # those that diverged, and those with runs of an earlier call
                found = [run for run in made.results if _number(run) == number]
                names = [run_id(tuning.environment, _label(number), each) for each in seeds]
                reasons = [made.diverged[name] for name in names if name in made.diverged]
                if reasons:
                    end(tuning.trials[number].model_copy(update={"error": reasons[0]}))
                elif len(found) == len(seeds) and not tuning.trials[number].is_done:
                    end(_scored(tuning.trials[number], found))
            failed = [text for text in made.failed if text.partition(":")[0] not in made.diverged]
            if failed:  # later generations are proposed from all results of this one
                break
    return TuningReport(out, tuning, present, tuple(failed), time.perf_counter() - began)


def plan_tuning(
    dataset: Dataset,
    *,
    algorithm: str,
    profile: Profile,
    steps: int | None,
    seeds: Sequence[int],
    seed: int,
    held_out: Sequence[int] | None,
    protocols: Sequence[str],
    overrides: Sequence[str],
) -> Tuning:
    """The record of `tune_method`, whose arguments these are, without trials."""
    texts = (*overrides, *([] if steps is None else [f"run.steps={steps}"]))
    config = resolve_for(dataset, profile=profile, algorithm=algorithm, overrides=texts)
    for what, given in (("seeds", seeds), ("protocols", protocols)):
        if not given or len(set(given)) < len(given):
            raise TrainingError(f"{what} {list(given)}: name one or more, each once")
    for protocol in protocols:
        check_declared(PROTOCOL_GROUP, "protocol", protocol)
    tasks = held_out_tasks(dataset) if held_out is None else checked_tasks(dataset, held_out)
    _check_references(dataset, tasks)
    space = space_on(
        config,
        searched(METHODS.get(algorithm).search, overrides, kind=config.settings.actor_critic.kind),
    )
    if not space:
        raise TrainingError(f"nothing is left to search of {algorithm}; set fewer of its settings")
    return Tuning(
        algorithm=algorithm,
        environment=dataset.name,
        profile=profile,
        root=dataset.manifest.root,
        seed=seed,
        seeds=tuple(seeds),
        steps=config.settings.run.steps,
        protocols=tuple(protocols),
        training_tasks=tuple(task.index for task in dataset.train_tasks if task.index not in tasks),
        held_out=tasks,
        space=space,
        identity={
            "root": dataset.manifest.root,
            "profile": profile,
            "seed": seed,
            "seeds": list(seeds),
            "protocols": list(protocols),
            "held_out": list(tasks),
            "training": training_tables(config),
            "space": {key: dimension.model_dump(mode="json") for key, dimension in space.items()},
        },
        versions=_versions(),
    )


def _versions() -> dict[str, str]:
    try:
        return {name: importlib.metadata.version(name) for name in (*PACKAGES, "optuna", "tcmrl")}
    except importlib.metadata.PackageNotFoundError as error:
        raise MissingPackageError(
            f"tuning needs a package that is missing ({error.name}); pip install 'tcmrl[tune]'"
        ) from None


def _check_references(dataset: Dataset, tasks: Sequence[int]) -> None:
    """Scores are normalised returns, which a task without a return of uniform actions does not have."""
    for task in tasks:
        if dataset.references(task).uniform is None:
            raise TrainingError(
                f"{dataset.path}: no return of uniform actions is known of task {task}, so that its returns "
                "cannot be normalised; hold out other tasks"
            )


def trials_experiment(tuning: Tuning) -> Experiment:
    """The experiment whose methods are the trials of a tuning."""
    return read_experiment(
        {
            "schema": 1,
            "name": "tuning",
            "title": f"Tuning of {tuning.algorithm}",
            "source": "none",
            "seeds": list(tuning.seeds),
            "environments": {tuning.environment: {"profile": tuning.profile}},
            "methods": {
                _label(trial.number): {
                    "algorithm": tuning.algorithm,
                    "training": apply_overrides({}, trial.overrides),
                }
                for trial in tuning.trials
            },
            "protocols": list(tuning.protocols),
            "curve_points": 1,
        },
        place=f"tuning of {tuning.algorithm}",
    )


def _label(number: int) -> str:
    return f"trial {number:04}"


def _number(run: RunResult) -> int:
    return int(run.method.removeprefix("trial "))


def _scored(trial: Trial, results: Sequence[RunResult]) -> Trial:
    """The trial with the results of its runs."""
    runs = tuple(_trial_run(result) for result in sorted(results, key=lambda result: result.seed))
    score = fmean(value for run in runs for value in run.normalized.values())
    return trial.model_copy(update={"runs": runs, "score": score})


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


def _continued(planned: Tuning, out: Path) -> Tuning:
    """The record in a folder, or a new one without trials."""
    if not (out / RECORD).is_file():
        return planned
    before = read_tuning(out)
    check_same(before.identity, planned.identity, place=out / RECORD)
    return planned.with_trials(before.trials)


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


def held_out_tasks(dataset: Dataset) -> tuple[int, ...]:
    """A fifth of the training tasks, evenly spaced along the environment's ordering; indices, ascending.

    Raises:
        SelectionError: too few training tasks.
    """
    ordered = [task.index for task in in_order(dataset.environment, dataset.train_tasks)]
    _check_number(dataset, ordered)
    return tuple(sorted(evenly_spaced(ordered, max(1, len(ordered) // SHARE))))


def evenly_spaced(ordered: Sequence[int], number: int) -> list[int]:
    """The middles of equally long stretches of a sequence, so that they and the others cover the same range.

    Example:
        >>> evenly_spaced(range(10), 2)
        [2, 7]
    """
    return [ordered[(2 * place + 1) * len(ordered) // (2 * number)] for place in range(number)]


def checked_tasks(dataset: Dataset, tasks: Sequence[int]) -> tuple[int, ...]:
    """The tasks, ascending, if they may be held out.

    Raises:
        SelectionError: one is no training task of the dataset, or fewer than two training tasks are left.
    """
    training = {task.index for task in dataset.train_tasks}
    _check_number(dataset, list(training))
    for task in tasks:
        if task not in training:
            raise SelectionError(
                f"task {task} cannot be held out: it is no training task of {dataset.path}; "
                f"those are {sorted(training)}"
            )
    if not tasks or len(training - set(tasks)) < 2:
        raise SelectionError(
            f"{dataset.path}: of {len(training)} training tasks {len(set(tasks))} are to be held out; "
            "hold out one or more, and leave two or more"
        )
    return tuple(sorted(set(tasks)))


def held_out_view(dataset: Dataset, folder: Path, held_out: Sequence[int]) -> Dataset:
    """A view of the training tasks, in which the held-out ones are the test tasks; made where there is none.

    The dataset's test tasks are not in it, so that nothing which reads the view alone can read them.

    Raises:
        SelectionError: a training task is incomplete.
        ManifestError: the dataset is not the one that the view was made of.
    """
    file = folder / VIEW
    if not file.exists():
        derive_dataset(dataset, view=file, split="train", held_out=held_out)
    return open_dataset(file)


def _check_number(dataset: Dataset, training: Sequence[int]) -> None:
    if len(training) < FEWEST_TASKS:
        raise SelectionError(
            f"{dataset.path} holds {len(training)} training tasks, tuning needs {FEWEST_TASKS} or more; "
            "build more with `tcmrl-data build --tasks`"
        )


def known_to(number: int, trials: Sequence[Trial]) -> list[Trial]:
    """The ended trials of earlier generations than that of a trial."""
    first = number // GENERATION * GENERATION
    return [trial for trial in trials if trial.number < first and trial.is_done]


def propose(
    space: Mapping[str, Dimension], known: Sequence[Trial], *, number: int, seed: int, environment: str
) -> dict[str, SettingValue]:
    """What a trial draws; trial 0 draws what gives the training table's own values.

    Proposals are those of the tree-structured Parzen estimator (Bergstra et al., 2011) of Optuna. It gets the
    known trials anew every time, so that nothing but their records need be kept.

    Args:
        known: ended trials; one that diverged counts as worse than all others.
        number: of the trial.
        seed: of all proposals.

    Raises:
        MissingPackageError: Optuna is not installed.
    """
    if number == 0:
        return {key: dimension.first for key, dimension in space.items()}
    try:
        import optuna
    except ImportError as error:
        raise MissingPackageError(
            f"tuning needs a package that is missing ({error}); pip install 'tcmrl[tune]'"
        ) from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    distributions = {key: _distribution(dimension) for key, dimension in space.items()}
    sampler = optuna.samplers.TPESampler(
        n_startup_trials=RANDOM_TRIALS,
        seed=keyed_seed(seed, environment, NO_TASK, Purpose.TUNING, number),
    )
    study = optuna.create_study(direction="maximize", sampler=sampler)
    for trial in known:
        ended = optuna.trial.TrialState.PRUNED if trial.score is None else optuna.trial.TrialState.COMPLETE
        study.add_trial(
            optuna.trial.create_trial(
                state=ended, params=trial.drawn, distributions=distributions, value=trial.score
            )
        )
    drawn = study.ask(distributions).params
    return {key: drawn[key] for key in space}


def _distribution(dimension: Dimension) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    if dimension.kind == "options":
        return CategoricalDistribution(dimension.options)
    assert dimension.low is not None and dimension.high is not None
    return FloatDistribution(dimension.low, dimension.high, log=True)
