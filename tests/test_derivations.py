"""Cut parts that are made again from their sources."""

from pathlib import Path

import pytest

from tcmrl_data import Dataset, derive_dataset, open_dataset, split_dataset, verify_dataset
from tcmrl_data.parts.making import make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.store.manifest import write_dataset
from tcmrl_data.store.part_table import PartTable, part_entry
from tcmrl_data.store.tables import PartKey, part_file
from tests.graded import graded_dataset


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> list[Dataset]:
    folder = tmp_path_factory.mktemp("seeds")
    return [graded_dataset(folder / f"seed{seed}", seed=seed) for seed in range(2)]


def problems(folder: Path, *sources: Dataset) -> list[str]:
    report = verify_dataset(folder, level="deep", sources=sources)
    return [f"{finding.file}: {finding.problem}" for finding in report.findings]


@pytest.mark.check
def test_sound_derivations_come_out_again(seeds: list[Dataset], tmp_path: Path) -> None:
    first = seeds[0]
    derive_dataset(first, tmp_path / "tier", tier="medium-expert", split="train")
    derive_dataset(first, tmp_path / "cut", episodes=2, seed=4, min_return=1.0)
    split_dataset(first, tmp_path / "halves", episodes=[2, 2])
    for name in ("tier", "cut", "halves/0", "halves/1"):
        assert problems(tmp_path / name) == problems(tmp_path / name, first) == [], name


def reseal(dataset: Dataset, **changes: object) -> None:
    """Writes tables and manifest anew, as someone does who forges a dataset."""
    manifest = dataset.manifest
    settings = {
        "label": manifest.label,
        "data_version": manifest.data_version,
        "runs": manifest.runs,
        "derivation": manifest.derivation,
        "platforms": manifest.platforms,
        "tasks": dataset.tasks,
        "table": dataset.parts,
    }
    write_dataset(dataset.folder, **(settings | changes))  # type: ignore[arg-type]


@pytest.mark.check
def test_a_forged_part_is_found(seeds: list[Dataset], tmp_path: Path) -> None:
    derive_dataset(seeds[0], tmp_path / "cut", episodes=2)
    made, key = open_dataset(tmp_path / "cut"), PartKey(1, 300)
    record, episodes = made.part(*key), made.trajectories(*key)
    for episode in episodes:
        episode.rewards[...] += 1
    forged, archive = make_part(
        WantedPart(
            settings=record.identity.settings,
            task=made.task(1),
            step=300,
            seed=record.identity.seed,
            derived=record.identity.derived,
        ),
        episodes,
        references=record.references,
    )
    made.file_of(key).write_bytes(archive)
    entries = [entry for entry in made.parts.entries() if entry.key != key]
    entries.append(part_entry(forged, run="main", platform=0, archive=archive))
    reseal(made, table=PartTable.empty().with_entries(entries))
    assert problems(tmp_path / "cut") == []
    (problem,) = problems(tmp_path / "cut", seeds[0])
    assert problem.startswith(f"{part_file(key)}: made again: rewards differs in ")


@pytest.mark.parametrize(
    ("derived", "expected"),
    [
        ({"from": []}, "does not name the one part"),
        ({"settings": {"episodes": "0-9", "without": []}}, "does not name 2 episodes"),
        ({"settings": {"episodes": "0-99999999999", "without": []}}, "index nor a range"),
        ({"settings": {"episodes": "0-1", "without": ["rewards"]}}, "names an array that is there"),
        ({"settings": {}}, "does not say which"),
    ],
)
def test_a_part_that_contradicts_its_origin_is_found_without_the_source(
    seeds: list[Dataset], tmp_path: Path, derived: dict[str, object], expected: str
) -> None:
    derive_dataset(seeds[0], tmp_path / "cut", tasks=[0], snapshots="last", episodes=2)
    made = open_dataset(tmp_path / "cut")
    (key,) = made.parts
    record = made.part(*key)
    assert record.identity.derived is not None
    forged, archive = make_part(
        WantedPart(
            settings=record.identity.settings,
            task=made.task(0),
            step=key.step,
            seed=0,
            derived=record.identity.derived | derived,
        ),
        made.trajectories(*key),
        references=record.references,
    )
    made.file_of(key).write_bytes(archive)
    reseal(
        made,
        table=PartTable.empty().with_entries([part_entry(forged, run="main", platform=0, archive=archive)]),
    )
    (problem,) = problems(tmp_path / "cut")
    assert expected in problem
