"""Results as they are committed: all that a report needs, small, and without paths of a machine."""

from pathlib import Path
from typing import Any

from tcmrl_algo.experiment.results import RunResult
from tcmrl_data.foundation.disk import make_folders, replace_file

DIGITS = 6
"""Significant digits of a float; reports print four."""


def compact(result: RunResult) -> RunResult:
    """A result with rounded numbers, and without what only the continuation of an experiment needs.

    The dataset is named by its root alone, and lists of single test tasks, such as the returns of
    adaptation episodes, are dropped. Reports are computed from such results, so that they are the same
    before and after the results are committed. The compact form of a compact result is itself.
    """
    document = result.model_dump(mode="json")
    evaluations = {
        protocol: evaluation
        | {
            "tasks": [
                {key: value for key, value in task.items() if not isinstance(value, list)}
                for task in evaluation["tasks"]
            ]
        }
        for protocol, evaluation in document["evaluations"].items()
    }
    numbers = rounded({key: value for key, value in document.items() if key != "config"})
    changes = {"dataset": "", "identity": {}, "evaluations": rounded(evaluations)}
    return RunResult.model_validate(numbers | changes | {"config": document["config"]})


def write_compact(folder: Path, name: str, result: RunResult) -> Path:
    """Writes a compact result as `runs/NAME.json` of a folder; the file."""
    file = folder / "runs" / f"{name}.json"
    make_folders(file.parent)
    replace_file(file, f"{result.model_dump_json()}\n".encode())  # in the order of its protocols
    return file


def rounded(value: Any) -> Any:
    """A JSON value with every float in it rounded to DIGITS significant digits."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    return [rounded(item) for item in value] if isinstance(value, list) else value
