"""The card of a dataset: front matter that parses, facts of the dataset, and text of people that stays."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import Dataset
from tcmrl_data.describe.card import BEGIN, END, dataset_card
from tcmrl_data.foundation.records import parse_json, sealed
from tcmrl_data.quality.scores import measure_quality
from tcmrl_data.store.manifest import MANIFEST
from tests.commands import Call, assert_refused, in_process

Copy = Callable[[], Path]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str]) -> Call:
    return in_process(data, capsys)


def front_matter(card: str) -> dict[str, Any]:
    nothing, matter, _ = card.split("---\n", 2)
    assert nothing == ""
    found: dict[str, Any] = yaml.safe_load(matter)
    return found


def changed(folder: Path, change: Callable[[dict[str, Any]], None]) -> Dataset:
    """A dataset whose manifest was changed and sealed again."""
    fields = parse_json((folder / MANIFEST).read_bytes())
    del fields["digest"]
    change(fields)
    (folder / MANIFEST).write_bytes(sealed(fields))
    return tcmrl_data.open_dataset(folder)


def test_the_card_says_what_the_dataset_is(call: Call, tiny: Dataset) -> None:
    code, card, _ = call("card", tiny.folder)
    assert code == 0
    assert front_matter(card) == {
        "pretty_name": "point-robot",
        "license": "mit",
        "task_categories": ["reinforcement-learning"],
        "tags": ["offline-reinforcement-learning", "meta-reinforcement-learning", "tcmrl", "point-robot"],
        "size_categories": ["1K<n<10K"],
    }
    for text in (
        "| tasks | 5 (4 training, 1 test) |",
        "| parts | 15 of 15 |",
        "| episodes | 90 with 1,800 steps |",
        f"| root | `{tiny.manifest.root}` |",
        "| main | built | sac | 0 |",
        f"@misc{{point-robot-{tiny.manifest.root[:12]},",
        "## Licence\n\nMIT.\n",
    ):
        assert text in card, text
    assert "## How to build it again" not in card  # its recipe was overridden


def test_returns_tiers_and_quality_are_those_of_the_inspections(tiny: Dataset) -> None:
    card = dataset_card(tiny)
    found = tcmrl_data.list_returns(tiny)["tasks"]
    means = [part["mean"] for task in found if task["split"] == "test" for part in task["snapshots"]]
    stages = [stage for stage in measure_quality(tiny).stages if stage.split == "test"]
    rows = [line for line in card.splitlines() if "| test | 1 |" in line]
    assert len(rows) == len(means) == len(stages) == 3
    for row, mean, stage in zip(rows, means, stages, strict=True):
        assert stage.tq is not None
        assert f"| {mean:,.2f} | 0.00 |" in row and row.endswith(f"| {stage.tq.iqm:,.2f} |")
    assert "| `random` | 5 of 5 | 5 |" in card


def test_the_python_of_a_card_runs(tiny: Dataset) -> None:
    code = dataset_card(tiny).split("```python\n")[1].split("```")[0]
    names: dict[str, Any] = {}
    exec(code.replace("FOLDER", str(tiny.folder)), names)
    assert len(names["actions"]) == len(names["observations"]) - 1 == 20


def test_text_between_the_marks_stays_and_all_else_is_written_anew(
    call: Call, tiny_copy: Copy, tiny: Dataset
) -> None:
    folder = tiny_copy()
    readme = folder / "README.md"
    assert call("card", folder, "--out", readme)[:2] == (0, f"{readme} written\n")
    assert readme.read_text() == dataset_card(tiny)
    readme.write_text(
        readme.read_text().replace(f"{BEGIN}\n", f"{BEGIN}\nMine: é\n\n- a\n").replace("MIT", "X")
    )
    assert call("card", folder, "--out", readme, "--quiet")[2] == ""
    assert readme.read_text() == dataset_card(tiny, kept="Mine: é\n\n- a")
    assert call("card", folder, "--out", readme, "--quiet")[0] == 0
    assert readme.read_text() == dataset_card(tiny, kept="Mine: é\n\n- a")
    assert tcmrl_data.verify_dataset(folder, level="quick").findings == ()


@pytest.mark.parametrize("text", ["# mine\n", BEGIN, f"{END}\n{BEGIN}", f"{BEGIN}{END}{BEGIN}{END}", "\xff"])
def test_a_readme_that_would_be_lost_is_refused(call: Call, tiny: Dataset, tmp_path: Path, text: str) -> None:
    readme = tmp_path / "README.md"
    readme.write_text(text, encoding="latin-1")
    assert_refused(call("card", tiny.folder, "--out", readme), str(readme), "by --out")
    assert readme.read_text(encoding="latin-1") == text


def test_a_stranger_cannot_break_out_of_the_card(tiny_copy: Copy) -> None:
    def change(fields: dict[str, Any]) -> None:
        fields["label"] = "---\nlicense: mit\n# x: |"
        for run in fields["runs"]:
            run["recipe"]["about"] |= {
                "description": f"a|b <script>\n\n# not a heading {END}",
                "licence": "my: terms",
                "citation": "```",
            }

    card = dataset_card(changed(tiny_copy(), change))
    assert front_matter(card)["license_name"] == "my: terms"
    assert front_matter(card)["pretty_name"] == "--- license: mit # x: |"
    assert "<script>" not in card and card.count(END) == 1
    assert card.count("\n# ") == 1 and card.count("```") % 2 == 0


def test_licences_of_a_merge_are_all_listed(tiny_copy: Copy) -> None:
    def change(fields: dict[str, Any]) -> None:
        fields["runs"][0]["recipe"]["about"]["licence"] = "CC-BY-4.0 AND MIT"

    card = dataset_card(changed(tiny_copy(), change))
    assert front_matter(card)["license"] == ["cc-by-4.0", "mit"]
    assert "different licences, all of which apply: CC-BY-4.0, MIT." in card


def test_an_imported_dataset_says_what_is_not_known(tiny: Dataset, tmp_path: Path) -> None:
    files = tcmrl_data.export_dataset(tiny, "hdf5", tmp_path / "hdf5", tasks=[0]).files
    tcmrl_data.import_dataset("hdf5", files, tmp_path / "imported")
    card = dataset_card(tcmrl_data.open_dataset(tmp_path / "imported"))
    assert front_matter(card)["license"] == "other"
    for text in ("No seed is known", "they hold no policies", "No returns of uniform actions"):
        assert text in card


def test_the_viewers_files_are_named_and_hold_their_splits(call: Call, tiny_copy: Copy) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    dataset = tcmrl_data.open_dataset(tiny_copy())
    for _ in range(2):  # a second time the transitions stay
        code, output, _ = call("card", dataset.folder, "--viewer")
        assert (code, output) == (0, f"{dataset.folder / 'README.md'} written\n")
    assert 'load_dataset("FOLDER", "transitions")' in (dataset.folder / "README.md").read_text()
    rows = {"transitions": 360, "episodes": 18, "parts": 3, "tasks": 1}
    configs = front_matter((dataset.folder / "README.md").read_text())["configs"]
    assert [config["config_name"] for config in configs] == list(rows)
    for config in configs:
        assert [files["split"] for files in config["data_files"]] == ["train", "test"]
        for files, tasks in zip(config["data_files"], (dataset.train_tasks, dataset.test_tasks), strict=True):
            tables = [parquet.read_table(file) for file in sorted(dataset.folder.glob(files["path"]))]
            assert sum(map(len, tables)) == rows[config["config_name"]] * len(tasks)
            found = {task for table in tables for task in table.column("task").to_pylist()}
            assert found == {task.index for task in tasks}
    episodes = parquet.read_table(dataset.folder / "viewer/test/episodes.parquet").to_pylist()
    for row, episode in zip(episodes, dataset.select(tasks=[3]).trajectories(3), strict=True):
        assert row["length"] == len(episode)
        assert row["return"] == pytest.approx(episode.undiscounted_return)
        assert (row["terminated"], row["truncated"]) == (episode.terminated[-1], episode.truncated[-1])
    parts = parquet.read_schema(dataset.folder / "viewer/test/parts.parquet")
    assert str(parts.field("success_rate").type) == "double"
    assert tcmrl_data.verify_dataset(dataset.folder).findings == ()
    assert tcmrl_data.delete_dataset(dataset.folder).kept == ("README.md",)


def test_a_viewer_of_other_data_stays(call: Call, tiny: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    view = tmp_path / "view.json"
    tcmrl_data.derive_dataset(tiny, view=view, tasks=[0], snapshots="last")
    assert_refused(call("card", view, "--viewer"), "name a README.md by --out")
    assert_refused(call("card", view, "--viewer", "--format", "cff"), "--viewer belongs to the README")
    assert call("card", view, "--viewer", "--out", tmp_path / "README.md")[0] == 0
    assert len(front_matter((tmp_path / "README.md").read_text())["configs"][0]["data_files"]) == 1
    assert_refused(
        call("card", tiny.folder, "--viewer", "--out", tmp_path / "README.md"), "of other data; remove it"
    )
