"""`verify --clean` removes only unused files; what the commands of verification print."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tcmrl_cli.data import data
from tcmrl_cli.frame import run

from tcmrl_data import verify_dataset
from tcmrl_data.foundation.disk import CHECKPOINTS, LOCK, STAGING
from tcmrl_data.foundation.errors import (
    LockedError,
)
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.tables import PartKey, part_file
from tcmrl_data.verification.cleaning import collect_garbage
from tests.damage import littered

Copy = Callable[[], Path]


def test_gc_takes_what_is_dead_and_a_dry_run_only_says_so(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    expected = littered(folder)
    before = {path: path.lstat().st_mtime_ns for path in folder.rglob("*")}
    dry = collect_garbage(folder, dry_run=True)
    assert {path: path.lstat().st_mtime_ns for path in folder.rglob("*")} == before
    assert {removed.path: removed.bytes for removed in dry} == dict(
        zip(sorted(expected), (7, 1, 5), strict=True)
    )
    assert collect_garbage(folder) == dry
    assert list((folder / STAGING).iterdir()) == []
    assert [path.name for path in (folder / CHECKPOINTS).iterdir()] == ["task_00007"]
    assert collect_garbage(folder) == ()
    assert verify_dataset(folder).findings == ()


def test_gc_spares_a_live_attempt_and_is_refused_during_a_build(tiny_copy: Copy) -> None:
    folder = tiny_copy()
    littered(folder)
    attempt = folder / STAGING / "task_00003.dead"
    holder = "import sys; from tcmrl_data.foundation.disk import lock_file; from pathlib import Path\n"
    holder += "with lock_file(Path(sys.argv[1]), 'x'):\n    print('held', flush=True)\n    sys.stdin.read()"
    for lock, is_refused in ((attempt.with_name("task_00003.dead.lock"), False), (folder / LOCK, True)):
        command = [sys.executable, "-c", holder, str(lock)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"held\n"
            if is_refused:
                for dry_run in (True, False):
                    with pytest.raises(LockedError, match=f"process {process.pid}"):
                        collect_garbage(folder, dry_run=dry_run)
            else:
                assert f"{STAGING}/{attempt.name}" not in {
                    removed.path for removed in collect_garbage(folder)
                }
                assert (attempt / "x").exists()
            process.communicate(b"")


@pytest.mark.check
def test_the_commands_say_what_they_found_and_did(
    tiny_copy: Copy, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tiny_copy()
    assert run(data, ["verify", str(folder), "--deep", "--replay", "1"]) == 0
    assert "15 parts" in capsys.readouterr().out
    name = part_file(PartKey(3, 0))
    (folder / name).unlink()
    assert run(data, ["verify", str(folder / MANIFEST), "--quiet"]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines()[0] == f"{name}: is missing"
    assert printed.err.startswith(f"Error: {folder}: 1 finding; ")
    assert run(data, ["verify", str(folder), "--json", "--quick"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["findings"] == [
        {"file": name, "problem": "is missing", "task": 3, "step": 0, "run": "main", "foreign": False}
    ]
    assert run(data, ["verify", str(folder), "--repair", "--workers", "1", "--quiet"]) == 0
    assert "task 3, step 0, run main: regenerated, same id" in capsys.readouterr().out
    littered(folder)
    assert run(data, ["verify", str(folder), "--clean", "--dry-run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] == 13
    assert run(data, ["verify", str(folder), "--clean"]) == 0
    assert "3 items, 13 B removed" in capsys.readouterr().out
    for options in (["--quick", "--deep"], [], ["--repair"], ["--clean"]):
        assert run(data, ["verify", str(folder / "parts/main"), *options]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
