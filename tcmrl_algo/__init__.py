"""tcmrl_algo meta-trains on datasets of tcmrl_data and adapts to unseen tasks.

This is the whole public API; names load on first use, so that `tcmrl --help` needs no torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tcmrl_algo.adaptation.evaluate import Evaluation, TaskResult, evaluate_run
    from tcmrl_algo.context_methods.learner import ContextAlgorithm
    from tcmrl_algo.experiment.aggregate import Summary, summarize
    from tcmrl_algo.experiment.config import Experiment, experiment_names, load_experiment
    from tcmrl_algo.experiment.driver import ExperimentReport, Finished, run_experiment
    from tcmrl_algo.experiment.results import RunResult
    from tcmrl_algo.methods.problem import Algorithm, Problem
    from tcmrl_algo.reporting.write import Report, write_report
    from tcmrl_algo.settings.training import TrainingSettings
    from tcmrl_algo.training.checkpoint import Run, RunRecord, open_run
    from tcmrl_algo.training.config import TrainingConfig, resolve
    from tcmrl_algo.training.train import Progress, TrainingReport, create_algorithm, resume_run, train_run

_HOMES = {
    "experiment.aggregate": ("Summary", "summarize"),
    "training.checkpoint": ("Run", "RunRecord", "open_run"),
    "settings.training": ("TrainingSettings",),
    "training.config": ("TrainingConfig", "resolve"),
    "context_methods.learner": ("ContextAlgorithm",),
    "adaptation.evaluate": ("Evaluation", "TaskResult", "evaluate_run"),
    "experiment.config": ("Experiment", "experiment_names", "load_experiment"),
    "experiment.driver": ("ExperimentReport", "Finished", "run_experiment"),
    "experiment.results": ("RunResult",),
    "methods.problem": ("Algorithm", "Problem"),
    "reporting.write": ("Report", "write_report"),
    "training.train": ("Progress", "TrainingReport", "create_algorithm", "resume_run", "train_run"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Algorithm",
    "ContextAlgorithm",
    "Evaluation",
    "Experiment",
    "ExperimentReport",
    "Finished",
    "Problem",
    "Progress",
    "Report",
    "Run",
    "RunRecord",
    "RunResult",
    "Summary",
    "TaskResult",
    "TrainingConfig",
    "TrainingReport",
    "TrainingSettings",
    "create_algorithm",
    "evaluate_run",
    "experiment_names",
    "load_experiment",
    "open_run",
    "resolve",
    "resume_run",
    "run_experiment",
    "summarize",
    "train_run",
    "write_report",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'tcmrl_algo' has no attribute {name!r}")
    return getattr(importlib.import_module(f"tcmrl_algo.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
