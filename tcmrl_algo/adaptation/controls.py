"""Controls of a dataset: returns of policies without any learning across tasks, measured once and kept.

A kept file lies in the cache (`tcmrl_data.cache_folder`). Its name is a digest of everything that the returns
are a function of: the dataset's parts and splits, the environment's libraries and this package's versions.
"""

import contextlib
import importlib.metadata
from pathlib import Path

from tcmrl_algo.adaptation.arena import ProgressCallback, ignore_progress
from tcmrl_algo.adaptation.control_bench import TEST_EPISODES, ControlBench
from tcmrl_algo.adaptation.control_records import Controls
from tcmrl_data import Dataset, TrainingError, cache_folder
from tcmrl_data.foundation.canonical import digest
from tcmrl_data.foundation.disk import make_folders
from tcmrl_data.foundation.errors import StorageError
from tcmrl_data.foundation.records import read_record, write_record

PACKAGES = ("numpy", "tcmrl", "torch")
"""Whose versions the returns depend on, beside the environment's own."""


def dataset_controls(dataset: Dataset, *, report: ProgressCallback = ignore_progress) -> Controls:
    """The controls of a dataset, measured if they were not before.

    Where the cache cannot be written they are measured every time.

    Args:
        dataset: with complete test tasks.
        report: called with the stage, the episodes done and their total number.

    Raises:
        TrainingError: the dataset has no training or no test task.
        CheckpointError: the kept file is damaged; the message names it.

    Example:
        >>> dataset_controls(tcmrl_data.open_dataset("data/point-robot")).mean("fixed")  # doctest: +SKIP
    """
    about = _about(dataset)
    file = controls_file(about)
    if file.is_file():
        return read_record(Controls, file, remedy="; delete it, and it is made again")
    measured = measure_controls(dataset, report=report)
    with contextlib.suppress(StorageError, OSError):  # costs time and nothing else
        make_folders(file.parent)
        write_record(file, measured)
    return measured


def controls_file(about: Controls) -> Path:
    """Where controls of this heading are kept."""
    key = digest(about.model_dump(mode="json"))
    return cache_folder() / "controls" / f"{about.environment.replace('/', '-')}-{key[:32]}.json"


def measure_controls(dataset: Dataset, *, report: ProgressCallback = ignore_progress) -> Controls:
    """As `dataset_controls`, without the kept file."""
    if not dataset.train_tasks or not dataset.test_tasks:
        raise TrainingError(f"{dataset.folder} has no training or no test task; build both for controls")
    tests, bench = dataset.test_tasks, ControlBench(dataset, report)
    nothing: list[float | None] = [None] * len(tests)
    try:
        snapshot, policy = bench.fixed_snapshot()
        target = bench.fixed_target()
        by_snapshot = nothing if policy is None else bench.returns(tests, policy, TEST_EPISODES)
        by_target = nothing if target is None else bench.returns(tests, bench.oracle(target), TEST_EPISODES)
        is_target = target and (snapshot is None or target.train_return >= snapshot.train_return)
        fixed = by_target if is_target else by_snapshot
        tasks = [
            bench.task_controls(
                task, fixed_snapshot=snapshot_return, fixed_target=target_return, fixed=better
            )
            for task, snapshot_return, target_return, better in zip(
                tests, by_snapshot, by_target, fixed, strict=True
            )
        ]
    finally:
        bench.close()
    return _about(dataset).model_copy(
        update={"fixed_snapshot": snapshot, "fixed_target": target, "tasks": tuple(tasks)}
    )


def _about(dataset: Dataset) -> Controls:
    """The heading of a dataset's controls: what they are a function of."""
    return Controls(
        environment=dataset.name,
        dataset_root=dataset.manifest.root,
        splits={task.index: task.split for task in dataset.tasks},
        versions={name: importlib.metadata.version(name) for name in PACKAGES},
        fingerprint=dataset.environment.fingerprint(),
    )
