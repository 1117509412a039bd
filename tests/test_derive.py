"""Subsets of datasets: tiers, episodes, arrays; views."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli import options
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import TIERS, Dataset, derive_dataset, open_dataset, verify_dataset
from tcmrl_data.foundation.errors import ManifestError, SelectionError, StoreError
from tcmrl_data.foundation.records import (
    canonical_json,
    count_ranges,
    digest,
    read_ranges,
    sealed,
    write_ranges,
)
from tcmrl_data.store.manifest import MANIFEST, read_manifest
from tcmrl_data.store.part import References
from tcmrl_data.store.tables import PartKey, part_file
from tests.commands import assert_refused, in_process
from tests.graded import graded_dataset

TIER_STEPS = {
    "random": [0],
    "medium": [200],
    "medium-replay": [0, 100, 200],
    "expert": [300],
    "medium-expert": [200, 300],
    "random-expert": [0, 300],
    "mixed": [0, 100, 200, 300, 400],
}


@pytest.fixture(scope="module")
def graded(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return graded_dataset(tmp_path_factory.mktemp("graded") / "data")


@pytest.mark.parametrize("tier", TIERS)
def test_a_tier_takes_the_snapshots_that_its_name_calls_for(graded: Dataset, tier: str) -> None:
    for selection in (graded.select(tier=tier), graded.select(snapshots=f"tier:{tier}")):
        steps = {task: [key.step for key in keys] for task, keys in selection.parts.items()}
        assert steps == dict.fromkeys(range(4), TIER_STEPS[tier])


def test_the_command_line_knows_all_tiers() -> None:
    assert options.TIERS == TIERS


def test_the_best_is_the_oracle_else_the_expert_else_the_best_snapshot(tmp_path: Path) -> None:
    def medium(oracle: float | None, scripted: float | None, name: str) -> list[int]:
        references = References(uniform=0.0, oracle=oracle, scripted=scripted)
        dataset = graded_dataset(tmp_path / name, tasks=[0], references=references)
        return [key.step for key in dataset.select(tier="medium").parts[0]]

    assert medium(20.0, 1.0, "oracle") == [300]
    assert medium(None, 5.0, "scripted") == [100]
    assert medium(None, None, "behavior") == [200]


def test_a_tier_needs_references_and_a_snapshot_that_qualifies(tmp_path: Path) -> None:
    def refusal(tier: str, name: str, **settings: object) -> str:
        dataset = graded_dataset(tmp_path / name, tasks=[0], **settings)  # type: ignore[arg-type]
        with pytest.raises(SelectionError) as refused:
            dataset.select(tier=tier)
        return str(refused.value)

    unknown = References(uniform=None, oracle=None, scripted=None)
    assert "no return of uniform actions is known" in refusal("expert", "none", references=unknown)
    low = References(uniform=0.0, oracle=-1.0, scripted=None)
    assert "best known return -1 is not above" in refusal("medium", "low", references=low)
    assert "task 0 has no medium snapshot, the best score is 20" in refusal(
        "medium", "weak", scores={5: 20.0}
    )
    assert "no random snapshot, it has no part of step 0" in refusal("random", "late", scores={5: 20.0})
    assert "4 at step 0, 3 at step 300" in refusal("random-expert", "uneven", episodes={300: 3})
    assert "tier 'best' does not exist; choose one of random" in refusal("best", "odd")


def test_whole_parts_keep_ids_and_bytes(graded: Dataset, tmp_path: Path) -> None:
    report = derive_dataset(graded, tmp_path / "medium", tier="medium", label="pr/medium")
    made = open_dataset(tmp_path / "medium")
    assert (report.parts, report.cut, report.root) == (4, 0, made.manifest.root)
    for key in made.parts:
        assert made.entry(key) == graded.entry(key)
        assert made.file_of(key).read_bytes() == graded.file_of(key).read_bytes()
    derivation = made.manifest.derivation
    assert derivation is not None
    assert (made.manifest.label, derivation.sources[0].root) == ("pr/medium", graded.manifest.root)
    assert derivation.settings["medium_score"] == 33.0
    assert derivation.settings["scores"]["3"][2] == ["main", 200, pytest.approx(40, abs=0.01)]
    assert made.manifest.complete
    assert [task.split for task in made.tasks] == [task.split for task in graded.tasks]
    assert verify_dataset(tmp_path / "medium", level="deep").findings == ()


def test_a_medium_snapshot_that_is_none_is_named(tmp_path: Path) -> None:
    dataset = graded_dataset(tmp_path / "data", tasks=[0, 1], scores={0: 0.0, 100: 60.0})
    report = derive_dataset(dataset, tmp_path / "near", tier="medium", dry_run=True)
    assert report.far_from_medium["task 1, step 100, run main"] == pytest.approx(60, abs=0.01)


def test_episodes_are_the_first_ones_or_a_keyed_sample(graded: Dataset, tmp_path: Path) -> None:
    def kept(name: str, **choice: object) -> list[float]:
        derive_dataset(graded, tmp_path / name, tasks=[2], snapshots="last", **choice)  # type: ignore[arg-type]
        assert verify_dataset(tmp_path / name, level="deep").findings == ()
        made = open_dataset(tmp_path / name)
        assert [run.kind for run in made.manifest.runs] == ["subset"]
        return [round(episode.undiscounted_return, 3) for episode in made.trajectories(2, 400)]

    assert kept("first", episodes=2) == [6.5, 7.5]
    assert kept("half", episodes="50%") == [6.5, 7.5]
    samples = [kept(f"seed {seed}", episodes=2, seed=seed) for seed in range(5)]
    assert all(sample == sorted(sample) and len(sample) == 2 for sample in samples)
    assert len({tuple(sample) for sample in samples}) > 1
    assert kept("again", episodes=2, seed=0) == samples[0]
    assert kept("good", min_return=8.0) == [8.5, 9.5]
    assert kept("best", min_return=6.7, episodes=1) == [7.5]


def test_a_cut_part_names_its_origin_and_a_second_cut_changes_nothing(
    graded: Dataset, tmp_path: Path
) -> None:
    derive_dataset(graded, tmp_path / "three", episodes=3)
    derive_dataset(tmp_path / "three", tmp_path / "two", episodes=2)
    derive_dataset(graded, tmp_path / "direct", episodes=2)
    twice, direct = open_dataset(tmp_path / "two"), open_dataset(tmp_path / "direct")
    assert twice.manifest.root == direct.manifest.root
    record = twice.part(3, 100)
    assert record.identity.derived == {
        "operation": "subset",
        "from": [graded.entry(PartKey(3, 100)).id],
        "settings": {"episodes": "0-1", "without": []},
    }
    np.testing.assert_array_equal(twice.arrays(3, 100)["rewards"], graded.arrays(3, 100)["rewards"][:10])


def test_parts_without_a_good_episode_are_left_out_and_whole_ones_stay_whole(
    graded: Dataset, tmp_path: Path
) -> None:
    report = derive_dataset(graded, tmp_path / "good", min_return=6.0)
    made = open_dataset(tmp_path / "good")
    assert (report.steps, report.cut) == ((300, 400), 0)
    assert made.entry(PartKey(0, 300)) == graded.entry(PartKey(0, 300))
    assert [(run.kind, run.steps) for run in made.manifest.runs] == [("built", None)]
    with pytest.raises(SelectionError, match="no episode of task 0 has a return of 20; leave the task out"):
        derive_dataset(graded, tmp_path / "none", min_return=20.0)


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        ({"tier": "best"}, "tier 'best' does not exist"),
        ({"tier": "expert", "snapshots": "last"}, "exclude each other"),
        ({"episodes": 5}, "has 4 episodes, not the 5"),
        ({"episodes": 0}, "expected a number of at least 1"),
        ({"episodes": "101%"}, "expected a number of at least 1"),
        ({"seed": 1}, "say how many"),
        ({"min_return": float("nan")}, "is no return"),
        ({"drop_arrays": ["success"]}, "its extra arrays are: none"),
        ({"split": "test", "tasks": [0]}, "no test tasks"),
        ({"view": "x.json"}, "name one of the two"),
    ],
)
def test_bad_choices_are_refused_before_anything_is_written(
    graded: Dataset, tmp_path: Path, choice: dict[str, object], expected: str
) -> None:
    with pytest.raises(SelectionError, match=expected):
        derive_dataset(graded, tmp_path / "out", **choice)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_only_its_own_beginning_is_continued(graded: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "out"
    derive_dataset(graded, out, tier="expert")
    with pytest.raises(StoreError, match="exists and is not empty"):
        derive_dataset(graded, out, tier="expert")
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match="is a file"):
        derive_dataset(graded, tmp_path / "file", tier="expert", dry_run=True)


def test_damage_and_changes_of_the_source_are_found(graded: Dataset, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(graded.folder, copy)
    file = copy / part_file(PartKey(1, 300))
    data = bytearray(file.read_bytes())
    data[200] ^= 1
    file.write_bytes(data)
    for choice in ({"tier": "expert"}, {"tier": "expert", "episodes": 2}):
        with pytest.raises(StoreError, match=r"00001/0000300.zip"):
            derive_dataset(copy, tmp_path / f"out {len(choice)}", **choice)
    shutil.rmtree(copy)
    opened = graded_dataset(copy)

    def change(done: int, total: int) -> None:
        fields = read_manifest(copy).model_dump(mode="json", exclude={"digest"})
        (copy / MANIFEST).write_bytes(sealed(fields | {"label": "another"}))

    with pytest.raises(StoreError, match="has changed meanwhile"):
        derive_dataset(opened, tmp_path / "changed", tier="random", progress=change)
    assert not (tmp_path / "changed" / MANIFEST).exists()


@pytest.mark.parametrize("as_view", [False, True])
def test_held_out_training_tasks_are_the_test_tasks_of_a_derived_dataset(
    graded: Dataset, tmp_path: Path, as_view: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / ("held.json" if as_view else "held")
    arguments = ["derive", graded.folder, "--split", "train", "--held-out", "1", "--quiet"]
    code, _, _ = in_process(data, capsys)(*arguments, "--view" if as_view else "--out", target)
    made = open_dataset(target)
    assert code == 0
    assert [task.index for task in graded.test_tasks] == [3]
    assert [task.index for task in made.train_tasks] == [0, 2]
    assert [task.index for task in made.test_tasks] == [1]  # and task 3 is nowhere
    assert {key.task for key in made.parts} == {0, 1, 2}
    assert set(made.select(split="test").parts) == {1}
    if not as_view:
        assert verify_dataset(target, level="deep", sources=[graded]).findings == ()
    again = derive_dataset(made, tmp_path / "again", tasks=[0, 1])
    assert [task.split for task in open_dataset(again.out).tasks] == ["train", "test"]


@pytest.mark.parametrize(
    ("held_out", "problem"), [([1, 9], "does not choose task 9"), ([0, 1, 2], "leaves no training task")]
)
def test_impossible_held_out_tasks_are_refused(
    graded: Dataset, tmp_path: Path, held_out: list[int], problem: str
) -> None:
    with pytest.raises(SelectionError, match=rf"held-out tasks .*{problem}; it has tasks \[0, 1, 2\]"):
        derive_dataset(graded, tmp_path / "out", split="train", held_out=held_out)


def test_a_view_opens_like_a_dataset_of_its_parts(graded: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "views" / "medium.json"
    report = derive_dataset(graded, view=file, tier="medium", split="train", label="pr/medium")
    derive_dataset(graded, tmp_path / "medium", tier="medium", split="train")
    view, made = open_dataset(file), open_dataset(tmp_path / "medium")
    assert view.manifest.root == made.manifest.root == report.root
    assert view.manifest.totals == made.manifest.totals
    assert (view.manifest.label, view.path, view.folder.resolve()) == ("pr/medium", file, graded.folder)
    assert view.tasks == made.tasks
    assert list(view.parts.entries()) == list(made.parts.entries())
    assert view.select(snapshots="last").parts == made.select().parts
    with pytest.raises(SelectionError, match="no part of task 0, step 0"):
        view.part(0, 0)
    derive_dataset(view, tmp_path / "one", tasks=[2])
    assert list(open_dataset(tmp_path / "one").parts) == [PartKey(2, 200)]
    derive_dataset(view, view=tmp_path / "one.json", tasks=[2])
    assert open_dataset(tmp_path / "one.json").manifest.root == open_dataset(tmp_path / "one").manifest.root


def test_a_view_travels_with_its_dataset_and_refuses_another(graded: Dataset, tmp_path: Path) -> None:
    shutil.copytree(graded.folder, tmp_path / "a" / "data")
    derive_dataset(tmp_path / "a" / "data", view=tmp_path / "a" / "view.json", tier="expert")
    (tmp_path / "a").rename(tmp_path / "b")
    assert len(open_dataset(tmp_path / "b" / "view.json").parts) == 4
    shutil.rmtree(tmp_path / "b" / "data")
    with pytest.raises(ManifestError, match=r"view.json is a view of .*b/data: .* does not exist"):
        open_dataset(tmp_path / "b" / "view.json")
    graded_dataset(tmp_path / "b" / "data", seed=1)
    with pytest.raises(ManifestError, match="is a view of a dataset with root"):
        open_dataset(tmp_path / "b" / "view.json")


def edited(**changes: object) -> Callable[[dict[str, object]], None]:
    return lambda fields: fields.update(changes)


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (edited(schema_version=9), "schema_version 9"),
        (edited(source_root="0" * 64), "is a view of a dataset with root 000000000000"),
        (edited(parts=[{"tasks": "0-99999", "steps": [1] * 9, "run": "main"}] * 9), "totals.parts is not"),
        (edited(parts=[{"tasks": "0-4294967295", "steps": [1], "run": "main"}]), "ascending ranges"),
        (edited(parts=[{"tasks": "3,1,2,0", "steps": [300], "run": "main"}]), "ascending ranges"),
        (edited(source="../no\x1bwhere"), "control characters"),
        (edited(root="0" * 64), "do not have the manifest's root"),
        (edited(more=1), "more"),
    ],
)
def test_forged_views_are_refused(
    graded: Dataset, tmp_path: Path, edit: Callable[[dict[str, object]], None], expected: str
) -> None:
    file = tmp_path / "view.json"
    derive_dataset(graded, view=file, tier="expert")
    fields = json.loads(file.read_bytes())
    del fields["digest"]
    edit(fields)
    file.write_bytes(canonical_json(fields | {"digest": digest(fields)}))
    with pytest.raises(ManifestError, match=expected):
        list(open_dataset(file).parts)
    file.write_bytes(canonical_json(fields | {"digest": "0" * 64}))
    with pytest.raises(ManifestError):
        open_dataset(file)


def test_a_view_is_made_from_the_table_alone(graded: Dataset, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(graded.folder, copy)
    shutil.rmtree(copy / "parts")
    derive_dataset(copy, view=tmp_path / "view.json", tier="medium-expert")
    assert len(open_dataset(tmp_path / "view.json").parts) == 8


def test_a_view_names_whole_parts_and_replaces_nothing(graded: Dataset, tmp_path: Path) -> None:
    with pytest.raises(SelectionError, match="names whole parts"):
        derive_dataset(graded, view=tmp_path / "v.json", episodes=2)
    for name in ("v.txt", "manifest.json"):
        with pytest.raises(StoreError, match="name ends in"):
            derive_dataset(graded, view=tmp_path / name, tier="expert")
    (tmp_path / "v.json").touch()
    with pytest.raises(StoreError, match="exists; choose another name"):
        derive_dataset(graded, view=tmp_path / "v.json", tier="expert")
    assert [path.name for path in tmp_path.iterdir()] == ["v.json"]


def test_a_view_trains_and_exports(graded: Dataset, tmp_path: Path) -> None:
    derive_dataset(graded, view=tmp_path / "v.json", tier="expert")
    view = open_dataset(tmp_path / "v.json")
    request = tcmrl_data.BatchRequest(2, {"x": tcmrl_data.Transitions(3)})
    batch = tcmrl_data.open_sampler(view.select(split="train"), request, seed=0).batch(0)
    assert set(batch.task_indices.tolist()) <= {0, 1, 2}
    report = tcmrl_data.export_dataset(view, "hdf5", tmp_path / "out", tier="expert")
    assert len(report.files) >= 4


def test_the_command_line_derives(
    graded: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = in_process(data, capsys)
    code, output, _ = call("derive", graded.folder, "--tier", "medium", "--out", tmp_path / "m", "--quiet")
    assert (code, output.count("\n")) == (0, 1)
    assert "m: 4 parts, 4 tasks, step 200, " in output
    code, output, _ = call(
        *("derive", graded.folder, "--episodes", "50%", "--tasks", "0-1", "--out", tmp_path / "c", "--json"),
        *("--dry-run", "--quiet"),
    )
    (row,) = json.loads(output)["datasets"]
    assert (code, row["cut"], row["root"], (tmp_path / "c").exists()) == (0, 10, None, False)
    code, _, errors = call("derive", graded.folder, "--tier", "medium", "--view", tmp_path / "v.json")
    assert (code, errors) == (0, "")
    far = graded_dataset(tmp_path / "far", scores={0: 0.0, 100: 60.0}).folder
    code, _, errors = call("derive", far, "--tier", "medium", "--view", tmp_path / "w.json")
    assert (code, errors.startswith("warning: not near")) == (0, True)
    assert_refused(call("derive", graded.folder, "--tier", "expert", "--quiet"), "--out", "--view")


@pytest.mark.parametrize("indices", [[], [0], [3, 1, 2], [0, 2, 4], [7, 8, 9, 20]])
def test_ranges_are_read_as_they_were_written(indices: list[int]) -> None:
    text = write_ranges(indices)
    assert read_ranges(text, limit=30) == sorted(indices)
    assert count_ranges(text, limit=30) == len(indices)


@pytest.mark.parametrize("text", ["1,0", "0-0", "0,1", "0--1", "00", "5-30", " 1", "1-", "a", "1,1", ","])
def test_other_ranges_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="range"):
        read_ranges(text, limit=30)
