"""Replays: rolls parts out again from their snapshots and seeds, and compares them with the stored arrays."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.behavior.snapshot import read_snapshot
from tcmrl_data.build.part import roll_out_part
from tcmrl_data.build.plan import BuildPlan
from tcmrl_data.build.provenance import provenance
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.store.arrays import pack, read_arrays
from tcmrl_data.store.layout import DECODED_FLOOR, DECODED_RATIO
from tcmrl_data.store.manifest import Manifest, PartRecord

FIRST_STEPS = 5
STEP_TOLERANCE = 1e-3
RETURN_ERRORS = 4.0
"""On another platform rounding differs and the dynamics amplify the differences. The first 5 steps of every
episode must agree to 1e-3 (absolute, or relative to the larger value), and the mean return must lie within 4
standard errors of the difference of two such means."""


@dataclass(frozen=True)
class Replay:
    """One part made again.

    Attributes:
        exact: made on the CPU model, with the packages and the physics of the original, so that every bit
            was compared; otherwise within the tolerances of this module.
        problems: differences from the stored arrays.
    """

    task: int
    step: int
    exact: bool
    problems: tuple[str, ...]


def spread_parts(keys: Sequence[tuple[int, int]], number: int) -> list[tuple[int, int]]:
    """At most `number` parts, evenly spread over all, the first and the last among them."""
    positions = np.linspace(0, len(keys) - 1, min(number, len(keys))).round().astype(int)
    return [keys[position] for position in positions]


def replay_part(folder: Path, record: PartRecord, manifest: Manifest) -> Replay:
    """Rolls a part out again, whole lane batches, and compares.

    Args:
        folder: the part.
        record: its record.
        manifest: what it was built from.
    """
    identity = record.identity
    exact = False
    try:
        _check_cost(record, manifest)
        plan = BuildPlan.of_tasks(manifest.recipe, seed=manifest.seed, tasks=_tasks(manifest))
        here = provenance(plan.environment, {})
        exact = all(record.provenance.get(key) == here[key] for key in ("cpu", "packages", "physics"))
        made = _make_again(folder, record, plan)
        stored = read_arrays(folder, identity.arrays)
        compare = _bit_problems if exact else _drift_problems
        problems = tuple(compare(stored, made))
    except (TcmrlError, ValidationError, KeyError, IndexError, ValueError, TypeError, RuntimeError) as error:
        problems = (f"cannot be made again ({' '.join(str(error).split())[:200]})",)
    return Replay(identity.task, identity.step, exact, problems)


def _check_cost(record: PartRecord, manifest: Manifest) -> None:
    """Refuses lane batches whose buffers the part's size does not justify."""
    horizon, lanes = manifest.recipe.environment.horizon, manifest.recipe.rollouts.lanes
    shapes = record.identity.arrays
    columns = shapes["observations"].shape[1] + shapes["actions"].shape[1] + 2
    stored = sum(file.size for file in record.files.values())
    if lanes * (horizon + 1) * columns * 4 > max(DECODED_FLOOR, DECODED_RATIO * stored):
        raise ValueError(f"{lanes} lanes of {horizon} steps are more than the part's size justifies")


def _tasks(manifest: Manifest) -> list[Task]:
    return [Task(task.index, task.split, task.parameters) for task in manifest.tasks]


def _make_again(folder: Path, record: PartRecord, plan: BuildPlan) -> dict[str, npt.NDArray[Any]]:
    task = next(task for task in plan.tasks if task.index == record.identity.task)
    snapshot = read_snapshot(folder, record.identity.step)
    parameters = [task.parameters] * plan.recipe.rollouts.lanes
    with _one_thread(), contextlib.closing(plan.environment.lanes(parameters)) as lanes:
        return pack(roll_out_part(plan, task=task, snapshot=snapshot, lanes=lanes))


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """One torch thread, as in a worker: reductions split by thread round differently."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _bit_problems(
    stored: Mapping[str, npt.NDArray[Any]], made: Mapping[str, npt.NDArray[Any]]
) -> Iterator[str]:
    for name in sorted({*stored, *made}):
        if name not in stored or name not in made or stored[name].shape != made[name].shape:
            yield f"{name} has another shape"
        elif stored[name].tobytes() != made[name].tobytes():
            rows = (stored[name] != made[name]).reshape(len(made[name]), -1).any(axis=1)
            yield f"{name} differs in {int(rows.sum())} of {len(rows)} rows"


def _drift_problems(
    stored: Mapping[str, npt.NDArray[Any]], made: Mapping[str, npt.NDArray[Any]]
) -> Iterator[str]:
    """Differences beyond the module's tolerances."""
    left, right = stored["episode_offsets"], made["episode_offsets"]
    if len(left) != len(right):
        yield f"{len(right) - 1} episodes instead of {len(left) - 1}"
        return
    for name in ("observations", "actions", "rewards"):
        shift = np.arange(len(left) - 1) if name == "observations" else 0
        for step in range(FIRST_STEPS):
            both = (np.diff(left) > step) & (np.diff(right) > step)
            old = stored[name][(left[:-1] + shift + step)[both]]
            new = made[name][(right[:-1] + shift + step)[both]]
            if not np.allclose(old, new, rtol=STEP_TOLERANCE, atol=STEP_TOLERANCE):
                yield f"{name} differ at step {step} by up to {float(np.abs(old - new).max()):g}"
                break
    old_returns, new_returns = _returns(stored), _returns(made)
    error = float(np.sqrt((old_returns.var() + new_returns.var()) / len(old_returns)))
    gap = abs(float(old_returns.mean() - new_returns.mean()))
    if gap > RETURN_ERRORS * error + STEP_TOLERANCE * (1.0 + abs(float(old_returns.mean()))):
        yield f"mean return is off by {gap:g}, more than {RETURN_ERRORS:g} standard errors of {error:g}"


def _returns(arrays: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.float64]:
    sums = np.concatenate([[0.0], np.cumsum(arrays["rewards"], dtype=np.float64)])
    return np.diff(sums[arrays["episode_offsets"]])
