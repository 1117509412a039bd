"""The notebook of `examples/` runs from its first to its last cell."""

import json
import shutil
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

from tests.test_pages_run import demo as demo

NOTEBOOK = Path(__file__).parent.parent / "examples" / "first_hour.ipynb"


@pytest.mark.check
def test_the_notebook_runs_on_the_dataset_of_the_tour(
    demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(demo, tmp_path / "data" / "demo")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] != "code":
            continue
        exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
        if "parameters" in cell["metadata"].get("tags", ()):
            names["STEPS"] = 20  # what a run of two minutes shows is not this test's affair
    plt.close("all")
    assert names["trained"].step == 20
    assert [task.task for task in names["evaluation"].tasks] == [3, 32, 67, 95]
    assert "adapted" in capsys.readouterr().out
    assert (tmp_path / "paths.png").exists()
