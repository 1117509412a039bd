"""Whether the machines of a cluster can build one dataset: they share its folder, and have equal versions."""

import contextlib
import uuid
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.engine.base import BaseEngine, NodeReport, Unit
from tcmrl_data.engine.local import Send
from tcmrl_data.foundation.disk import STAGING, make_folders, write_file
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.files import wait_until_visible
from tcmrl_data.foundation.records import as_model
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.part import Platform, this_platform

WORKER = "tcmrl_data.building.nodes"
"""Module that describes a machine."""

FOLDER_SECONDS = 30.0
"""A machine looks for the dataset's folder for at most this long."""

NODE_SECONDS = 120.0
"""A machine may take this long to look for the folder and to load the simulator."""

MOST_NAMED = 3
"""Machines that one message names."""


def check_nodes(engine: BaseEngine, plan: BuildPlan, out: Path) -> tuple[str, ...]:
    """Checks that every machine of the engine sees the dataset's folder and has the versions of this one.

    Args:
        engine: the build's engine.
        out: the dataset's folder, locked by the caller.

    Returns:
        Lines for people: machines that differ in what may differ, such as the processor.

    Raises:
        BuildError: names the machines that do not see the folder, have other versions or do not answer.
    """
    with _token(out) as token:
        reports = engine.run_on_every_node(_unit(plan, token))
    here = Platform.model_validate(plan.platform.model_dump(mode="json"))  # as the other machines send theirs
    problems: dict[str, list[str]] = {}
    notes: dict[str, list[str]] = {}
    for report in reports:
        problem = _problem(report, here, out)
        if problem:
            problems.setdefault(problem, []).append(report.node)
            continue
        differences = here.differences(_platform(report))
        if differences:
            notes.setdefault(", ".join(differences), []).append(report.node)
    if problems:
        raise BuildError("; ".join(f"{_nodes(nodes)} {problem}" for problem, nodes in problems.items()))
    return tuple(
        f"{_nodes(nodes)} may compute other last bits ({differences}); parts name their platform"
        for differences, nodes in notes.items()
    )


@contextlib.contextmanager
def _token(out: Path) -> Iterator[Path]:
    """A new file in the dataset's staging folder, which only machines that share the folder see."""
    make_folders(out / STAGING)
    token = out.resolve() / STAGING / f"nodes.{uuid.uuid4().hex}"
    write_file(token, b"")
    try:
        yield token
    finally:
        token.unlink(missing_ok=True)


def _unit(plan: BuildPlan, token: Path) -> Unit:
    spec = {
        "token": str(token),
        "deadline": FOLDER_SECONDS,
        "tcmrl": version("tcmrl"),
        "recipe": plan.recipe.model_dump(mode="json"),
    }
    build = plan.recipe.build
    return Unit(
        "the check of a machine",
        spec,
        WORKER,
        cpus=build.cpus,
        gpus=build.gpus,
        memory=build.memory,
        timeout=NODE_SECONDS,
    )


def _problem(report: NodeReport, here: Platform, out: Path) -> str | None:
    """Why a machine cannot take part in the build, and what to do; None if it can."""
    told = _told(report)
    if told.get("sees_folder") is False:
        return f"does not see {out.resolve()}; use a folder that all machines share"
    if told.get("tcmrl", version("tcmrl")) != version("tcmrl"):
        return f"has tcmrl {told['tcmrl']}, not {version('tcmrl')}; install equal versions on all machines"
    if report.error:
        return f"cannot run units: {report.error}; install tcmrl {version('tcmrl')} there"
    differences = _version_differences(here, _platform(report))
    if differences:
        return f"has other versions ({', '.join(differences)}); install equal versions on all machines"
    return None


def _told(report: NodeReport) -> dict[str, Any]:
    return {name: value for message in report.messages for name, value in message.items()}


def _platform(report: NodeReport) -> Platform:
    return Platform.model_validate(_told(report)["platform"])


def _version_differences(here: Platform, there: Platform) -> list[str]:
    """Differences other than the machine itself: its processor and system, and how libraries use them."""
    machine = {name: getattr(there, name) for name in ("cpu", "system", "instructions", "variables")}
    return here.model_copy(update=machine).differences(there)


def _nodes(names: Sequence[str]) -> str:
    named = ", ".join(sorted(names)[:MOST_NAMED])
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"node {named}{more}" if len(names) == 1 else f"nodes {named}{more}:"


def work(spec: dict[str, Any], report: Send) -> str:
    """Reports what the machine sees of the dataset's folder, its version and its platform."""
    sees = wait_until_visible(Path(spec["token"]), deadline=spec["deadline"])
    report({"kind": "node", "sees_folder": sees, "tcmrl": version("tcmrl")})
    if sees and version("tcmrl") == spec["tcmrl"]:
        recipe = as_model(Recipe, spec["recipe"])
        platform = this_platform(recipe.make_environment(), recipe.behavior.source)
        report({"kind": "platform", "platform": platform.model_dump(mode="json")})
    return ""
