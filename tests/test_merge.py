"""Unions of datasets."""

import json
from itertools import permutations
from pathlib import Path

import pytest
from tcmrl_cli.data import data

from tcmrl_data import Dataset, derive_dataset, merge_datasets, open_dataset, split_dataset, verify_dataset
from tcmrl_data.foundation.errors import SelectionError, StoreError
from tcmrl_data.store.tables import PartKey
from tests.commands import assert_refused, in_process
from tests.graded import graded_dataset, graded_recipe


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> list[Dataset]:
    folder = tmp_path_factory.mktemp("seeds")
    return [graded_dataset(folder / f"seed{seed}", seed=seed, tasks=[0, 1, 3]) for seed in range(3)]


def test_the_order_of_the_sources_does_not_matter(seeds: list[Dataset], tmp_path: Path) -> None:
    digests = set()
    for number, order in enumerate(permutations(seeds)):
        merge_datasets(order, tmp_path / str(number))
        digests.add(open_dataset(tmp_path / str(number)).manifest.digest)
    assert len(digests) == 1
    made = open_dataset(tmp_path / "0")
    assert [(run.name, run.seed) for run in made.manifest.runs] == [("main", 0), ("seed1", 1), ("seed2", 2)]
    assert (len(made.parts), made.manifest.complete) == (45, True)
    for seed, source in enumerate(seeds):
        for key in source.parts:
            there = PartKey(key.task, key.step, f"seed{seed}" if seed else "main")
            assert made.entry(there).id == source.entry(key).id
            assert made.file_of(there).read_bytes() == source.file_of(key).read_bytes()
    assert verify_dataset(tmp_path / "0", level="deep").findings == ()
    assert [key.run for key in made.select(tier="expert").parts[0]] == ["main", "seed1", "seed2"]


def test_equal_parts_are_taken_once(seeds: list[Dataset], tmp_path: Path) -> None:
    derive_dataset(seeds[0], tmp_path / "expert", tier="medium-expert")
    derive_dataset(seeds[0], tmp_path / "first", tasks=[0])
    merge_datasets([tmp_path / "first", seeds[0], tmp_path / "expert"], tmp_path / "all")
    assert open_dataset(tmp_path / "all").manifest.root == seeds[0].manifest.root
    merge_datasets([*seeds[:2]], tmp_path / "two")
    merge_datasets([tmp_path / "two", *seeds], tmp_path / "three")
    merge_datasets(seeds, tmp_path / "direct")
    assert open_dataset(tmp_path / "three").manifest.root == open_dataset(tmp_path / "direct").manifest.root


def test_parts_of_several_builds_complement_each_other(tmp_path: Path) -> None:
    whole = graded_dataset(tmp_path / "whole")
    halves = [graded_dataset(tmp_path / name, tasks=tasks) for name, tasks in (("a", [0, 3]), ("b", [1, 2]))]
    merge_datasets(halves, tmp_path / "out")
    made = open_dataset(tmp_path / "out")
    assert made.manifest.root == whole.manifest.root
    assert (made.manifest.steps, made.manifest.complete) == (whole.manifest.steps, True)


def test_cut_parts_become_another_run(seeds: list[Dataset], tmp_path: Path) -> None:
    derive_dataset(seeds[0], tmp_path / "cut", episodes=2)
    merge_datasets([seeds[0], tmp_path / "cut"], tmp_path / "out")
    made = open_dataset(tmp_path / "out")
    assert [(run.name, run.kind) for run in made.manifest.runs] == [("main", "built"), ("seed0", "subset")]
    assert verify_dataset(tmp_path / "out", level="deep").findings == ()


def test_runs_are_named_as_asked(seeds: list[Dataset], tmp_path: Path) -> None:
    for number, order in enumerate(([0, 1], [1, 0])):
        names = [f"seed-{seed}" for seed in order]
        merge_datasets([seeds[seed] for seed in order], tmp_path / str(number), names=names)
    first, second = (open_dataset(tmp_path / name).manifest for name in "01")
    assert first.digest == second.digest
    assert [run.name for run in first.runs] == ["seed-0", "seed-1"]
    with pytest.raises(SelectionError, match="two different runs would have it"):
        merge_datasets(seeds[:2], tmp_path / "x", names=["a", "a"])
    with pytest.raises(SelectionError, match="a-z, 0-9"):
        merge_datasets(seeds[:2], tmp_path / "x", names=["A", "b"])


def test_sources_that_disagree_are_named_with_both_values(seeds: list[Dataset], tmp_path: Path) -> None:
    def refusal(name: str, **settings: object) -> str:
        other = graded_dataset(tmp_path / name, **settings)  # type: ignore[arg-type]
        with pytest.raises(SelectionError) as refused:
            merge_datasets([seeds[0], other], tmp_path / "out")
        assert not (tmp_path / "out").exists()
        return str(refused.value)

    long = graded_recipe("environment.horizon=9")
    message = refusal("horizon", recipe=long)
    assert "environment.horizon differs: " in message
    assert "9 in " in message
    assert "20 in " in message


def test_other_parameters_of_a_task_are_named(tmp_path: Path) -> None:
    left = graded_dataset(tmp_path / "left", tasks=[0])
    moved = graded_dataset(tmp_path / "right", tasks=[0], moved=True)
    with pytest.raises(SelectionError, match=r"task 0: goal differs: \[.*\] in .* and \[.*\] in .*"):
        merge_datasets([left, moved], tmp_path / "out")


def test_splits_must_agree_or_one_source_decides(tmp_path: Path) -> None:
    whole = graded_dataset(tmp_path / "whole")
    split_dataset(whole, tmp_path / "folds", folds=2)
    folds = [open_dataset(tmp_path / "folds" / name) for name in "01"]
    with pytest.raises(SelectionError, match=r"task \d is a (train|test) task in .*; say with --split-from"):
        merge_datasets(folds, tmp_path / "out")
    for fold in folds:
        out = tmp_path / f"out {fold.folder.name}"
        merge_datasets([whole, *folds], out, split_from=fold)
        made = open_dataset(out)
        assert made.test_tasks == fold.test_tasks
        assert made.manifest.root == whole.manifest.root
        assert verify_dataset(out, level="deep").findings == ()
        derive_dataset(out, tmp_path / f"of {fold.folder.name}", tier="expert")
        assert open_dataset(tmp_path / f"of {fold.folder.name}").test_tasks == fold.test_tasks
    merge_datasets([whole, *folds], tmp_path / "drawn", split_from=whole)
    assert open_dataset(tmp_path / "drawn").tasks == whole.tasks
    assert verify_dataset(tmp_path / "drawn", level="deep").findings == ()
    with pytest.raises(SelectionError, match="names none of the datasets"):
        merge_datasets(folds, tmp_path / "other", split_from=whole)


def test_bad_unions_are_refused(seeds: list[Dataset], tmp_path: Path) -> None:
    with pytest.raises(SelectionError, match="two datasets or more, got 1"):
        merge_datasets(seeds[:1], tmp_path / "out")
    with pytest.raises(SelectionError, match="as many names"):
        merge_datasets(seeds, tmp_path / "out", names=["a"])
    with pytest.raises(SelectionError, match="label"):
        merge_datasets(seeds, tmp_path / "out", label=" ")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    for dry_run in (True, False):
        with pytest.raises(StoreError, match="exists and is not empty"):
            merge_datasets(seeds, tmp_path / "out", dry_run=dry_run)


def test_the_command_line_merges(
    seeds: list[Dataset], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = in_process(data, capsys)
    folders = [seed.folder for seed in seeds]
    code, output, _ = call("merge", *folders, "--out", tmp_path / "out", "--dry-run", "--json", "--quiet")
    assert (code, json.loads(output)["datasets"][0]["parts"], (tmp_path / "out").exists()) == (0, 45, False)
    code, output, _ = call("merge", *folders, "--out", tmp_path / "out", "--label", "all", "--quiet")
    assert (code, "45 parts, 3 tasks, steps 0 to 400" in output) == (0, True)
    assert_refused(call("merge", *folders, "--out", tmp_path / "out", "--quiet"), "exists and is not empty")
