"""Writer and reader agree on datasets as large as the limits allow; their parts are made up."""

import json
import random
from pathlib import Path

import pytest
from tcmrl_cli.data import data

from benchmarks._generated import plan_many, write_many
from tcmrl_data import open_dataset
from tcmrl_data.store.tables import MAX_PARTS, MAX_TASKS, PartKey
from tests.commands import in_process


@pytest.mark.parametrize(
    ("num_tasks", "snapshots"),
    [
        (263, 100),
        pytest.param(1_000, 100, marks=pytest.mark.check),
        pytest.param(MAX_PARTS // 100, 100, marks=pytest.mark.exhaustive),
        pytest.param(MAX_TASKS, MAX_PARTS // MAX_TASKS, marks=pytest.mark.exhaustive),
    ],
)
def test_what_is_written_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], num_tasks: int, snapshots: int
) -> None:
    call = in_process(data, capsys)
    plan = plan_many(num_tasks, snapshots)
    plan.check_limits()
    folder, num_parts = tmp_path / "many", num_tasks * snapshots
    written = write_many(folder, plan, num_tasks=num_tasks)
    dataset = open_dataset(folder)
    assert (len(dataset.tasks), len(dataset.parts)) == (num_tasks, num_parts)
    assert (dataset.parts.root, dataset.manifest.complete) == (written.root, True)
    steps = plan.source.steps
    for task in [0, num_tasks - 1, *random.Random(0).sample(range(num_tasks), 50)]:
        key = PartKey(task, steps[task % snapshots])
        assert dataset.entry(key) == written.entry(key)
        assert (dataset.snapshots(task), dataset.missing(task)) == (list(steps), [])
    assert PartKey(num_tasks, steps[0]) not in dataset.parts
    (row,) = json.loads(call("list", tmp_path, "--json")[1])["datasets"]
    status = json.loads(call("show", folder, "--json")[1])["build"]
    assert (row["tasks"], row["parts"], row["root"]) == (num_tasks, num_parts, written.root)
    assert (status["parts_done"], status["parts_total"], status["complete"]) == (num_parts, num_parts, True)
    tables = json.loads(call("inspect", "returns", folder, "--json")[1])["tasks"]
    assert [len(table["snapshots"]) for table in tables] == [snapshots] * num_tasks
    assert tables[-1]["snapshots"][-1]["mean"] == written.columns["mean"][-1]
