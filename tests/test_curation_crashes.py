"""Commands that make datasets, with file operations that fail or a power cut, and then given again."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tcmrl_data import (
    Dataset,
    derive_dataset,
    export_dataset,
    extend_dataset,
    import_dataset,
    merge_datasets,
    open_dataset,
    verify_dataset,
)
from tcmrl_data.building.work_files import ASSEMBLY
from tcmrl_data.engine.base import ENGINES, Unit
from tcmrl_data.foundation import disk as publish
from tcmrl_data.foundation.disk import STAGING, remove_abandoned
from tcmrl_data.store import tables
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.tables import PartKey
from tests.graded import graded_dataset
from tests.simulated_disk import (
    FAULTS,
    LOSSES,
    Fault,
    Operation,
    PowerCut,
    RecordingDisk,
    prepared_engine,
    run_with_fault,
)


@dataclass(frozen=True)
class Sources:
    """What the commands read.

    Attributes:
        seeds: two datasets of equal tasks.
        small: a built dataset of two parts.
        extended: that dataset after its extension; its new parts are published again as workers do.
        exported: a file that holds one task of the seeds.
    """

    seeds: list[Path]
    small: Path
    extended: Dataset
    exported: Path

    def extend(self, folder: Path, out: Path | None = None) -> None:
        """Extends the small dataset in a folder, without the seconds that rollouts take."""
        files = {key: self.extended.content(key) for key in self.extended.parts if key.run == "extended"}
        target = folder if out is None else out

        def keys_of(unit: Unit) -> Sequence[PartKey]:
            return [PartKey(*job["key"]) for job in unit.spec["jobs"]]

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                ENGINES, "get", lambda name: lambda workers: prepared_engine(target, files, keys_of)
            )
            extend_dataset(folder, out=out, episodes=3, workers=1)


Command = Callable[[Sources, Path], object]
NEW: dict[str, Command] = {
    "derive": lambda sources, out: derive_dataset(sources.seeds[0], out, tier="medium-replay"),
    "cut": lambda sources, out: derive_dataset(sources.seeds[0], out, episodes=2, tier="medium-expert"),
    "merge": lambda sources, out: merge_datasets(sources.seeds, out),
    "extend to a new dataset": lambda sources, out: sources.extend(sources.small, out),
    "import": lambda sources, out: import_dataset("hdf5", [sources.exported], out),
}
IN_PLACE: dict[str, Command] = {"extend": lambda sources, out: sources.extend(out)}
COMMANDS = NEW | IN_PLACE


@pytest.fixture(scope="module")
def sources(tiny: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Sources:
    folder = tmp_path_factory.mktemp("sources")
    scores = {0: 0.0, 100: 40.0, 200: 90.0}
    seeds = [
        graded_dataset(folder / f"{seed}", seed=seed, scores=scores, tasks=(0, 3)).folder for seed in range(2)
    ]
    exported, *_ = export_dataset(seeds[0], "hdf5", folder / "hdf5").files
    derive_dataset(tiny, folder / "small", tasks=[0, 99], snapshots="last")
    extend_dataset(folder / "small", out=folder / "extended", episodes=3, workers=2)
    return Sources(seeds, folder / "small", open_dataset(folder / "extended"), exported)


def begin(name: str, sources: Sources, out: Path) -> None:
    """Makes what stands before a command: the dataset that it changes, or the folder of the new one."""
    out.parent.mkdir(exist_ok=True)
    if name in IN_PLACE:
        shutil.copytree(sources.small, out)


def expect_whole(name: str, sources: Sources, out: Path, expected: Dataset, place: str) -> None:
    """Checks that the same command, given again, ends with each part of the reference once."""
    if name in IN_PLACE or not (out / MANIFEST).exists() or (out / ASSEMBLY).exists():
        COMMANDS[name](sources, out)
    made = open_dataset(out)
    assert made.manifest.digest == expected.manifest.digest, place
    found = sorted(file.relative_to(out) for file in out.rglob("*.zip"))
    assert found == sorted(file.relative_to(expected.folder) for file in expected.folder.rglob("*.zip")), (
        place
    )
    assert verify_dataset(out).findings == (), place
    remove_abandoned(out)
    assert list((out / STAGING).iterdir()) == [], place


def logged(name: str, sources: Sources, out: Path) -> list[Operation]:
    """All file operations of a command."""
    begin(name, sources, out)
    recorder = RecordingDisk()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(publish, "disk", recorder)
        patch.setattr(tables, "disk", recorder)
        COMMANDS[name](sources, out)
    return recorder.log


@pytest.mark.check
@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("fault", FAULTS)
def test_the_same_command_recovers_from_a_fault_at_any_operation(
    sources: Sources, memory: Path, name: str, fault: Fault, sweep: int
) -> None:
    operations = len(logged(name, sources, memory / "whole" / "data"))
    expected = open_dataset(memory / "whole" / "data")
    stride = max(1, sweep // 4)
    for at in range(FAULTS.index(fault) % stride, operations, stride):
        out = memory / f"{at}" / "data"
        begin(name, sources, out)
        status = run_with_fault(lambda: COMMANDS[name](sources, out), at, fault)  # noqa: B023
        place = f"operation {at} of {operations}"
        assert status == (-9 if fault in ("kill", "torn") else 1), place
        expect_whole(name, sources, out, expected, place)
        shutil.rmtree(out.parent)


@pytest.mark.check
@pytest.mark.parametrize("name", COMMANDS)
def test_a_power_cut_leaves_the_dataset_before_or_after(
    sources: Sources, memory: Path, name: str, sweep: int
) -> None:
    root, work = memory / "whole", memory / "cut"
    log = logged(name, sources, root / "data")
    root.rename(memory / "reference")
    begin(name, sources, root / "data")
    expected, disk = open_dataset(memory / "reference" / "data"), PowerCut(root)
    disk.load(root)
    for index, operation in enumerate(log):
        disk.apply(operation)
        if index % max(1, sweep // 4) and index != len(log) - 1:
            continue
        for loss in LOSSES:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir()
            disk.leave(work, loss)
            place = f"after operation {index} of {len(log)}, {loss} lost"
            if (work / "data" / MANIFEST).exists():
                assert all(finding.foreign for finding in verify_dataset(work / "data").findings), place
            else:
                assert index < len(log) - 1, place
            expect_whole(name, sources, work / "data", expected, place)
