"""`tcmrl-data report`: numbers as `inspect` prints them, texts of strangers, and what is refused."""

import base64
import dataclasses
import html
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import Dataset
from tcmrl_data.dataset.listing import list_episodes
from tcmrl_data.describe import measures
from tcmrl_data.describe.measures import ACTION_BINS, SATURATED, Content, choose_plane, measure
from tcmrl_data.describe.report import report_html
from tcmrl_data.foundation.page import cell_text
from tcmrl_data.quality.worth import context_worth
from tcmrl_data.store.tables import PartKey
from tests.commands import assert_refused, in_process

pytest.importorskip("plotly", reason="plotly is not installed: pip install 'tcmrl[report]'")
from tcmrl_data.describe import figures

HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)> %{x}"
CODES = {"f4": "<f4", "f8": "<f8", "i1": "i1", "i2": "<i2", "i4": "<i4", "u1": "u1", "u2": "<u2", "u4": "<u4"}


@pytest.fixture(scope="module")
def content(tiny: Dataset) -> Content:
    return measure(tiny, browsed=4)


@pytest.fixture(scope="module")
def page(content: Content) -> str:
    return report_html(content)


def all_arrays(dataset: Dataset) -> list[tuple[PartKey, dict[str, Any]]]:
    return [
        (key, dataset.arrays(*key)) for task in dataset.tasks for key in dataset.parts.keys_of(task.index)
    ]


def frames_of(page: str, name: str) -> list[dict[str, Any]]:
    """What the page's script draws in a figure, frame by frame."""
    return document_of(page, name)["frames"]  # type: ignore[no-any-return]


def document_of(page: str, name: str) -> dict[str, Any]:
    _, figure = page.split(f'<figure class="interactive" id="{name}">')
    found: dict[str, Any] = json.loads(
        figure.split('<script type="application/json">', 1)[1].partition("</script>")[0]
    )
    return found


def numbers(spec: dict[str, Any]) -> Any:
    """An array as plotly.js reads it."""
    array = np.frombuffer(base64.b64decode(spec["bdata"]), CODES[spec["dtype"]])
    return array.reshape([int(size) for size in spec["shape"].split(",")]) if "shape" in spec else array


def test_curves_are_the_numbers_of_inspect(page: str, tiny: Dataset) -> None:
    (frame,) = frames_of(page, "learning-curves")
    drawn = {
        trace["hovertemplate"].split("<extra>")[1].removesuffix("</extra>"): [
            numbers(trace[axis]).tolist() for axis in ("x", "y")
        ]
        for trace in frame["traces"]
        if "legendgroup" in trace
    }
    assert drawn == {
        f"task {task['task']} ({task['split']})": [
            [found["step"] for found in task["snapshots"]],
            [found["mean"] for found in task["snapshots"]],
        ]
        for task in tcmrl_data.list_returns(tiny)["tasks"]
    }


def test_tables_are_the_numbers_of_inspect(
    page: str, tiny: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    call = in_process(data, capsys)
    tasks = json.loads(call("inspect", "tasks", tiny.folder, "--json")[1])
    for row in tasks["tasks"]:
        cells = [row["task"], row["split"], *(row["references"][name] for name in ("uniform", "oracle"))]
        assert "".join(f">{cell_text(cell)}</td>" for cell in cells) in page.replace("<td", "").replace(
            ' class="text"', ""
        )
    for difference in tasks["shift"]:
        assert f">{cell_text(difference['standardized'])}</td>" in page
    assert tiny.manifest.root in page
    assert tiny.manifest.digest in page


def test_measures_are_the_records_of_inspect(
    page: str, content: Content, tiny: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    call = in_process(data, capsys)
    for name, record in (
        ("quality", content.quality),
        ("coverage", content.coverage),
        ("rewards", content.rewards),
    ):
        assert json.loads(call("inspect", name, tiny.folder, "--json")[1]) == record.model_dump(mode="json")
    cells, overlap = (numbers(frames_of(page, name)[0]["traces"][0]["z"]) for name in ("scores", "overlap"))
    expected = [[snapshot.tq for snapshot in task.snapshots] for task in content.quality.tasks]
    assert cells == pytest.approx(np.array(expected, np.float32))
    assert overlap == pytest.approx(np.array(content.coverage.overlap.shares, np.float32))
    shares = np.array(content.coverage.overlap.shares)
    others = shares[~np.eye(len(shares), dtype=bool)].mean()
    assert f"Tasks share {others:.0%} of their states" in page


def test_no_histogram_is_empty(page: str, content: Content) -> None:
    """Every bar chart has the shares of all values, inside the axes that are drawn."""
    for name, kind in (("returns", "bar"), ("rewards", "bar"), ("actions", "scatter")):
        document = document_of(page, name)
        low, high = document["layout"]["xaxis"]["range"]
        assert len(document["frames"]) == len(content.summary["snapshots"])
        for frame in document["frames"]:
            assert frame["traces"], (name, frame["label"])
            for trace in frame["traces"]:
                x, y = numbers(trace["x"]), numbers(trace["y"])
                assert trace["type"] == kind and len(x) == len(y) > 1
                assert y.sum() == pytest.approx(1.0)
                assert ((x >= low) & (x <= high)).all()
                assert y.max() <= document["layout"]["yaxis"].get("range", [0.0, 1.0])[1]


def test_visits_count_every_state_in_the_plane(content: Content, tiny: Dataset) -> None:
    arrays = all_arrays(tiny)
    assert content.visits.total == sum(len(found["observations"]) for _, found in arrays)
    inside = sum(int(counts.sum()) for counts in content.visits.counts.values())
    assert (content.visits.outside, inside) == (
        0,
        content.visits.total,
    )  # every part was sampled for the borders
    plane = content.plane
    assert (plane.names, plane.explained) == (("x", "y"), None)
    task = tiny.tasks[0].index
    states = np.concatenate([found["observations"] for key, found in arrays if key.task == task])
    edges = [np.linspace(plane.low[axis], plane.high[axis], 33) for axis in (1, 0)]
    expected = np.histogram2d(states[:, 1], states[:, 0], edges)[0]
    assert np.abs(content.visits.counts[task] - expected).sum() <= 4  # a state on a border


def test_actions_and_endings_are_those_of_the_episodes(content: Content, tiny: Dataset) -> None:
    last = max(content.actions.counts)
    own = np.concatenate([found["actions"] for key, found in all_arrays(tiny) if key.step == last])
    expected = [
        np.histogram(np.clip(column, -1, 1), np.linspace(-1, 1, ACTION_BINS + 1))[0] for column in own.T
    ]
    assert np.abs(content.actions.counts[last] - expected).sum() <= 8
    assert content.actions.saturated_share(last) == (np.abs(own) >= SATURATED).mean()
    rows = [row for row in list_episodes(tiny)["episodes"] if row["step"] == last]
    found = content.endings.by_step[last]
    assert (found.episodes, found.steps) == (len(rows), sum(row["length"] for row in rows))
    assert (found.terminated, found.truncated) == (0, len(rows))
    returns = np.histogram([row["return"] for row in rows], content.endings.edges)[0]
    assert found.returns.tolist() == returns.tolist()


def test_browsed_episodes_are_the_stored_ones(content: Content, tiny: Dataset) -> None:
    assert len(content.browsed) == 4
    for found in content.browsed:
        stored = tiny.trajectories(*found.key)[found.number]
        assert (found.rewards == stored.rewards).all()
        assert (found.observations == stored.observations[:-1]).all()
        assert (found.actions == stored.actions).all()
        assert found.ended == "truncated"
    assert [found.key for found in content.browsed][0::3] == [(0, 0, "main"), (99, 150, "main")]


def test_paths_are_cut_between_episodes(content: Content, tiny: Dataset) -> None:
    key = PartKey(0, 150)
    states = [trajectory.observations for trajectory in tiny.trajectories(*key)[:3]]
    gap = np.full((1, 2), np.nan, np.float32)
    expected = np.concatenate([row for path in states for row in (path, gap)])
    assert np.array_equal(content.paths.found[key], expected, equal_nan=True)


def test_without_named_columns_the_plane_keeps_most_variance(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(tiny.environment), "plane", None)
    plane = choose_plane(tiny, [key for key, _ in all_arrays(tiny)])
    assert plane.explained == pytest.approx(1.0)  # of two columns
    states = np.concatenate([plane.project(found["observations"]) for _, found in all_arrays(tiny)])
    assert np.cov(states.T)[0, 1] == pytest.approx(0.0, abs=1e-9)
    assert (states > plane.low).all()
    assert (states < plane.high).all()


@pytest.mark.check
def test_of_many_tasks_some_are_drawn(
    content: Content, tiny: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measures, "SHOWN_TASKS", 2)
    few = measure(tiny, browsed=1)
    assert [task.index for task in few.shown] == [0, 99]
    assert sorted(few.visits.counts) == [0, 99]
    assert sum(found.episodes for found in few.endings.by_step.values()) == tiny.manifest.totals.episodes
    text = report_html(few)
    assert "2 evenly chosen tasks are shown, 3 others are not." in text
    labels = [trace["hovertemplate"] for trace in frames_of(text, "learning-curves")[0]["traces"]]
    for task in tiny.tasks:
        is_shown = task.index in (0, 99)
        assert any(f"task {task.index} (" in label for label in labels) == is_shown


@pytest.mark.check
def test_a_hostile_label_stays_text(tiny_copy: Callable[[], Path], tmp_path: Path) -> None:
    folder = tiny_copy()
    tcmrl_data.derive_dataset(folder, tmp_path / "half", tasks=[0])
    tcmrl_data.merge_datasets([tmp_path / "half", folder], tmp_path / "merged", names=["half", "whole"])
    tcmrl_data.rename_dataset(tmp_path / "merged", HOSTILE)
    content = measure(tcmrl_data.open_dataset(tmp_path / "merged"), browsed=2)
    named = dataclasses.replace(content, plane=dataclasses.replace(content.plane, names=(HOSTILE, HOSTILE)))
    text = report_html(named)
    assert "<img src=x" not in text
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    # plotly.js reads tags in every text, and decodes these
    titles = [document_of(text, "visits")["layout"][axis]["title"]["text"] for axis in ("xaxis", "yaxis")]
    assert [html.unescape(title) for title in titles] == [HOSTILE, HOSTILE]
    assert not re.search("[<>]", "".join(titles))


def test_no_label_is_a_template_of_plotly(page: str) -> None:
    trace = figures._line(np.arange(2), np.arange(2), HOSTILE)
    label = trace.hovertemplate.split("<extra>")[1].removesuffix("</extra>")
    assert "%{" not in label and "<" not in label and html.unescape(label) == html.unescape(trace.name)


def test_the_command_writes_one_file(
    tiny_copy: Callable[[], Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    call, folder = in_process(data, capsys), tiny_copy()
    code, output, errors = call("report", folder, "--json", "--episodes", 2)
    file = folder.with_name(f"{folder.name}-report.html")
    assert (code, json.loads(output)) == (0, {"report": str(file), "bytes": file.stat().st_size})
    file.unlink()
    code, output, errors = call("report", folder, "--out", file, "--quiet")
    assert (code, errors) == (0, "")
    assert output.startswith(f"{file}: written, ")
    assert file.stat().st_size < 6e6
    file.unlink()
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    assert_refused(call("report", folder, "--out", file), "plotly", "pip install 'tcmrl[report]'")
    assert not file.exists()


def test_a_damaged_part_and_an_empty_dataset_are_refused(
    tiny_copy: Callable[[], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call, folder = in_process(data, capsys), tiny_copy()
    part = next((folder / "parts").rglob("*.zip"))
    part.write_bytes(part.read_bytes()[:-1])
    assert_refused(call("report", folder, "--out", tmp_path / "x.html", "--quiet"), str(part), "repair")
    assert not (tmp_path / "x.html").exists()
    assert_refused(call("report", tmp_path), "does not exist")


@pytest.mark.check
def test_policies_in_other_tasks_are_shown_if_asked_for(tiny: Dataset, page: str) -> None:
    found = measure(tiny, browsed=1, transfer=True)
    assert found.transfer == tcmrl_data.measure_transfer(tiny)
    text = report_html(found)
    assert 'id="cross-task-returns"' in text
    _, splits = context_worth(found.transfer)
    assert f"A context is worth {'only ' if splits[-1].worth < 0.1 else ''}{splits[-1].worth:.0%}" in text
    assert 'id="cross-task-returns"' not in page
