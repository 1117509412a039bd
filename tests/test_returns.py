import pytest

from tcmrl_data import Dataset
from tcmrl_data.dataset.listing import (
    list_episodes,
    list_snapshots,
    list_tasks,
    summarize_returns,
)
from tcmrl_data.foundation.errors import SelectionError, TaskError


def snapshot(step: int, mean: float, success: float | None = None) -> dict[str, object]:
    return {
        "step": step,
        "episodes": 2,
        "steps": 10,
        "mean": mean,
        "std": 0.5,
        "min": mean - 1.0,
        "max": mean + 1.0,
        "success_rate": success,
    }


def table(success: float | None = None) -> dict[str, object]:
    return {
        "name": "example",
        "environment": "example",
        "tasks": [
            {
                "task": 0,
                "split": "train",
                "snapshots": [snapshot(0, 1.0, success), snapshot(10, 4.0, success)],
            },
            {"task": 1, "split": "test", "snapshots": [snapshot(0, -7.0, success)]},
            {
                "task": 2,
                "split": "train",
                "snapshots": [snapshot(0, 3.0, success), snapshot(10, 8.0, success)],
            },
        ],
    }


def test_summary_is_over_tasks_with_splits_apart() -> None:
    assert summarize_returns(table()) == [
        {
            "step": 0,
            "split": "train",
            "tasks": 2,
            "episodes": 4,
            "mean": 2.0,
            "std": 1.0,
            "min": 1.0,
            "max": 3.0,
            "success_rate": None,
        },
        {
            "step": 0,
            "split": "test",
            "tasks": 1,
            "episodes": 2,
            "mean": -7.0,
            "std": 0.0,
            "min": -7.0,
            "max": -7.0,
            "success_rate": None,
        },
        {
            "step": 10,
            "split": "train",
            "tasks": 2,
            "episodes": 4,
            "mean": 6.0,
            "std": 2.0,
            "min": 4.0,
            "max": 8.0,
            "success_rate": None,
        },
    ]
    assert {row["success_rate"] for row in summarize_returns(table(0.25))} == {0.25}


def test_snapshot_and_task_tables_cover_the_dataset(tiny: Dataset) -> None:
    rows = list_snapshots(tiny)["snapshots"]
    assert [(row["task"], row["step"], row["run"]) for row in rows] == list(tiny.parts)
    assert [row["task"] for row in list_tasks(tiny)["tasks"]] == [task.index for task in tiny.tasks]


def test_episode_table_refuses_what_is_not_there(tiny: Dataset) -> None:
    with pytest.raises(TaskError, match="no task 7"):
        list_episodes(tiny, task=7)
    with pytest.raises(SelectionError, match=r"step 77.*\[0, 100, 150\]"):
        list_episodes(tiny, step=77)
