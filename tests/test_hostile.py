"""A hostile dataset cannot run code, lead out of its folder, block, write, or exhaust memory."""

import contextlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tcmrl_cli.data import data
from tcmrl_cli.frame import run

import tcmrl_data
from tcmrl_data import TcmrlError, open_dataset, verify_dataset
from tcmrl_data.verification import repair as repair_module
from tcmrl_data.verification.description import Finding
from tests.hostile.arrays import CHUNKS
from tests.hostile.bounds import bounded
from tests.hostile.case import Case
from tests.hostile.corpus import CASES, CORPUS
from tests.hostile.datasets import FORGED_TASKS, Forge, base, copies_of
from tests.hostile.files import FILES
from tests.hostile.manifests import MANIFESTS
from tests.hostile.records import ARCHIVES, RECORDS
from tests.hostile.tables import PART_TABLES, PLACES, TASK_TABLES

MEMORY_RATIO = 8
"""A case may make the process grow by 8 times its size on disk, beside the floor of all cases."""

SAMPLED = 8
"""`make test` tries every eighth case of each kind, `make check` all."""

COMMANDS = [
    "inspect tasks",
    "inspect episodes",
    "inspect returns",
    "list",
    "show",
    "verify --clean --dry-run",
    "verify --quiet --strict",
]
Findings = tuple[Finding, ...]
opened: list[str] = []
watching = False


def _note_open(event: str, arguments: tuple[Any, ...]) -> None:
    if watching and event == "open" and isinstance(arguments[0], str | bytes):
        opened.append(os.path.realpath(os.fsdecode(arguments[0])))


sys.addaudithook(_note_open)


@pytest.fixture(scope="module")
def two_parts(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = base(tiny_folder, tmp_path_factory.mktemp("hostile") / "base")
    everything(folder)  # the memory of imports and caches is not counted
    return folder


@pytest.fixture
def forge(two_parts: Path, tmp_path: Path) -> Forge:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret").write_text("secret")
    shutil.copytree(two_parts, tmp_path / "data")
    return Forge(tmp_path / "data", outside)


def look(folder: Path) -> tuple[str, str]:
    """Opens and reads everything; returns the stage that refused, and its message."""
    try:
        dataset = open_dataset(folder)
    except TcmrlError as error:
        return "open", str(error)
    try:
        keys = list(dataset.parts)
        assert len(dataset.tasks) <= len(FORGED_TASKS)
    except TcmrlError as error:
        return "tables", str(error)
    try:
        for key in keys:
            assert dataset.trajectories(*key)
            assert dataset.snapshot(*key).digest()
    except TcmrlError as error:
        return "read", str(error)
    return "verify", ""


def everything(folder: Path) -> tuple[str, str, Findings, Findings, Findings, dict[str, int]]:
    """All that only reads: stage and message of `look`, findings by level, and exit codes of the commands."""
    stage, message = look(folder)
    quick = verify_dataset(folder, level="quick", replay=1, strict=True).findings
    digests = verify_dataset(folder, strict=True).findings
    deep = verify_dataset(folder, level="deep", replay=1, strict=True).findings
    codes = {command: run(data, [*command.split(), str(folder)]) for command in COMMANDS}
    return stage, message, quick, digests, deep, codes


def files_of(folder: Path) -> dict[str, tuple[int, int, int]]:
    status = {str(path): path.lstat() for path in [folder, *folder.rglob("*")]}
    return {path: (entry.st_mode, entry.st_size, entry.st_mtime_ns) for path, entry in status.items()}


@contextlib.contextmanager
def contained(forge: Forge) -> Iterator[None]:
    """Fails if code ran, a path outside was opened, memory grew, or a command hung."""
    global watching
    on_disk = sum(size for _, size, _ in files_of(forge.folder.parent).values())
    opened.clear()
    with bounded(on_disk, ratio=MEMORY_RATIO):
        watching = True
        try:
            yield
        finally:
            watching = False
    assert not forge.marker.exists(), "code of the dataset ran"
    assert [path for path in opened if Path(path).is_relative_to(forge.outside)] == []


@contextlib.contextmanager
def guarded(forge: Forge) -> Iterator[None]:
    """`contained`, and fails if a file changed."""
    before = files_of(forge.folder.parent)
    with contained(forge):
        yield
    assert files_of(forge.folder.parent) == before


def test_the_base_of_the_corpus_is_sound(two_parts: Path) -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    assert look(two_parts) == ("verify", "")
    assert verify_dataset(two_parts, level="deep", replay=1).findings == ()


def named(case: Case, *marks: pytest.MarkDecorator) -> Any:
    return pytest.param(case, id=case.name.replace(" ", "-"), marks=marks)


@pytest.mark.parametrize(
    "case",
    [
        named(case, *([] if position % SAMPLED == 0 else [pytest.mark.check]))
        for cases in CORPUS
        for position, case in enumerate(cases)
    ],
)
def test_a_hostile_dataset_is_refused(forge: Forge, case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    case.damage(forge)
    with guarded(forge):
        stage, message, quick, digests, findings, codes = everything(forge.folder)
    printed = capsys.readouterr()
    assert stage == case.stage, message
    if stage != "verify":
        assert case.file in message
        assert [words for words in case.words if words not in message] == []
    named = [finding for finding in findings if case.file in finding.file]
    assert any(all(words in finding.problem for words in case.words) for finding in named), findings
    assert codes.pop("inspect tasks") == (2 if stage in ("open", "tables") else 0)
    assert codes.pop("list") == 0
    assert codes.pop("verify --quiet --strict") == (1 if digests else 0)
    assert {finding.file for finding in (*quick, *digests)} <= {finding.file for finding in findings}
    assert set(codes.values()) <= {0, 1, 2}
    assert "Traceback" not in printed.err
    assert all(character.isprintable() for character in (printed.out + printed.err).replace("\n", ""))


WRITERS: dict[str, Callable[[Path], object]] = {
    "build": lambda folder: tcmrl_data.build_dataset(
        open_dataset(folder).manifest.recipe, folder, tasks=list(FORGED_TASKS)
    ),
    "repair": tcmrl_data.repair_dataset,
    "gc": tcmrl_data.collect_garbage,
}


REPAIRED = [
    *TASK_TABLES,
    *PART_TABLES,
    *PLACES,
    *FILES,
    *MANIFESTS[::4],
    *ARCHIVES[::8],
    *RECORDS[::4],
    *CHUNKS[::4],
]


@pytest.mark.parametrize(
    "case",
    [
        named(case, pytest.mark.check if position % 8 == 0 else pytest.mark.exhaustive)
        for position, case in enumerate(REPAIRED)
    ],
)
def test_a_repair_or_gc_of_a_hostile_dataset_leads_nowhere(
    forge: Forge, case: Case, two_parts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parts come from the sound dataset, so that no case takes the time of a training."""
    monkeypatch.setattr(repair_module, "build_dataset", copies_of(two_parts))
    case.damage(forge)
    before = files_of(forge.outside)
    with contained(forge):
        for command in (tcmrl_data.collect_garbage, tcmrl_data.repair_dataset):
            with contextlib.suppress(TcmrlError):
                command(forge.folder)
    assert files_of(forge.outside) == before


LINKS = {
    **dict.fromkeys(
        (".lock", "status.json", ".staging/task.lock", ".checkpoints/task_00000/state.json"), "secret"
    ),
    **dict.fromkeys((".staging", ".checkpoints", ".staging/repair", ".checkpoints/task_00000"), ""),
}
"""Work files and folders, and where a stranger's links in their places lead.

Links in the places of files are replaced by files; a folder that is a link is refused.
"""


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("command", WRITERS)
def test_nothing_is_written_through_a_link(forge: Forge, name: str, command: str) -> None:
    (forge.folder / name).parent.mkdir(parents=True, exist_ok=True)
    (forge.folder / name).symlink_to(forge.outside / LINKS[name])
    before = files_of(forge.outside)
    with contextlib.nullcontext() if LINKS[name] else pytest.raises(TcmrlError, match=name):
        WRITERS[command](forge.folder)
    assert files_of(forge.outside) == before


def test_show_prints_a_strangers_record_without_obeying_it(
    forge: Forge, capsys: pytest.CaptureFixture[str]
) -> None:
    status = {"time": 1.0, "parts_done": 0, "parts_total": 1, "steps_done": 0, "steps_total": 1}
    status |= {"running": [], "warnings": [], "num_failed": 1, "steps_per_second": None}
    for failed in ("c\x1b[2J[red]",), ({},):
        (forge.folder / "status.json").write_text(json.dumps({**status, "failed": failed}))
        assert run(data, ["show", str(forge.folder)]) == 0
    printed = capsys.readouterr().out
    assert r"c\x1b[2J[red]" in printed
    assert printed.count("failed") == 1
