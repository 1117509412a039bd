import threading
import time
from pathlib import Path

import pytest

from tcmrl_data.foundation import files
from tcmrl_data.foundation.files import wait_until_visible
from tests.workers import PATIENCE


def test_a_file_that_is_there_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "sleep", lambda seconds: pytest.fail("waited"))
    assert wait_until_visible(tmp_path)
    assert not wait_until_visible(tmp_path / "missing", deadline=0)


def test_a_file_that_appears_later_is_waited_for(tmp_path: Path) -> None:
    """Also in a folder that is not there yet."""
    part = tmp_path / "task" / "part.zip"

    def make() -> None:
        part.parent.mkdir()
        part.touch()

    later = threading.Timer(0.3, make)
    later.start()
    assert wait_until_visible(part, deadline=PATIENCE)
    later.join()


def test_pauses_grow_and_end_at_the_deadline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, pauses, listed = [0.0], list[float](), list[Path]()
    folder = tmp_path / "task"

    def sleep(seconds: float) -> None:
        pauses.append(seconds)
        now[0] += seconds

    monkeypatch.setattr(files.time, "sleep", sleep)
    monkeypatch.setattr(files.time, "monotonic", lambda: now[0])
    listdir = files.os.listdir
    monkeypatch.setattr(files.os, "listdir", lambda path: (listed.append(path), listdir(path))[1])
    assert not wait_until_visible(folder / "part.zip")
    assert sum(pauses) == pytest.approx(files.VISIBLE_SECONDS)
    assert pauses[:-1] == sorted(pauses[:-1])
    assert max(pauses) == files.LONGEST_PAUSE
    assert listed == [folder, tmp_path] * len(pauses)
