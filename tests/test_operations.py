"""The contract of operations, over all that are installed: a part is a function of its identity."""

import contextlib
from pathlib import Path
from typing import Any

import pytest

from tcmrl_data import Dataset, merge_datasets, open_dataset, repair_dataset, verify_dataset
from tcmrl_data.foundation.errors import BuildError, SelectionError
from tcmrl_data.foundation.records import Record, canonical_json, sha256
from tcmrl_data.operations.apply import apply_operation
from tcmrl_data.parts.making import make_from
from tcmrl_data.parts.operation import OPERATIONS, Operation, Simulator, Sources, StoredPart, WantedPart
from tcmrl_data.parts.own_operations import OWN_OPERATIONS, Import, operation_named, operation_of
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.part import read_part_record
from tcmrl_data.store.tables import PartKey, part_file
from tcmrl_data.verification.description import NO_SOURCE
from tcmrl_data.verification.replay import replay_part

KINDS = sorted({**OWN_OPERATIONS, **OPERATIONS.working()}.items())
NAMES = [name for name, kind in KINDS if kind is not Import]


def source_of(tiny: Dataset) -> StoredPart:
    return StoredPart.of(tiny, PartKey(tiny.train_tasks[0].index, 150))


def example_of(kind: type[Operation[Any]], source: StoredPart) -> Operation[Any]:
    """The operation with its own example, as it would make a part of `source`."""
    settings = kind.settings_for(kind.example, source.task)
    return kind(kind.Settings.model_validate_json(canonical_json(settings)))


def made_of(tiny: Dataset, operation: Operation[Any]) -> bytes:
    """The archive of a part that an operation makes in the task of the stored one."""
    source = source_of(tiny)
    recipe, seed = tiny.manifest.recipe, tiny.manifest.seed
    assert seed is not None
    with contextlib.closing(Simulator(recipe, seed=seed, task=source.task)) as simulator:
        return make_from(operation, source, task=source.task, simulator=simulator)[1]


@pytest.mark.parametrize("name", NAMES)
def test_equal_identities_and_sources_give_equal_parts(name: str, tiny: Dataset) -> None:
    operation = example_of(operation_named(name), source_of(tiny))
    assert made_of(tiny, operation) == made_of(tiny, operation)


@pytest.mark.parametrize("name", NAMES)
def test_a_part_is_made_again_from_its_record_and_its_source(
    name: str, tiny: Dataset, tmp_path: Path
) -> None:
    source, file = source_of(tiny), tmp_path / "part.zip"
    operation = example_of(operation_named(name), source)
    file.write_bytes(made_of(tiny, operation))
    with Archive(file) as archive:
        record = read_part_record(archive)
        found = operation_of(record.identity, "here")
        assert (type(found), found.settings) == (type(operation), operation.settings)
        assert record.identity.derived == operation.derived(source.record)
        key = PartKey(source.task.index, 150)
        files = {source.record.id: tiny.file_of(key)}
        replay = replay_part(archive, record, key, tiny.manifest.recipe, files)
    assert replay is not None
    assert (replay.problems, replay.exact) == ((), True)


@pytest.mark.parametrize("name", NAMES)
def test_the_source_stays_as_it_is(name: str, tiny: Dataset) -> None:
    key = PartKey(tiny.train_tasks[0].index, 150)
    made_of(tiny, example_of(operation_named(name), source_of(tiny)))
    assert sha256(tiny.file_of(key).read_bytes()) == tiny.entry(key).sha256


def test_imported_episodes_cannot_be_made_again(tiny: Dataset) -> None:
    identity = tiny.part(*tiny.parts.keys_of(0)[0]).identity.model_copy(update={"seed": None})
    assert isinstance(operation_of(identity, "here"), Import)
    with pytest.raises(BuildError, match="its seed or its policy is not known"):
        Import(Record()).episodes(WantedPart({}, tiny.task(0), 0), Sources())


@pytest.mark.usefixtures("in_process")
def test_an_operation_of_another_package_makes_a_dataset(tiny: Dataset, tmp_path: Path) -> None:
    made = apply_operation(tiny, tmp_path / "last", "last-episode", {"number": 1}, snapshots="last")
    assert [run.kind for run in made.manifest.runs] == ["derived"]
    for key in made.parts:
        (episode,) = made.trajectories(*key)
        stored = tiny.trajectories(key.task, key.step)[-1]
        assert (episode.observations == stored.observations).all()
        assert made.part(*key).identity.derived == {
            "operation": "last-episode",
            "from": [tiny.entry(PartKey(key.task, key.step)).id],
            "settings": {"number": 1},
        }
    report = verify_dataset(made.folder, level="deep", replay=2)
    assert (report.findings, report.replays) == ((), ())  # what it was made from is not here
    assert {(note.file, note.problem) for note in report.notes} == {
        (part_file(key), NO_SOURCE) for key in made.parts
    }
    assert verify_dataset(made.folder, level="deep", strict=True).findings == report.notes
    report = verify_dataset(made.folder, level="deep", replay=2, sources=[tiny])
    assert (report.findings, report.notes) == ((), ())
    assert [replay.problems for replay in report.replays] == [(), ()]
    again = apply_operation(tiny, tmp_path / "again", "last-episode", {"number": 1}, snapshots="last")
    assert again.manifest.root == made.manifest.root
    assert open_dataset(tmp_path / "last").manifest.derivation == again.manifest.derivation


@pytest.mark.usefixtures("in_process")
def test_parts_of_another_packages_operation_are_verified_and_repaired_by_it(
    tiny: Dataset, tmp_path: Path
) -> None:
    """Beside the parts that they were made from."""
    made = apply_operation(tiny, tmp_path / "noisy", "action-noise", {"sigma": 0.1}, snapshots="last")
    merge_datasets([tiny, made], tmp_path / "both")
    both = open_dataset(tmp_path / "both")
    assert verify_dataset(both.folder, level="deep").findings == ()
    (found,) = (entry for entry in both.parts.entries_of(tiny.train_tasks[0].index) if entry.run != "main")
    good = both.file_of(found.key).read_bytes()
    both.file_of(found.key).unlink()
    report = repair_dataset(both.folder)
    assert (report.repaired, report.failed, report.left) == ((found.key,), (), ())
    assert both.file_of(found.key).read_bytes() == good


@pytest.mark.parametrize(
    ("name", "settings", "text"),
    [
        ("last-episode", {"number": 0}, "number"),
        ("last-episode", {"number": 1, "count": 1}, "count"),
        ("extend", {}, "has a function of its own"),
    ],
)
def test_settings_that_an_operation_does_not_take_write_nothing(
    name: str, settings: dict[str, Any], text: str, tiny: Dataset, tmp_path: Path
) -> None:
    with pytest.raises(SelectionError, match=text):
        apply_operation(tiny, tmp_path / "out", name, settings)
    assert not (tmp_path / "out").exists()
