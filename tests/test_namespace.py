"""Runs the tests that need a network in a namespace that has only the loopback.

Ray puts a machine's own address in the place of 127.0.0.1; where there is no other address, nothing that a
test starts can be reached from outside or reach out itself.
"""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.namespace import has_only_loopback, in_namespace
from tests.workers import ROOT

LEAST = 15
"""As many tests at least are marked `loopback`; fewer would mean that they were lost on the way."""


@pytest.mark.sweep
def test_what_needs_a_network_holds_in_a_namespace_of_its_own(tiny_folder: Path) -> None:
    if has_only_loopback():
        pytest.skip("this machine has the loopback alone, so those tests run directly")
    if importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed; pip install 'tcmrl[ray]'")
    if shutil.which("unshare") is None:
        pytest.skip("no network namespace can be made here: no program unshare (util-linux)")
    probe = subprocess.run(in_namespace(["true"]), capture_output=True, text=True, check=False)
    if probe.returncode:
        pytest.skip(f"no network namespace can be made here: {probe.stderr.strip()}")
    pytest_of_its_own = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "loopback"]
    files = [str(file) for file in Path(__file__).parent.glob("test_*.py") if "loopback" in file.read_text()]
    result = subprocess.run(
        in_namespace([*pytest_of_its_own, f"--tiny={tiny_folder}", *files]),
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout[-20_000:]
    passed = re.search(r"(\d+) passed", result.stdout)
    assert passed and int(passed[1]) >= LEAST, result.stdout[-2_000:]
    assert "skipped" not in result.stdout.splitlines()[-1]
