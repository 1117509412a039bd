"""Verifications and questions for the status, in other processes than that which builds at the same time."""

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tcmrl_data import Dataset, Recipe, build_status, open_dataset, verify_dataset
from tcmrl_data.building import ledger
from tcmrl_data.verification import verify
from tcmrl_data.verification.description import Scan, scan_dataset
from tests.simulated_disk import PreparedParts

RUNS = 20


def in_child(work: Callable[[], object]) -> int:
    """Starts a forked process that does some work and ends with status 0 if nothing was raised."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        work()
        status = 0
    finally:
        os._exit(status)


@pytest.mark.check
def test_a_verification_beside_a_build_reports_nothing_false(
    tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The dataset has one task before the build and three after it; the build starts and ends meanwhile."""
    monkeypatch.setattr(ledger, "SEAL_SECONDS", 0.02)
    parts = PreparedParts(tiny, tiny_recipe, [0, 3, 40])
    parts.build(tmp_path / "begun", monkeypatch, tasks=[0])
    sizes = set()
    for run in range(RUNS):
        out = tmp_path / str(run)
        shutil.copytree(tmp_path / "begun", out)
        child, ended = in_child(lambda: parts.build(out, monkeypatch)), 0  # noqa: B023
        while not ended:
            report = verify_dataset(out)
            assert report.findings == (), f"run {run}"
            sizes.add(report.parts)
            ended, status = os.waitpid(child, os.WNOHANG)
        assert status == 0
        assert (verify_dataset(out).findings, len(open_dataset(out).parts)) == ((), 9)
        shutil.rmtree(out)
    assert len(sizes) > 1, "no verification ran beside a build"


@pytest.mark.check
def test_asking_for_the_status_never_makes_a_build_fail(
    tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts, out = PreparedParts(tiny, tiny_recipe, [3]), tmp_path / "data"
    parts.build(out, monkeypatch)

    def ask() -> None:
        while True:
            assert build_status(out).parts_total == 3

    askers = [in_child(ask) for _ in range(2)]
    try:
        for _ in range(RUNS):
            assert parts.build(out, monkeypatch).failed == ()
        assert [os.waitpid(asker, os.WNOHANG) for asker in askers] == [(0, 0), (0, 0)], "an asker ended"
    finally:
        for asker in askers:
            os.kill(asker, signal.SIGKILL)
            os.waitpid(asker, 0)


@pytest.mark.check
def test_a_build_that_begins_and_ends_during_a_verification_gives_no_finding(
    tiny: Dataset, tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts, out = PreparedParts(tiny, tiny_recipe, [0, 3]), tmp_path / "data"
    parts.build(out, monkeypatch, tasks=[0])

    def build_and_scan(folder: Path) -> Scan:
        """Builds after the manifest was read and before the files are listed."""
        parts.build(out, monkeypatch)
        return scan_dataset(folder)

    monkeypatch.setattr(verify, "scan_dataset", build_and_scan)
    report = verify_dataset(out)
    assert (report.findings, report.parts) == ((), 3)
