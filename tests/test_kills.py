import pytest

from tests.conftest import TINY
from tests.kill_sweep import run_sweep


@pytest.mark.sweep
def test_killed_builds_lose_nothing_and_leave_nobody_behind() -> None:
    """Twenty kills; `python -m tests.kill_sweep` does two hundred on the quick profile itself."""
    arguments = ["--tasks", "0,5,12,15,20,30", *(word for override in TINY for word in ("--set", override))]
    figures = run_sweep(20, pause=5.0, seed=0, arguments=arguments)
    assert figures.kills >= 20
    assert min(figures.driver_kills, figures.worker_kills, figures.builds) > 0
    assert (figures.parts_lost, figures.parts_duplicated, figures.roots_that_differ) == (0, 0, 0)
    assert (figures.findings, figures.staging_left, figures.orphans) == (0, 0, 0)
