"""The check of a cluster's machines before a build; tests/test_ray.py has the same on a real cluster."""

import os
import threading
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from tcmrl_data import Recipe
from tcmrl_data.building import nodes
from tcmrl_data.building.nodes import check_nodes
from tcmrl_data.building.plan import BuildPlan, plan_build
from tcmrl_data.engine.base import BaseEngine, Message, NodeReport, Result, Unit
from tcmrl_data.engine.local import LocalEngine, run_attempt
from tcmrl_data.foundation.disk import STAGING
from tcmrl_data.foundation.errors import BuildError
from tests.workers import ROOT, other_version


@dataclass(frozen=True)
class Machine:
    """A machine by the variables of its processes and by what it sees in the place of shared folders."""

    name: str
    variables: Mapping[str, str]
    shared: bool = True


class Machines(BaseEngine):
    """Every machine is this one, with other variables or without the shared folder."""

    takes_address = True
    machines: tuple[Machine, ...] = ()

    def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
        raise NotImplementedError

    def run_on_every_node(self, unit: Unit) -> Sequence[NodeReport]:
        return [self._run_on(machine, unit) for machine in self.machines]

    def _run_on(self, machine: Machine, unit: Unit) -> NodeReport:
        messages: list[Mapping[str, Any]] = []
        if not machine.shared:
            unit = replace(unit, spec={**unit.spec, "token": f"/nowhere{unit.spec['token']}"})
        with pytest.MonkeyPatch.context() as patch:
            for name, value in machine.variables.items():
                patch.setenv(name, value)
            outcome = run_attempt(unit, messages.append, threading.Event())
        return NodeReport(machine.name, tuple(messages), outcome.error or outcome.crash)


def cluster(*machines: Machine) -> Machines:
    engine = Machines()
    engine.machines = machines
    return engine


@pytest.fixture(scope="module")
def plan(tiny_recipe: Recipe) -> BuildPlan:
    return plan_build(tiny_recipe, tasks=[3])


EQUAL = Machine("equal", {})
OTHER_CPU = {"ATEN_CPU_CAPABILITY": "default"}


@pytest.mark.check
def test_an_engine_of_one_machine_has_nothing_to_check(plan: BuildPlan, tmp_path: Path) -> None:
    assert check_nodes(LocalEngine(), plan, tmp_path / "data") == ()


@pytest.mark.check
def test_another_processor_is_told_and_not_refused(
    plan: BuildPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nodes, "MOST_NAMED", 1)
    old = [Machine(name, OTHER_CPU) for name in ("old1", "old2")]
    (line,) = check_nodes(cluster(EQUAL, *old), plan, tmp_path / "data")
    assert line.startswith("nodes old1 and 1 more: may compute other last bits (")
    assert "instruction sets of torch DEFAULT there" in line
    assert list((tmp_path / "data" / STAGING).iterdir()) == []


@pytest.mark.check
def test_other_versions_are_refused_by_machine_and_version(
    plan: BuildPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a checkout in the working directory would tell its own version
    old_tcmrl = Machine("a", other_version(tmp_path, "tcmrl"))
    old_numpy = Machine("b", other_version(tmp_path, "numpy"))
    with pytest.raises(BuildError) as error:
        check_nodes(cluster(EQUAL, old_tcmrl, old_numpy), plan, tmp_path / "data")
    told = str(error.value)
    assert f"node a has tcmrl 0.0.7, not {version('tcmrl')}; install" in told
    assert f"node b has other versions (numpy 0.0.7 there, {version('numpy')} here); install" in told
    assert "equal" not in told.replace("equal versions", "")
    assert "\n" not in told


@pytest.mark.check
def test_a_machine_without_the_shared_folder_is_named(
    plan: BuildPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(nodes, "FOLDER_SECONDS", 0.1)
    out = tmp_path / "data"
    with pytest.raises(BuildError) as error:
        check_nodes(cluster(EQUAL, Machine("far", {}, shared=False)), plan, out)
    assert str(error.value) == f"node far does not see {out}; use a folder that all machines share"
    assert list((out / STAGING).iterdir()) == []


@pytest.mark.check
def test_a_machine_that_lacks_a_package_is_named(plan: BuildPlan, tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("raise ImportError('no torch')")
    bare = Machine("bare", {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])})
    with pytest.raises(BuildError, match=r"node bare cannot run units: .*no torch; install tcmrl"):
        check_nodes(cluster(bare), plan, tmp_path / "data")
