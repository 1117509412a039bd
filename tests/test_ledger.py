"""What a build keeps of what it finds: the log behind the tables, dropped tasks, limits, older settings."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import tcmrl_data
from tcmrl_data import Dataset, Recipe, load_recipe, open_dataset, repair_dataset, verify_dataset
from tcmrl_data.building import ledger
from tcmrl_data.envs.base import Task
from tcmrl_data.foundation.errors import BuildError, ManifestError, TaskError
from tcmrl_data.foundation.records import sealed
from tcmrl_data.store import manifest, tables
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_COPY, read_manifest
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import PartKey, check_plan, parse_tasks, part_file, task_line
from tests.conftest import TINY
from tests.simulated_disk import PreparedParts, at_last_part

pytestmark = pytest.mark.usefixtures("module_in_process")

TASK = 3
LAST = PartKey(TASK, 150)
SHORT = (
    *TINY,
    "behavior.sac.steps=20",
    "behavior.sac.warmup=10",
    "behavior.sac.snapshots=[0,20]",
)
GROUP = (
    "behavior.stacked.group=4",
    "behavior.stacked.steps=30",
    "behavior.stacked.warmup=10",
    "behavior.stacked.snapshots=[0,30]",
    "behavior.stacked.hidden=[16,16]",
    "behavior.stacked.batch_size=16",
    "rollouts.episodes=2",
    "rollouts.lanes=2",
)


@pytest.fixture(scope="module")
def parts(tiny: Dataset, tiny_recipe: Recipe) -> PreparedParts:
    return PreparedParts(tiny, tiny_recipe, [TASK])


@pytest.fixture
def unsealed(parts: PreparedParts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset with three published parts, whose lines stand behind the sealed ones."""
    at_last_part(parts, tmp_path / "data", monkeypatch)
    assert read_manifest(tmp_path / "data").totals.parts == 0
    return tmp_path / "data"


def ids(folder: Path) -> dict[PartKey, str]:
    return {entry.key: entry.id for entry in open_dataset(folder).recorded_parts.entries()}


def expect_whole(parts: PreparedParts, tiny: Dataset, folder: Path) -> None:
    """Checks that a dataset holds each prepared part once and that verification agrees."""
    assert list(open_dataset(folder).parts.entries()) == tiny.parts.entries_of(TASK)
    assert read_manifest(folder).complete
    assert len((folder / PARTS_TABLE).read_bytes().splitlines()) == 1 + len(parts.files)
    assert verify_dataset(folder).findings == ()


def test_lines_behind_the_seal_are_taken_in_without_reading_the_parts(
    parts: PreparedParts, unsealed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = unsealed / part_file(LAST)
    data = bytearray(file.read_bytes())
    data[100] ^= 1  # what a verification names, but a resumed build does not read
    file.write_bytes(data)
    report = parts.build(unsealed, monkeypatch)
    assert (report.built, report.present) == (0, 3)
    (finding,) = verify_dataset(unsealed).findings
    assert (finding.key, finding.problem) == (LAST, "content does not have the recorded sha256")


def last_line(change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Changes the last line of a table."""

    def changed(table: bytes) -> bytes:
        lines = table.splitlines(keepends=True)
        return b"".join(lines[:-1]) + change(lines[-1])

    return changed


def with_value(column: str, value: Any) -> Callable[[bytes], bytes]:
    place = ledger.PartEntry._fields.index(column)

    def changed(line: bytes) -> bytes:
        values = json.loads(line)
        values[place] = value
        return tcmrl_data.canonical_json(values)

    return last_line(changed)


WRONG_LOGS: dict[str, Callable[[bytes], bytes]] = {
    "a torn line": last_line(lambda line: line[: len(line) // 2]),
    "no JSON": last_line(lambda line: b"\xff\x00[\n"),
    "two in one": last_line(lambda line: line[:-1] + b"," + line),
    "an unknown platform": with_value("platform", 7),
    "another size": with_value("size", 12),
    "a part that no plan has": with_value("step", 151),
    "zeros": lambda table: table.splitlines(keepends=True)[0] + b"\0" * 700,
    "a line twice": last_line(lambda line: line + line),
    "rubbish after all": last_line(lambda line: line + b"\0" * 30),
}


@pytest.mark.parametrize("wrong", WRONG_LOGS)
@pytest.mark.parametrize("kept", [True, False], ids=["part kept", "part lost"])
def test_wrong_lines_behind_the_seal_are_cut_off(
    parts: PreparedParts,
    tiny: Dataset,
    unsealed: Path,
    monkeypatch: pytest.MonkeyPatch,
    wrong: str,
    kept: bool,
) -> None:
    table = unsealed / PARTS_TABLE
    table.write_bytes(WRONG_LOGS[wrong](table.read_bytes()))
    if not kept:
        (unsealed / part_file(LAST)).unlink()
    report = parts.build(unsealed, monkeypatch)
    assert (report.built, report.present, report.failed) == (not kept, 2 + kept, ())
    expect_whole(parts, tiny, unsealed)


def test_rubbish_behind_the_tables_of_a_finished_dataset_is_cut_off(
    parts: PreparedParts, tiny: Dataset, unsealed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts.build(unsealed, monkeypatch)
    for name in ("tasks.jsonl", PARTS_TABLE):
        with (unsealed / name).open("ab") as file:
            file.write(b"\0\0\n")
    assert len(verify_dataset(unsealed).findings) == 2
    parts.build(unsealed, monkeypatch)
    expect_whole(parts, tiny, unsealed)


def interrupted_at(number: int, run: Callable[[], object]) -> bool:
    """Runs something, with Ctrl-C in front of a line of the ledger or the tables; False if none came."""
    left = number
    modules = {ledger.__file__, tables.__file__}

    def count(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal left
        if frame.f_code.co_filename not in modules:
            return None
        if event == "line":
            left -= 1
            if left < 0:
                raise KeyboardInterrupt
        return count

    sys.settrace(count)
    try:
        run()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(None)
    return False


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of files left open
def test_ctrl_c_at_any_line_leaves_tables_and_manifest_in_agreement(
    parts: PreparedParts, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sweep: int
) -> None:
    monkeypatch.setattr(ledger, "SEAL_SECONDS", 0.0)
    for number in range(7, 10_000, 2 * sweep):
        out = tmp_path / str(number)
        interrupted = interrupted_at(number, lambda: parts.build(out, monkeypatch))  # noqa: B023
        if (out / MANIFEST).exists():
            assert [found for found in verify_dataset(out).findings if not found.foreign] == [], number
        parts.build(out, monkeypatch)
        expect_whole(parts, tiny, out)
        if not interrupted:
            break
    assert number > 300


def test_a_dropped_task_does_not_count_until_it_is_named_again(
    tiny: Dataset, tiny_folder: Path, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts, out = PreparedParts(tiny, tiny_recipe, [0, TASK]), tmp_path / "data"
    parts.build(out, monkeypatch, tasks=[0])
    alone = read_manifest(out).root
    (out / part_file(PartKey(TASK, 0))).parent.mkdir()
    shutil.copyfile(tiny.file_of(PartKey(TASK, 0)), out / part_file(PartKey(TASK, 0)))
    for options in ({"tasks": [0], "dropped": [TASK]}, {"tasks": [0]}):
        tcmrl_data.build_dataset(tiny_recipe, out, **options)  # type: ignore[arg-type]
        found = read_manifest(out)
        assert (found.complete, found.num_tasks, found.dropped, found.root) == (True, 1, (TASK,), alone)
        assert [task.index for task in open_dataset(out).tasks] == [0]
        (unnamed,) = verify_dataset(out).findings
        assert unnamed.foreign and f"delete it, or build with --tasks {TASK}" in unnamed.problem
    report = parts.build(out, monkeypatch, tasks=[TASK])
    assert (report.built, report.present) == (2, 4)
    assert (read_manifest(out).dropped, verify_dataset(out).findings) == ((), ())
    assert ids(out) == {key: entry for key, entry in ids(tiny_folder).items() if key.task in (0, TASK)}
    tcmrl_data.build_dataset(tiny_recipe, out, tasks=[0], dropped=[TASK])
    found = read_manifest(out)
    assert (found.root, found.totals.parts, found.num_expected, found.complete) == (alone, 3, 3, True)
    assert len(ids(out)) == 6
    assert (out / part_file(LAST)).is_file()
    assert verify_dataset(out).findings == ()


def test_the_other_tasks_of_a_group_keep_their_ids_when_one_is_dropped(tmp_path: Path) -> None:
    recipe = load_recipe("point-robot", profile="quick", overrides=GROUP, behavior="stacked")
    tcmrl_data.build_dataset(recipe, tmp_path / "all", tasks=[1, 2, 3])
    tcmrl_data.build_dataset(recipe, tmp_path / "dropped", tasks=[1, 3], dropped=[2])
    whole = ids(tmp_path / "all")
    assert ids(tmp_path / "dropped") == {key: entry for key, entry in whole.items() if key.task != 2}
    tcmrl_data.build_dataset(recipe, tmp_path / "dropped", tasks=[1, 2, 3])
    assert ids(tmp_path / "dropped") == whole
    assert read_manifest(tmp_path / "dropped").root == read_manifest(tmp_path / "all").root


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": [0, 3], "dropped": [3]}, "task 3 is to be built and to be dropped"),
        ({"dropped": [100]}, "task index 100 does not exist, the tasks are 0-99"),
        ({"dropped": [-1]}, "task index -1 does not exist"),
    ],
)
def test_tasks_that_cannot_be_dropped_are_refused(
    tiny_recipe: Recipe, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(TaskError, match=message):
        tcmrl_data.build_dataset(tiny_recipe, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("limit", ["MAX_TASKS", "MAX_PARTS", "MAX_STEPS", "MAX_COLUMNS"])
def test_a_dataset_at_a_limit_is_built_and_read_and_one_beyond_is_refused_before_work(
    parts: PreparedParts, tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    environment = tiny.environment
    largest = {
        "MAX_TASKS": 1,
        "MAX_PARTS": 3,
        "MAX_STEPS": 3,
        "MAX_COLUMNS": max(environment.observation_dim, environment.action_dim),
    }[limit]

    def allow(number: int) -> None:
        for module in (tables, manifest):
            monkeypatch.setattr(module, limit, number, raising=False)

    allow(largest - 1)
    with pytest.raises(
        BuildError, match=f"the dataset would have {largest:,} .* more than the {largest - 1:,} "
    ):
        parts.build(tmp_path / "data", monkeypatch)
    assert not (tmp_path / "data").exists()
    allow(largest)
    parts.build(tmp_path / "data", monkeypatch)
    expect_whole(parts, tiny, tmp_path / "data")


@pytest.mark.check
def test_the_limits_of_tasks_and_of_parts_are_those_that_are_stated(tmp_path: Path) -> None:
    many = ("environment.tasks=100001", "environment.train=100000")
    with pytest.raises(BuildError, match="100,001 tasks, more than the 100,000 that"):
        tcmrl_data.build_dataset(
            load_recipe("point-robot", profile="quick", overrides=[*TINY, *many]),
            tmp_path / "out",
            tasks=range(100_001),
        )
    steps = ",".join(map(str, range(0, 20_002, 2)))
    long = (f"behavior.sac.snapshots=[{steps}]", "behavior.sac.steps=20000", "behavior.sac.warmup=1")
    long += ("behavior.sac.train_frequency=1",)
    recipe = load_recipe("point-robot", profile="quick", overrides=[*TINY, *long])
    with pytest.raises(BuildError, match="1,000,100 parts, more than the 1,000,000 that"):
        tcmrl_data.build_dataset(recipe, tmp_path / "out", tasks=range(100))
    assert not (tmp_path / "out").exists()


def test_the_longest_line_of_a_task_that_a_writer_may_write_is_read() -> None:
    length = tables.LINE_BYTES - len(task_line(Task(7, "train", {"text": ""})))
    check_plan(tasks=1, steps=1, columns=1, largest_task=tables.LINE_BYTES)
    with pytest.raises(BuildError, match="65,537 bytes for the parameters of one task, more than the 65,536"):
        check_plan(tasks=1, steps=1, columns=1, largest_task=tables.LINE_BYTES + 1)
    task = Task(7, "train", {"text": "x" * length})
    assert len(task_line(task)) == tables.LINE_BYTES
    assert parse_tasks(task_line(task), Path("tasks.jsonl")) == (task,)


@pytest.mark.parametrize(("table", "most"), [("tasks", 100_000), ("parts", 1_000_001)])
def test_a_manifest_seals_as_many_lines_as_a_writer_may_write(
    tiny_copy: Callable[[], Path], table: str, most: int
) -> None:
    file = tiny_copy() / MANIFEST
    for lines, is_read in ((most, True), (most + 1, False)):
        fields = json.loads(file.read_bytes())
        del fields["digest"]
        fields[table]["lines"] = lines
        file.write_bytes(sealed(fields))
        if is_read:
            assert read_manifest(file).num_tasks in (5, most)
        else:
            with pytest.raises(ManifestError, match="at most 100000 tasks and 1000000 parts"):
                read_manifest(file)


def test_a_field_with_a_new_default_leaves_older_datasets_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dataset half built before `behavior.observation` existed, with parts in a table, a log and none."""
    recipe, out = load_recipe("point-robot", profile="quick", overrides=SHORT), tmp_path / "data"
    settings = Recipe.unit_settings

    def older(self: Recipe) -> dict[str, Any]:
        fields = settings(self)
        del fields["behavior"]["observation"]
        return fields

    with monkeypatch.context() as patch:
        patch.setattr(Recipe, "unit_settings", older)
        tcmrl_data.build_dataset(recipe, out, tasks=[0])
    fields = json.loads((out / MANIFEST).read_bytes())
    for table in (fields, fields["runs"][0]["recipe"]["behavior"]):
        table.pop("digest", None)
        table.pop("observation", None)
    (out / MANIFEST).write_bytes(sealed(fields))
    old = ids(out)
    assert verify_dataset(out, level="deep", replay=2).findings == ()
    report = tcmrl_data.build_dataset(recipe, out, tasks=[3])
    assert (report.built, report.present, report.failed) == (2, 2, ())
    assert {key: ids(out)[key] for key in old} == old
    assert verify_dataset(out, level="deep").findings == ()
    (out / part_file(PartKey(3, 20))).unlink()
    assert repair_dataset(out).failed == ()
    for name in (MANIFEST, MANIFEST_COPY, PARTS_TABLE, "tasks.jsonl"):
        (out / name).unlink()
    report = tcmrl_data.build_dataset(recipe, out, tasks=[0, 3])
    assert (report.built, report.present) == (0, 4)
    other = load_recipe("point-robot", profile="quick", overrides=[*SHORT, "behavior.observation=full"])
    with pytest.raises(BuildError, match=r"behavior.observation is stored there and full here"):
        tcmrl_data.build_dataset(other, out, tasks=[0])
