"""Croissant: validated, and its records streamed, by the library of the format's authors."""

import itertools
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import Dataset
from tcmrl_data.building.work_files import CROISSANT, CROISSANT_FILES, CROISSANT_PARTS
from tcmrl_data.describe.croissant import PART_FIELDS, write_croissant
from tcmrl_data.foundation.records import sha256
from tests.commands import in_process

Copy = Callable[[], Path]


def opened(file: Path) -> Any:
    """What mlcroissant reads of a file; it refuses one that is not valid."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its own dependencies
        import mlcroissant

        return mlcroissant.Dataset(jsonld=file)


def records(croissant: Any, name: str) -> list[dict[str, Any]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = list(itertools.islice(croissant.records(name), 100))
    text = lambda value: value.decode() if isinstance(value, bytes) else value  # noqa: E731
    return [{key.partition("/")[2]: text(value) for key, value in row.items()} for row in rows]


def test_croissant_validates_and_its_records_are_the_tables(tiny_copy: Copy) -> None:
    dataset = tcmrl_data.open_dataset(tiny_copy())
    croissant = opened(write_croissant(dataset))
    assert not croissant.metadata.ctx.issues.errors
    tasks = records(croissant, "tasks")
    assert [(row["index"], row["split"]) for row in tasks] == [(t.index, t.split) for t in dataset.tasks]
    assert [json.loads(row["parameters"]) for row in tasks] == [
        dict(task.parameters) for task in dataset.tasks
    ]
    parts = records(croissant, "parts")
    entries = list(dataset.parts.entries())
    assert len(parts) == len(entries) == 15
    for row, entry in zip(parts, entries, strict=True):
        assert set(row) == set(PART_FIELDS)
        assert (row["task"], row["step"], row["id"]) == (entry.task, entry.step, entry.id)
        assert row["mean"] == pytest.approx(entry.mean)
        assert sha256((dataset.folder / row["file"]).read_bytes()) == row["sha256"]


def test_croissant_beside_a_dataset_is_no_finding_and_goes_with_it(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    write_croissant(tcmrl_data.open_dataset(folder))
    (folder / "README.md").write_text("mine")
    assert tcmrl_data.verify_dataset(folder, level="quick").findings == ()
    deletion = tcmrl_data.delete_dataset(folder)
    assert deletion.kept == ("README.md",)
    assert [file.name for file in folder.iterdir()] == ["README.md"]


def test_the_document_names_licence_authors_and_digests(tiny: Dataset, tmp_path: Path) -> None:
    file = write_croissant(tiny, tmp_path / "new")
    document = json.loads(file.read_text(encoding="utf-8"))
    assert {found.name for found in file.parent.iterdir()} == CROISSANT_FILES
    assert document["license"] == ["https://spdx.org/licenses/MIT.html"]
    assert document["creator"] == [{"@type": "sc:Organization", "name": "the tcmrl authors"}]
    assert tiny.manifest.root[:12] in document["version"] and "@misc{" in document["citeAs"]
    digests = {part["@id"]: part.get("sha256") for part in document["distribution"]}
    assert digests[CROISSANT_PARTS] == sha256((file.parent / CROISSANT_PARTS).read_bytes())
    assert digests["manifest.json"] == sha256((tiny.folder / "manifest.json").read_bytes())


def test_a_view_needs_a_folder_of_its_own(
    tiny: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    view = tmp_path / "view.json"
    tcmrl_data.derive_dataset(tiny, view=view, tasks=[0, 3], snapshots="last")
    call = in_process(data, capsys)
    code, _, errors = call("card", view, "--format", "croissant")
    assert (code, errors.count("\n")) == (2, 1) and "--out" in errors
    assert not (tiny.folder / CROISSANT).exists()
    code, output, _ = call("card", view, "--format", "croissant", "--out", tmp_path / "c")
    assert code == 0 and output == f"{tmp_path / 'c' / CROISSANT}: 2 tasks, 2 parts\n"
