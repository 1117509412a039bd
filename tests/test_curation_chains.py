"""Random chains of derive, merge, split and extend over small datasets."""

import shutil
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tcmrl_data import (
    BatchRequest,
    Dataset,
    Transitions,
    derive_dataset,
    diff_datasets,
    extend_dataset,
    merge_datasets,
    open_dataset,
    open_sampler,
    split_dataset,
    verify_dataset,
)
from tcmrl_data.foundation.errors import BuildError, SelectionError
from tests.graded import graded_dataset

pytestmark = pytest.mark.usefixtures("module_in_process")

OPERATIONS = ["tier", "view", "cut", "tasks", "merge", "fold", "folded view", "episodes"]


def chains_of(operations: list[str]) -> st.SearchStrategy[list[tuple[str, int, int]]]:
    """Operations, and which datasets they take."""
    numbers = st.integers(0, 10)
    return st.lists(st.tuples(st.sampled_from(operations), numbers, numbers), min_size=1, max_size=4)


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> list[Dataset]:
    folder = tmp_path_factory.mktemp("seeds")
    scores = {0: 0.0, 100: 40.0, 200: 90.0}
    return [graded_dataset(folder / f"{seed}", seed=seed, scores=scores, tasks=range(5)) for seed in range(2)]


@pytest.fixture(scope="module")
def policies(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> list[Dataset]:
    """Datasets with policies: some tasks of the tiny one, and others of it."""
    folder = tmp_path_factory.mktemp("policies")
    for name, tasks in (("left", [0, 3, 40, 99]), ("right", [3, 60, 99])):
        derive_dataset(tiny, folder / name, tasks=tasks, snapshots="steps>=100")
    return [open_dataset(folder / name) for name in ("left", "right")]


def apply(step: tuple[str, int, int], held: list[Dataset], folder: Path) -> Dataset | None:
    """The dataset that one step makes of those that are held; None if the step is refused."""
    operation, first, second = step
    source, other = held[first % len(held)], held[second % len(held)]
    out = folder / f"{len(held)}"
    try:
        if operation == "merge":
            merge_datasets([source, other], out)
            merge_datasets([other, source], folder / "other order")
            assert open_dataset(folder / "other order").manifest.digest == open_dataset(out).manifest.digest
            shutil.rmtree(folder / "other order")
        elif operation == "extend":
            run = f"extended{second % 3}"
            tasks = [task.index for task in source.tasks][second % 2 :]
            extend_dataset(source.path, out=out, episodes=3, run=run, tasks=tasks, noise=0.1 * (second % 3))
        elif operation in ("fold", "folded view"):
            made = split_dataset(source, out, folds=2, seed=second, views=operation == "folded view")
            return open_dataset(made[first % 2].out)
        elif operation == "episodes":
            return open_dataset(split_dataset(source, out, episodes=[1, 1])[second % 2].out)
        elif operation == "view":
            return open_dataset(derive_dataset(source, view=out.with_suffix(".json"), tier="expert").out)
        else:
            choices: dict[str, dict[str, object]] = {
                "tier": {"tier": "medium-replay"},
                "cut": {"episodes": 2, "seed": second},
                "tasks": {"tasks": [task.index for task in source.tasks][second % 2 :]},
            }
            derive_dataset(source, out, **choices[operation])  # type: ignore[arg-type]
            found, made = diff_datasets(source, out), open_dataset(out)
            assert set(found.left_only) == {*source.parts} - {*made.parts}
            assert {*found.different} == {key for key in made.parts if made.entry(key) != source.entry(key)}
            assert found.right_only == ()
    except (SelectionError, BuildError):
        assert not (out / "manifest.json").exists()
        return None
    return open_dataset(out)


def check_chain(held: list[Dataset], folder: Path, steps: list[tuple[str, int, int]]) -> None:
    """Takes the steps and checks what must hold of every dataset that they make."""
    for step in steps:
        made = apply(step, held, folder)
        held += [made] if made is not None else []
    contents: dict[str, bytes] = {}
    for dataset in held:
        for key in dataset.parts:
            data = dataset.content(key)
            assert contents.setdefault(dataset.entry(key).id, data) == data
        if dataset.path.is_dir():
            assert verify_dataset(dataset.path, level="deep").findings == ()
        assert diff_datasets(dataset, dataset).is_empty
        training = {task.index for task in dataset.train_tasks}
        tested = {task.index for task in dataset.test_tasks}
        assert not training & tested
        if len(training) > 1:
            request = BatchRequest(2, {"x": Transitions(2)})
            sampler = open_sampler(dataset.select(split="train"), request, seed=0)
            drawn = {index for n in range(10) for index in sampler.batch(n).task_indices.tolist()}
            assert drawn <= training
            batch = sampler.batch(0).steps["x"].observations.reshape(-1, 2).numpy()
            rows = {row.tobytes() for row in batch}
            assert rows <= _rows(dataset, training)
            assert not rows & _rows(dataset, tested)
    shutil.rmtree(folder)


@pytest.mark.check
@settings(max_examples=25)
@given(steps=chains_of(OPERATIONS))
def test_chains_keep_parts_and_splits(
    seeds: list[Dataset], tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int, int]]
) -> None:
    check_chain(list(seeds), tmp_path_factory.mktemp("chain"), steps)


@pytest.mark.check
@settings(max_examples=6)
@given(steps=chains_of(["extend", "extend", *OPERATIONS]))
def test_chains_with_extensions_keep_parts_and_splits(
    policies: list[Dataset], tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int, int]]
) -> None:
    """Extended parts are made again by every deep verification."""
    check_chain(list(policies), tmp_path_factory.mktemp("chain"), steps)


def _rows(dataset: Dataset, tasks: set[int]) -> set[bytes]:
    """The observations that transitions of some tasks start from."""
    return {
        row.tobytes()
        for task in tasks
        for key in dataset.parts.keys_of(task)
        for episode in dataset.trajectories(*key)
        for row in episode.observations[:-1]
    }
