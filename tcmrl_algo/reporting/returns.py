"""Returns of the datasets that runs were trained on, as a report keeps them (paper, Table 8)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from tcmrl_algo.experiment.results import rounded
from tcmrl_data import Dataset, list_returns


class SnapshotReturns(BaseModel):
    """Mean returns of the stored episodes of one snapshot, over tasks.

    Attributes:
        step: of the snapshot; None for all snapshots together.
        train, test: mean over training and over test tasks; None where there is no such snapshot.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    step: int | None
    train: float | None
    test: float | None


class DatasetReturns(BaseModel):
    """`datasets/ENVIRONMENT.json` of a report: what was stored in the dataset of an environment.

    Attributes:
        environment, root, profile: which dataset.
        train_tasks, test_tasks: number of tasks.
        snapshots: by ascending step, and last all together.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    environment: str
    root: str
    profile: str
    train_tasks: int
    test_tasks: int
    snapshots: tuple[SnapshotReturns, ...]

    @property
    def test_return(self) -> float | None:
        """Mean return of all stored episodes of the test tasks."""
        return self.snapshots[-1].test if self.snapshots else None


def dataset_returns(dataset: Dataset) -> DatasetReturns:
    """Mean returns of the stored episodes of a dataset, over tasks, by snapshot."""
    tasks = list_returns(dataset)["tasks"]
    steps: list[int | None] = sorted({found["step"] for task in tasks for found in task["snapshots"]})
    return DatasetReturns(
        environment=dataset.name,
        root=dataset.manifest.root,
        profile=dataset.manifest.profile,
        train_tasks=len(dataset.train_tasks),
        test_tasks=len(dataset.test_tasks),
        snapshots=tuple(
            SnapshotReturns(step=step, train=_mean(tasks, "train", step), test=_mean(tasks, "test", step))
            for step in (*steps, None)
        ),
    )


def _mean(tasks: Sequence[dict[str, Any]], split: str, step: int | None) -> float | None:
    means = [
        found["mean"]
        for task in tasks
        if task["split"] == split
        for found in task["snapshots"]
        if step in (None, found["step"])
    ]
    mean: float | None = rounded(float(np.mean(means))) if means else None
    return mean
