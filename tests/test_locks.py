"""Locks of writers: exclusive between processes and within one, and never disturbed by those who ask."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tcmrl_data import build_status
from tcmrl_data.foundation import files
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
def test_no_writer_is_refused_while_others_ask(ask: None, tiny_folder: Path) -> None:
    for _ in range(STARTS):
        with lock_file(tiny_folder / LOCK, "dataset"):
            pass
    assert lock_holder(tiny_folder / LOCK) is None


def test_who_asks_takes_no_lock_even_if_suspended_before_closing_the_file(tmp_path: Path) -> None:
    (tmp_path / LOCK).touch()
    with (tmp_path / LOCK).open("rb") as asked:
        assert not files.is_locked(asked)
        with lock_file(tmp_path / LOCK, "dataset"):
            assert files.is_locked(asked)


def test_writers_exclude_each_other(tmp_path: Path) -> None:
    (tmp_path / "tally").write_text("0")
    command = [sys.executable, "-c", WRITE, str(tmp_path)]
    for writer in [subprocess.Popen(command), subprocess.Popen(command)]:
        assert writer.wait(PATIENCE) == 0
    assert (tmp_path / "tally").read_text() == "600"


def test_two_writers_in_one_process_exclude_each_other(tmp_path: Path) -> None:
    """Also after somebody in the process asked, who opened and closed the file."""
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
