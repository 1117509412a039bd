"""The table of what the data predict of contexts beside what learning gave."""

from pathlib import Path
from typing import Any

from tcmrl_algo.reporting.pages import Pages
from tcmrl_data import Worth
from tcmrl_data.quality.records import StageVisibility
from tcmrl_data.quality.worth import context_worth
from tests import experiments
from tests.experiments import made_result, write_results
from tests.test_worth import row, transfer_of

ROOT, OTHER = "0" * 64, "1" * 64


def worth_of(root: str) -> Worth:
    """Own 7.5 and single 5.5 of 0 to 10 in training tasks, 9 and 1 of 0 to 20 in the test task."""
    tasks = [row(3, "train"), row(7, "train"), row(9, "test", best=20.0)]
    single, splits = context_worth(transfer_of(tasks, [[8.0, 2.0, 6.0], [4.0, 7.0, 1.0], [9.0, 9.0, 9.0]]))
    stages = [
        StageVisibility(step=step, split="train", tasks=2, rewarded=share, reward=seen, dynamics=0.5)
        for step, share, seen in ((0, 0.0, None), (500, 0.25, 0.75))
    ]
    return Worth(
        label=None,
        environment="point-robot",
        root=root,
        seed=0,
        episodes=1,
        transitions=5,
        neighbours=5,
        left_out=0,
        single_task=single,
        splits=splits,
        stages=tuple(stages),
    )


def evaluations(final: float, reference: str = "oracle") -> dict[str, Any]:
    """Of two test tasks with ranges of 20 and 30, and a training task that does not count."""
    tasks = [
        {"task": 0, "split": "test", "final": final, "oracle": 0.0, "random": -20.0, "reference": reference},
        {"task": 1, "split": "test", "final": final, "oracle": 10.0, "random": -20.0, "reference": reference},
        {"task": 2, "split": "train", "final": final, "oracle": 0.0, "random": -99.0, "reference": reference},
    ]
    return {"offline": {"tasks": tasks, "mean_final": final}}


def page(folder: Path, finals: dict[str, list[float]], *, reference: str = "oracle") -> str:
    """The table of two datasets, on one of which methods were run."""
    (folder / "worth").mkdir(parents=True)
    for name, root in (("here", ROOT), ("elsewhere", OTHER)):
        (folder / "worth" / f"{name}.json").write_text(worth_of(root).model_dump_json())
    content: dict[str, Any] = experiments.tables(folder, seeds=[0, 1])
    results = [
        made_result(
            method,
            seed,
            final,
            root=ROOT,
            algorithm="no_context" if method == "no context" else "tcmrl",
            evaluations=evaluations(final, reference),
        )
        for method, values in finals.items()
        for seed, final in enumerate(values)
    ]
    write_results(folder / "small", content, results)
    (folder / "small" / "report.md").write_text("a report")
    return Pages(folder).rewritten("<!-- worth worth -->\n<!-- end -->\n")


def cells(text: str, dataset: str) -> list[str]:
    (line,) = (line for line in text.splitlines() if line.startswith(f"| {dataset} "))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_predictions_stand_beside_what_learning_gave_on_the_same_root(tmp_path: Path) -> None:
    """TCMRL reaches -5 and the blind learner -15, of a range of 25."""
    text = page(tmp_path, {"TCMRL": [-4.0, -6.0], "no context": [-14.0, -16.0]})
    assert cells(text, "here") == [
        "here",
        "2 + 1",
        "20.0%",
        "40.0%",
        "0.0% → 25.0%",
        "– → 0.75",
        "0.50 → 0.50",
        "[small](results/small/report.md)",
        "offline",
        "-15",
        "-5 (TCMRL)",
        "40.0%",
    ]
    assert cells(text, "elsewhere")[7:] == ["to come", "–", "–", "–", "–"]


def test_without_a_blind_learner_or_a_range_nothing_is_claimed(tmp_path: Path) -> None:
    assert cells(page(tmp_path / "a", {"TCMRL": [-4.0, -6.0]}), "here")[7] == "to come"
    finals = {"TCMRL": [-4.0, -6.0], "no context": [-14.0, -16.0]}
    assert cells(page(tmp_path / "b", finals, reference="stored"), "here")[-1] == "–"
