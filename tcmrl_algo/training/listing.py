"""Which runs lie below a folder."""

import json
from pathlib import Path
from typing import Any

from tcmrl_algo.training.checkpoint import Run, open_run
from tcmrl_algo.training.metrics import EVALUATIONS
from tcmrl_data import CheckpointError


def list_runs(root: str | Path) -> list[dict[str, Any]]:
    """The runs below a folder, sorted by path; unreadable ones with `error`.

    Returns:
        Rows of `path`, `algorithm`, `environment`, `seed`, `step` of the newest checkpoint (0 without one),
        `steps`, `dataset`, `root` of the dataset, and `evaluation`, the last one or None.
    """
    rows: list[dict[str, Any]] = []
    for file in sorted(Path(root).glob("**/run.json")):
        try:
            rows.append(_row(open_run(file.parent)))
        except CheckpointError as error:
            rows.append({"path": str(file.parent), "error": str(error)})
    return rows


def _row(run: Run) -> dict[str, Any]:
    record, checkpoints = run.record, run.checkpoints()
    return {
        "path": str(run.folder),
        "algorithm": record.config.settings.run.algorithm,
        "environment": record.environment,
        "seed": record.seed,
        "step": checkpoints[-1].step if checkpoints else 0,
        "steps": record.steps,
        "dataset": record.dataset,
        "root": record.root,
        "evaluation": _last_evaluation(run.folder / EVALUATIONS),
    }


def _last_evaluation(file: Path) -> dict[str, Any] | None:
    """The last whole line of a run's evaluations."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    whole = [line for line in lines if line.endswith("}")]
    found: dict[str, Any] | None = json.loads(whole[-1]) if whole else None
    return found
