"""Builds that go on where numbers are rounded differently, as emulated in processes without AVX-512."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import tcmrl_data
from tcmrl_data import BuildEvent, load_recipe, open_dataset, verify_dataset
from tcmrl_data.building.work_files import STATUS
from tcmrl_data.engine.local import InProcessEngine
from tcmrl_data.foundation.disk import CHECKPOINTS, LOCK
from tcmrl_data.store.tables import PartKey, part_file
from tests.conftest import TASKS, TINY
from tests.disks import COMMAND_LINE
from tests.platforms import AVX2

RECIPE = ["point-robot", "--profile", "quick", *(word for text in TINY for word in ("--set", text))]


class Killed(Exception):
    """Ends a build in the middle."""


def elsewhere(*arguments: object) -> str:
    """What `tcmrl-data` prints on the other platform."""
    done = subprocess.run(
        [*COMMAND_LINE, *map(str, arguments)],
        env=os.environ | AVX2,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_finished_dataset_is_left_alone_on_another_platform(tiny_copy: Callable[[], Path]) -> None:
    folder = tiny_copy()

    def contents() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != LOCK}

    before = contents()
    tasks = ",".join(map(str, TASKS))
    report = json.loads(elsewhere("build", *RECIPE, "--tasks", tasks, "--out", folder, "--json"))
    assert (report["built"], report["present"]) == (0, 15)
    assert contents() == before


@pytest.fixture
def half_built(tmp_path: Path) -> Path:
    """A build that ended after the second of three parts, with a checkpoint behind the first."""

    def kill(event: BuildEvent) -> None:
        if event.kind == "part" and event.parts_done == 2:
            raise Killed

    recipe, out = load_recipe("point-robot", profile="quick", overrides=TINY), tmp_path / "data"
    with pytest.raises(Killed):
        tcmrl_data.build_dataset(
            recipe, out, tasks=[0], engine=InProcessEngine(), checkpoint_seconds=0.0, progress=kill
        )
    assert len(list((out / CHECKPOINTS).rglob("*.safetensors"))) == 1
    return out


REPLAY = """
import sys
from tcmrl_data import verify_dataset
report = verify_dataset(sys.argv[1], level="deep", replay=3)
print(*report.findings, *(replay.exact for replay in report.replays))
"""


@pytest.mark.sweep
def test_a_half_built_dataset_is_completed_on_another_platform(half_built: Path) -> None:
    made_here = {step: (half_built / part_file(PartKey(0, step))).read_bytes() for step in (0, 100)}
    elsewhere("build", *RECIPE, "--tasks", "0", "--workers", "1", "--out", half_built)

    (warning,) = json.loads((half_built / STATUS).read_text())["warnings"]
    assert warning.startswith("parts were made on another platform (")
    assert "MKL_CBWR unset there, AVX2 here" in warning
    assert {step: (half_built / part_file(PartKey(0, step))).read_bytes() for step in made_here} == made_here

    dataset = open_dataset(half_built)
    first, second = dataset.manifest.platforms
    assert (first.variables, second.variables) == ({}, {"MKL_CBWR": "AVX2"})
    assert [entry.platform for entry in dataset.parts.entries()] == [0, 0, 1]
    assert [dataset.part(0, step).platform for step in (0, 100, 150)] == [first, first, second]

    report = verify_dataset(half_built, level="deep", replay=3)
    assert (report.findings, [replay.exact for replay in report.replays]) == ((), [True, True, False])
    assert "MKL_CBWR AVX2 there, unset here" in report.replays[2].platform_differences
    there = subprocess.run(
        [sys.executable, "-c", REPLAY, half_built], env=os.environ | AVX2, capture_output=True, text=True
    )
    assert there.stdout == "False False True\n", there.stderr
