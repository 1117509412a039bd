"""What a report is on: results folders as experiments left them, and single runs gathered into one."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_algo.adaptation.evaluate import evaluate_run
from tcmrl_algo.adaptation.protocols.base import PROTOCOLS
from tcmrl_algo.experiment.config import Experiment, read_experiment, run_id
from tcmrl_algo.experiment.results import RunResult, error_file, read_results, result_file
from tcmrl_algo.training.checkpoint import Run, open_run, tensors_digest
from tcmrl_data import CheckpointError, TrainingError, canonical_json, open_dataset, parse_json


@dataclass(frozen=True)
class FinishedRun:
    """A result, and the folder of the run that it came from, which may be gone.

    Attributes:
        result: the document.
        folder: the run's, with its checkpoints.
    """

    result: RunResult
    folder: Path


@dataclass(frozen=True)
class Source:
    """One experiment and its finished runs, by environment, method and seed.

    Attributes:
        experiment: the file.
        runs: finished.
        missing: the file's other runs, and why they failed where they did.
    """

    experiment: Experiment
    runs: tuple[FinishedRun, ...]
    missing: tuple[str, ...] = ()

    def environments(self) -> list[str]:
        """Those with finished runs."""
        return list(dict.fromkeys(each.result.environment for each in self.runs))

    def of(self, environment: str) -> list[FinishedRun]:
        """Its finished runs."""
        return [each for each in self.runs if each.result.environment == environment]


def read_sources(
    paths: Sequence[Path], report: Callable[[str, int, int], None], *, datasets: Sequence[Path] = ()
) -> list[Source]:
    """Results folders in the order given, then one source of all run folders, which are evaluated here.

    Args:
        paths: the folders.
        report: called as run folders are evaluated.
        datasets: folders of datasets that have moved since the runs were trained on them.

    Raises:
        CheckpointError: neither kind of folder, no finished run in it, or a dataset of none of the runs.
    """
    places = {open_dataset(folder).manifest.root: str(folder.resolve()) for folder in datasets}
    sources, runs = [], []
    for path in paths:
        if (path / "experiment.json").is_file():
            sources.append(_results_folder(path, places))
        elif (path / "run.json").is_file():
            runs.append(open_run(path))
        else:
            raise CheckpointError(
                f"{path} has neither experiment.json nor run.json; name a folder that `tcmrl experiment` or "
                "`tcmrl train` made"
            )
    if runs:
        sources.append(_single_runs(runs, report, places))
    used = {run.result.root for source in sources for run in source.runs}
    for root, place in places.items():
        if root not in used:
            raise CheckpointError(
                f"--dataset {place} has root {root[:12]}, which no run was trained on; leave it out"
            )
    return sources


def _at_home(result: RunResult, places: Mapping[str, str]) -> RunResult:
    """A result that says where its dataset lies now."""
    return result.model_copy(update={"dataset": places.get(result.root, result.dataset)})


def _results_folder(path: Path, places: Mapping[str, str]) -> Source:
    file = path / "experiment.json"
    try:
        tables = parse_json(file.read_bytes())
    except ValueError as error:
        raise CheckpointError(f"{file}: {error}; run `tcmrl experiment` again, which writes it") from None
    if not isinstance(tables, dict):
        raise TrainingError(f"{file} is no experiment; run `tcmrl experiment` again, which writes it")
    experiment = read_experiment(tables, place=str(file))
    found = [
        FinishedRun(
            _at_home(result, places), path / "runs" / run_id(result.environment, result.method, result.seed)
        )
        for result in read_results(path, experiment)
    ]
    if not found:
        raise CheckpointError(f"{path} holds no finished run yet; `tcmrl experiment` goes on with them")
    return Source(experiment, tuple(found), _missing(path, experiment))


def _missing(path: Path, experiment: Experiment) -> tuple[str, ...]:
    found = []
    for environment, method, seed in itertools.product(
        experiment.environments, experiment.methods, experiment.seeds
    ):
        name = run_id(environment, method, seed)
        if not result_file(path / "runs" / name).is_file():
            error = error_file(path / "runs" / name)
            reason = f" ({error.read_text(encoding='utf-8').strip()})" if error.is_file() else ""
            found.append(f"`{name}`{reason}")
    return tuple(found)


def _single_runs(
    runs: Sequence[Run], report: Callable[[str, int, int], None], places: Mapping[str, str]
) -> Source:
    """Runs as if an experiment had made them; those of one algorithm count as seeds of one method."""
    labels = labels_of(runs)
    experiment = read_experiment(
        {
            "schema": 1,
            "name": "runs",
            "title": "Single runs",
            "source": "none",
            "seeds": sorted({run.record.seed for run in runs}),
            "environments": {run.record.environment: {} for run in runs},
            "methods": {
                label: {"algorithm": run.record.config.settings.run.algorithm}
                for label, run in zip(labels, runs, strict=True)
            },
        },
        place="the run folders",
    )
    found = []
    for done, (label, run) in enumerate(zip(labels, runs, strict=True)):
        report("evaluating", done, len(runs))
        found.append(FinishedRun(_evaluated(label, run, places.get(run.record.root)), run.folder))
    report("evaluating", len(runs), len(runs))
    order = list(experiment.methods)
    key = [(each.result.environment, order.index(each.result.method), each.result.seed) for each in found]
    return Source(
        experiment, tuple(each for _, each in sorted(zip(key, found, strict=True), key=lambda x: x[0]))
    )


def labels_of(runs: Sequence[Run]) -> list[str]:
    """The algorithm where seeds alone tell its runs on an environment apart, else the folder's name too."""
    groups: dict[tuple[str, str], list[Run]] = {}
    names = [run.record.config.settings.run.algorithm for run in runs]
    for name, run in zip(names, runs, strict=True):
        groups.setdefault((name, run.record.environment), []).append(run)
    mixed = {name for (name, _), group in groups.items() if not _are_seeds(group)}
    return [
        f"{name} {run.folder.name}" if name in mixed else name for name, run in zip(names, runs, strict=True)
    ]


def _are_seeds(runs: Sequence[Run]) -> bool:
    """Whether runs have all in common but their seeds."""
    kinds = {
        (canonical_json(run.record.config.model_dump(mode="json")), run.record.root, run.newest().step)
        for run in runs
    }
    return len(kinds) == 1 and len({run.record.seed for run in runs}) == len(runs)


def _evaluated(label: str, run: Run, place: str | None) -> RunResult:
    record = run.record
    documents = {
        name: evaluate_run(run.folder, protocol=name, dataset_path=place).to_json()
        for name in PROTOCOLS.working()
    }
    return RunResult(
        experiment="runs",
        method=label,
        algorithm=record.config.settings.run.algorithm,
        privileged=record.privileged,
        environment=record.environment,
        seed=record.seed,
        profile=record.profile,
        dataset=place or record.dataset,
        root=record.root,
        steps=run.newest().step,
        device=record.device,
        threads=record.config.settings.run.threads,
        identity={},
        config=record.config,
        versions=record.versions,
        digest=tensors_digest(run.newest().tensors()),
        curve=(),
        evaluations=documents,
        training_seconds=None,
        evaluation_seconds=None,
        peak_memory=None,
    )
