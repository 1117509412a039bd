"""Bad input for every command of the manager: exit code 2, one line that names it, and nothing written."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tcmrl_cli.data import data

from tcmrl_data import (
    derive_dataset,
    export_dataset,
    import_dataset,
    merge_datasets,
    rename_dataset,
    split_dataset,
)
from tcmrl_data.foundation.errors import StoreError
from tests.commands import assert_refused, in_process
from tests.graded import graded_dataset

SCORES = {0: 0.0, 100: 40.0, 200: 90.0}

CASES: dict[str, tuple[str, tuple[str, ...]]] = {
    "derive, unknown tier": ("derive {data} --tier best --out {new}", ("'best'", "medium-replay")),
    "derive, no reference scores": (
        "derive {imported} --tier medium --out {new}",
        ("{imported}", "no return of uniform actions is known"),
    ),
    "derive, no dataset": ("derive {folder} --out {new}", ("{folder}",)),
    "merge, tasks disagree": (
        "merge {data} {moved} --out {new}",
        ("task 0: goal", "[9.0, 9.0]", "{data}", "{moved}"),
    ),
    "split, output exists": (
        "derive {data} --episodes 2,2 --names used,x --out {folder}",
        ("{used}", "exists"),
    ),
    "split, view exists": (
        "derive {data} --folds 2 --names file,x --view {folder}",
        ("{file}", "exists"),
    ),
    "delete, no dataset": ("delete {folder} --yes", ("{folder}", "no dataset")),
    "diff, unknown level": ("diff {data} {other} --level deep", ("'deep'",)),
    "extend, no policies": ("extend {data} --episodes 4 --out {new}", ("no policy",)),
    "extend, no seeds": ("extend {imported} --episodes 4 --out {new}", ("imported", "not known")),
    "relabel, unknown targets": ("relabel {data} --to nearest --out {new}", ("nearest:K",)),
    "relabel, no seeds": ("relabel {imported} --to 0 --out {new}", ("imported", "not known")),
    "relabel, another platform": (
        "relabel {data} --to 1 --out {new}",
        ("{data}", "was made on another platform"),
    ),
    "export, unknown tier": (
        "export {data} --format hdf5 --snapshots tier:best --out {new}",
        ("best", "medium"),
    ),
    "export, no reference scores": (
        "export {imported} --format hdf5 --snapshots tier:medium --out {new}",
        ("{imported}", "no return of uniform actions is known"),
    ),
}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Names in the cases, and what they stand for."""
    folder = tmp_path_factory.mktemp("places")
    made = {
        "data": graded_dataset(folder / "data", scores=SCORES).folder,
        "other": graded_dataset(folder / "other", scores=SCORES, seed=1).folder,
        "moved": graded_dataset(folder / "moved", scores=SCORES, moved=True).folder,
    }
    exported, *_ = export_dataset(graded_dataset(folder / "z", scores=SCORES), "hdf5", folder / "hdf5").files
    import_dataset("hdf5", [exported], folder / "imported")
    things = folder / "things"
    (things / "used").mkdir(parents=True)
    (things / "used" / "notes.txt").write_text("mine")
    (things / "file.json").write_text("{}")
    more = {
        "imported": folder / "imported",
        "exported": exported,
        "folder": things,
        "used": things / "used",
        "file": things / "file.json",
        "new": folder / "new",
    }
    return {name: str(path) for name, path in (made | more).items()} | {"empty": ""}


def contents(folder: Path) -> dict[str, bytes | None]:
    """All files and folders with their bytes."""
    return {str(path): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_refused_in_a_line(
    case: str, places: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    command, expected = CASES[case]
    root = Path(places["data"]).parent
    before = contents(root)
    arguments = [word.format(**places) for word in command.split()]
    result = in_process(data, capsys)(*arguments, "--quiet")
    assert_refused(result, *(text.format(**places) for text in expected))
    assert contents(root) == before


Command = Callable[[Path, Path, Callable[[int, int], None]], object]
CHANGED: dict[str, Command] = {
    "derive": lambda source, out, progress: derive_dataset(source, out, progress=progress),
    "cut": lambda source, out, progress: derive_dataset(source, out, episodes=2, progress=progress),
    "merge": lambda source, out, progress: merge_datasets(
        [source, source.with_name("other")], out, progress=progress
    ),
    "split": lambda source, out, progress: split_dataset(source, out, folds=2, progress=progress),
}


@pytest.mark.parametrize("command", CHANGED)
def test_a_source_that_changes_meanwhile_is_noticed(command: str, tmp_path: Path) -> None:
    for seed, name in enumerate(("data", "other")):
        graded_dataset(tmp_path / name, scores={0: 0.0, 100: 50.0}, tasks=range(4), seed=seed)
    source, out = tmp_path / "data", tmp_path / "out"

    def change(done: int, total: int) -> None:
        if done == 1:
            rename_dataset(source, "renamed meanwhile")

    with pytest.raises(StoreError, match=r"data has changed meanwhile"):
        CHANGED[command](source, out, change)
    assert not list(out.rglob("manifest.json"))
