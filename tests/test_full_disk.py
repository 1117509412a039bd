"""Full and read-only disks: one line names the file and the remedy, and no file is incomplete."""

import json
import resource
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tcmrl_data import Dataset
from tcmrl_data.foundation.errors import CacheError
from tcmrl_data.foundation.machine import size
from tcmrl_data.sampling.cache import cached_rows
from tests.conftest import TASKS, TINY
from tests.disks import COMMAND_LINE, read_only, run_mounted, small_disk

TASK_LIST = ",".join(map(str, TASKS))
BUILD = ["point-robot", "--profile", "quick", *(word for text in TINY for word in ("--set", text))]
FILES = {
    "hdf5": "task_00000.hdf5",
    "idaq-npy": "goal_idx",
    "minari": "main_data.hdf5",
    "parquet": ".parquet",
    "robomimic": "task_00000.hdf5",
}
PACKAGES = {"minari": "minari", "parquet": "pyarrow"}


def assert_one_line(result: "subprocess.CompletedProcess[str]", *expected: str) -> None:
    lines = result.stderr.strip().splitlines()
    assert result.returncode == 2 and len(lines) == 1, result.stderr[-2_000:]
    assert lines[0].startswith("Error: cannot write "), lines
    assert all(text in lines[0] for text in expected), lines


@pytest.mark.check
@pytest.mark.parametrize("name", FILES)
def test_an_export_to_a_full_disk_names_the_file_and_leaves_nothing(
    name: str, tiny_folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip(PACKAGES.get(name, "h5py"))
    result = run_mounted(
        small_disk(tmp_path, 100),
        *("export", tiny_folder, "--format", name, "--out", tmp_path / "out", "--quiet"),
        then=f"ls -A {tmp_path}",
    )
    assert_one_line(result, f"{tmp_path}/out/", FILES[name], "No space left on device", "another disk")
    assert result.stdout == ""


@pytest.mark.check
@pytest.mark.parametrize("name", [name for name in FILES if name != "idaq-npy"])  # whose files are small
def test_an_export_under_a_limit_of_file_sizes_names_the_file(
    name: str, tiny_folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip(PACKAGES.get(name, "h5py"))
    limit = 100_000
    result = subprocess.run(
        [*COMMAND_LINE, "export", tiny_folder, "--format", name, "--out", tmp_path / "out", "--quiet"],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert_one_line(result, f"{tmp_path}/out/", FILES[name], "File too large")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.check
def test_a_finished_dataset_that_is_read_only_needs_no_build_and_no_repair(tiny_folder: Path) -> None:
    built = run_mounted(
        read_only(tiny_folder), "build", *BUILD, "--tasks", TASK_LIST, "--out", tiny_folder, "--json"
    )
    assert built.returncode == 0, built.stderr
    report = json.loads(built.stdout)
    assert (report["built"], report["present"], report["read_only"]) == (0, 15, True)
    repaired = run_mounted(read_only(tiny_folder), "verify", tiny_folder, "--repair")
    assert repaired.returncode == 0, repaired.stderr
    assert "0 parts regenerated" in repaired.stdout and "cannot be written" in repaired.stdout


@pytest.mark.check
def test_a_read_only_dataset_that_lacks_parts_is_refused_by_name(tiny_copy: Callable[[], Path]) -> None:
    copy = tiny_copy()
    more = run_mounted(
        read_only(copy), "build", *BUILD, "--tasks", f"{TASK_LIST},7", "--out", copy, "--quiet"
    )
    assert more.returncode == 2
    assert more.stderr.startswith(f"Error: {copy} cannot be written") and more.stderr.count("\n") == 1
    shutil.rmtree(copy / "parts" / "main" / "00003")
    damaged = run_mounted(read_only(copy), "verify", copy, "--repair", "--quiet")
    assert damaged.returncode == 2
    assert damaged.stderr.startswith(f"Error: {copy} cannot be written") and damaged.stderr.count("\n") == 1


@pytest.mark.check
@pytest.mark.parametrize(
    ("num_bytes", "expected"),
    [(0, "0 B"), (999, "999 B"), (1_000, "1.0 kB"), (12_345_678, "12.3 MB"), (2e12, "2.0 TB")],
)
def test_a_size_has_the_unit_that_fits(num_bytes: float, expected: str) -> None:
    assert size(num_bytes) == expected


@pytest.mark.check
def test_a_cache_that_cannot_be_written_names_the_variable(
    tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("TCMRL_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(CacheError, match=r"Not a directory.*set TCMRL_CACHE to a folder that can be written"):
        cached_rows(tiny.select(split="train"))
