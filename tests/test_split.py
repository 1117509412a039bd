"""Folds, splits by episodes, labels."""

import json
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli.data import data

from tcmrl_data import (
    Dataset,
    derive_dataset,
    open_dataset,
    rename_dataset,
    repair_dataset,
    split_dataset,
    verify_dataset,
)
from tcmrl_data.foundation.disk import LOCK, lock_file
from tcmrl_data.foundation.errors import LockedError, ManifestError, SelectionError, StoreError
from tcmrl_data.store.tables import TASKS
from tests.commands import assert_refused, in_process
from tests.graded import graded_dataset


@pytest.fixture(scope="module")
def graded(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return graded_dataset(tmp_path_factory.mktemp("graded") / "data", tasks=range(7))


@pytest.mark.parametrize("views", [False, True])
def test_every_task_is_tested_in_one_fold(graded: Dataset, tmp_path: Path, views: bool) -> None:
    made = split_dataset(graded, tmp_path / "folds", folds=3, seed=1, views=views)
    folds = [open_dataset(report.out) for report in made]
    assert [report.out.name for report in made] == [f"{n}.json" if views else f"{n}" for n in range(3)]
    tested = [task.index for fold in folds for task in fold.test_tasks]
    assert sorted(tested) == list(range(7))
    for fold in folds:
        assert fold.manifest.root == graded.manifest.root
        assert {task.index for task in fold.train_tasks} == set(range(7)) - {
            task.index for task in fold.test_tasks
        }
        assert set(fold.select(split="train").parts) == {task.index for task in fold.train_tasks}
        if not views:
            assert verify_dataset(fold.folder, level="deep").findings == ()
    again = split_dataset(graded, tmp_path / "again", folds=3, seed=1, dry_run=True)
    other = split_dataset(graded, tmp_path / "other", folds=3, seed=2, views=True)
    assert [report.root for report in again] == [None] * 3
    assert open_dataset(other[0].out).test_tasks != folds[0].test_tasks


def test_a_subset_of_a_fold_keeps_its_split(graded: Dataset, tmp_path: Path) -> None:
    for views in (False, True):
        fold = open_dataset(split_dataset(graded, tmp_path / f"{views}", folds=2, views=views)[0].out)
        derive_dataset(fold, tmp_path / f"a{views}", tier="expert")
        derive_dataset(fold, view=tmp_path / f"{views}.json", tier="expert")
        derive_dataset(tmp_path / f"{views}.json", tmp_path / f"b{views}", tasks=range(5))
        for path, number in ((f"a{views}", 7), (f"{views}.json", 7), (f"b{views}", 5)):
            expected = [task for task in fold.test_tasks if task.index < number]
            assert list(open_dataset(tmp_path / path).test_tasks) == expected
        assert verify_dataset(tmp_path / f"b{views}", level="deep").findings == ()


def test_a_damaged_table_of_tasks_comes_back_with_the_fold(graded: Dataset, tmp_path: Path) -> None:
    fold = open_dataset(split_dataset(graded, tmp_path, folds=2)[1].out)
    (fold.folder / TASKS).write_bytes(b"?")
    assert repair_dataset(fold.folder).tables == (TASKS,)
    assert open_dataset(fold.folder).tasks == fold.tasks


def test_a_fold_whose_table_has_another_split_is_found(graded: Dataset, tmp_path: Path) -> None:
    from tcmrl_data.verification.repair import write_tables

    fold = open_dataset(split_dataset(graded, tmp_path, folds=2)[1].out)
    write_tables(
        fold.folder, fold.manifest, tasks=graded.tasks, table=fold.parts, platforms=fold.manifest.platforms
    )
    problems = [finding.problem for finding in verify_dataset(fold.folder, level="deep").findings]
    assert problems
    assert all("is not the one that the derivation says" in problem for problem in problems)


def test_episodes_are_split_without_rest_or_overlap(graded: Dataset, tmp_path: Path) -> None:
    made = split_dataset(graded, tmp_path / "out", episodes=[3, 1], names=["fit", "holdout"])
    fit, holdout = (open_dataset(report.out) for report in made)
    for key in graded.parts:
        whole = graded.arrays(*key)["rewards"]
        rewards = [dataset.arrays(*key)["rewards"] for dataset in (fit, holdout)]
        np.testing.assert_array_equal(np.concatenate(rewards), whole)
    assert [dataset.manifest.totals.episodes for dataset in (fit, holdout)] == [105, 35]
    assert verify_dataset(holdout.folder, level="deep").findings == ()


def test_a_stopped_split_goes_on(graded: Dataset, tmp_path: Path) -> None:
    class Stop(Exception):
        pass

    def stop(done: int, total: int) -> None:
        if done == 50:
            raise Stop

    with pytest.raises(Stop):
        split_dataset(graded, tmp_path, folds=2, progress=stop)
    before = (tmp_path / "0" / "manifest.json").stat().st_mtime_ns
    assert not (tmp_path / "1" / "manifest.json").exists()
    split_dataset(graded, tmp_path, folds=2)
    assert (tmp_path / "0" / "manifest.json").stat().st_mtime_ns == before
    assert verify_dataset(tmp_path / "1", level="deep").findings == ()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, "name one of the two"),
        ({"folds": 2, "episodes": [1, 1]}, "name one of the two"),
        ({"folds": 8}, "7 tasks do not make 8 folds"),
        ({"folds": 1}, "7 tasks do not make 1 folds"),
        ({"episodes": [4, 1]}, "has 4 episodes, not 5"),
        ({"episodes": [4]}, "two numbers or more"),
        ({"episodes": [4, 0]}, "two numbers or more"),
        ({"episodes": [2, 2], "views": True}, "names whole parts"),
        ({"episodes": [2, 2], "names": ["a"]}, "expected 2 different names"),
        ({"folds": 2, "names": ["a", "../b"]}, "expected 2 different names"),
    ],
)
def test_bad_splits_are_refused(
    graded: Dataset, tmp_path: Path, settings: dict[str, object], expected: str
) -> None:
    with pytest.raises(SelectionError, match=expected):
        split_dataset(graded, tmp_path / "out", **settings)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_a_label_changes_the_digest_and_not_the_root(tmp_path: Path) -> None:
    dataset = graded_dataset(tmp_path / "data", tasks=[0])
    manifest = rename_dataset(dataset.folder, "pr/one task")
    assert (manifest.label, manifest.root) == ("pr/one task", dataset.manifest.root)
    assert manifest.digest != dataset.manifest.digest
    assert verify_dataset(dataset.folder, level="deep").findings == ()
    for label in ("", " ", "a\nb", "a\x1b[31m", "x" * 201):
        with pytest.raises(SelectionError, match="label"):
            rename_dataset(dataset.folder, label)
    with pytest.raises(ManifestError, match="does not exist"):
        rename_dataset(tmp_path / "none", "x")
    with lock_file(dataset.folder / LOCK, "dataset"), pytest.raises(LockedError):
        rename_dataset(dataset.folder, "x")
    assert open_dataset(dataset.folder).manifest == manifest


def test_the_command_line_makes_folds_and_splits_episodes(
    graded: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = in_process(data, capsys)
    out = tmp_path / "out"
    code, output, _ = call("derive", graded.folder, "--folds", "2", "--view", out, "--quiet")
    assert (code, output.count("35 parts, 7 tasks")) == (0, 2)
    names = ("--episodes", "3,1", "--names", "fit,holdout")
    code, output, _ = call("derive", graded.folder, *names, "--out", out, "--json", "--quiet")
    assert [Path(row["out"]).name for row in json.loads(output)["datasets"]] == ["fit", "holdout"]
    for options, expected in (
        (("--episodes", "3,a", "--out", out), "numbers such as 45,5"),
        (("--folds", "2", "--tier", "expert", "--out", out), "--tier does not go with --folds"),
        (("--folds", "2"), "--out or by --view"),
        (("--tier", "expert", "--names", "a,b", "--out", out), "--names is for several datasets"),
    ):
        assert_refused(call("derive", graded.folder, *options), expected)
    with pytest.raises(StoreError, match="exists"):
        split_dataset(graded, out, folds=3, names=["fit", "b", "c"])
