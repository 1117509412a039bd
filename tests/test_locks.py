"""Locks of writers: exclusive between processes and within one, and never disturbed by those who ask."""

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tcmrl_data import build_status
from tcmrl_data.foundation import locks
from tcmrl_data.foundation.disk import LOCK, lock_file, lock_holder
from tcmrl_data.foundation.errors import LockedError
from tests.disks import read_only, run_mounted
from tests.workers import PATIENCE, wait_for

STARTS = 1_000

ASK = """
import sys
from pathlib import Path
from tcmrl_data import build_status
from tcmrl_data.foundation.disk import lock_holder
print("asking", flush=True)
while True:
    if sys.argv[2] == "status":
        build_status(Path(sys.argv[1]))
    else:
        lock_holder(Path(sys.argv[1]) / ".lock")
"""

WRITE = """
import sys
from pathlib import Path
from tcmrl_data.foundation.disk import lock_file
from tcmrl_data.foundation.errors import LockedError
tally, taken = Path(sys.argv[1]) / "tally", 0
while taken < 300:
    try:
        with lock_file(Path(sys.argv[1]) / ".lock", "the tally"):
            tally.write_text(str(int(tally.read_text()) + 1))
            taken += 1
    except LockedError:
        pass
"""


@pytest.fixture
def ask(tiny_folder: Path) -> Iterator[None]:
    """Two processes that ask for the dataset's lock as often as they can."""
    askers = [
        subprocess.Popen(
            [sys.executable, "-c", ASK, str(tiny_folder), how], stdout=subprocess.PIPE, text=True
        )
        for how in ("status", "lock")
    ]
    for asker in askers:
        assert asker.stdout is not None
        assert asker.stdout.readline() == "asking\n"
    yield
    for asker in askers:
        assert asker.poll() is None  # they asked until the end
        asker.kill()
        asker.communicate()


@pytest.mark.check
@pytest.mark.skipif(not locks.HAS_OPEN_FILE_LOCKS, reason="with flock, a writer can be refused while asked")
def test_no_writer_is_refused_while_others_ask(ask: None, tiny_folder: Path) -> None:
    for _ in range(STARTS):
        with lock_file(tiny_folder / LOCK, "dataset"):
            pass
    assert lock_holder(tiny_folder / LOCK) is None


@pytest.mark.skipif(not locks.HAS_OPEN_FILE_LOCKS, reason="with flock, asking takes the lock")
def test_who_asks_takes_no_lock_even_if_suspended_before_closing_the_file(tmp_path: Path) -> None:
    (tmp_path / LOCK).touch()
    with (tmp_path / LOCK).open("rb") as asked:
        assert not locks.is_locked(asked)
        with lock_file(tmp_path / LOCK, "dataset"):
            assert locks.is_locked(asked)


def test_writers_exclude_each_other(tmp_path: Path) -> None:
    (tmp_path / "tally").write_text("0")
    command = [sys.executable, "-c", WRITE, str(tmp_path)]
    for writer in [subprocess.Popen(command), subprocess.Popen(command)]:
        assert writer.wait(PATIENCE) == 0
    assert (tmp_path / "tally").read_text() == "600"


@pytest.mark.parametrize("has_open_file_locks", [True, False])
def test_two_writers_in_one_process_exclude_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_open_file_locks: bool
) -> None:
    """Also after somebody in the process asked, who opened and closed the file."""
    monkeypatch.setattr(locks, "HAS_OPEN_FILE_LOCKS", has_open_file_locks and locks.HAS_OPEN_FILE_LOCKS)
    lock = tmp_path / LOCK
    own_name = f"process {os.getpid()} on {os.uname().nodename}"
    with lock_file(lock, "dataset"):
        assert lock_holder(lock) == own_name
        with pytest.raises(LockedError, match=own_name), lock_file(lock, "dataset"):
            pass
        assert lock_holder(lock) == own_name
    assert lock_holder(lock) is None
    with lock_file(lock, "dataset"):
        pass


def test_a_killed_writer_leaves_no_lock(tmp_path: Path) -> None:
    lock = tmp_path / LOCK
    code = "import sys; from pathlib import Path; from tcmrl_data.foundation.disk import lock_file\n"
    code += "with lock_file(Path(sys.argv[1]), 'x'): sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code, str(lock)], stdin=subprocess.PIPE) as writer:
        wait_for(lambda: lock_holder(lock) is not None, "the lock")
        writer.kill()
    assert lock_holder(lock) is None


def test_status_of_a_dataset_that_can_only_be_read(tiny_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data"  # other tests lock the shared one
    shutil.copytree(tiny_folder, folder)
    with lock_file(folder / LOCK, "dataset"):
        result = run_mounted(read_only(folder), "show", folder, "--json")
    assert result.returncode == 0, result.stderr
    assert f"process {os.getpid()} on " in result.stdout
    assert build_status(folder).builder is None


def test_without_open_file_locks_a_question_delays_a_writer_and_does_not_refuse_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = tmp_path / LOCK
    lock.touch()
    monkeypatch.setattr(locks, "HAS_OPEN_FILE_LOCKS", False)
    with lock.open("rb") as reader:
        fcntl.flock(reader, fcntl.LOCK_SH)
        monkeypatch.setattr("time.sleep", lambda seconds: fcntl.flock(reader, fcntl.LOCK_UN))
        with lock_file(lock, "dataset"):
            assert lock_holder(lock) == f"process {os.getpid()} on {os.uname().nodename}"


def test_without_open_file_locks_a_question_without_end_refuses_a_writer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, waits = tmp_path / LOCK, list[float]()
    lock.touch()
    monkeypatch.setattr(locks, "HAS_OPEN_FILE_LOCKS", False)
    monkeypatch.setattr("time.sleep", waits.append)
    with lock.open("rb") as reader:
        fcntl.flock(reader, fcntl.LOCK_SH)
        with pytest.raises(LockedError, match="another process"), lock_file(lock, "dataset"):
            pass
    assert 0.5 < sum(waits) < 10
