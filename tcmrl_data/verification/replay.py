"""Replays: rolls parts out again from their snapshots and seeds, and compares them with the stored arrays."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.behavior.snapshot import read_snapshot
from tcmrl_data.building.part import roll_out_part
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.operations.derived import read_settings
from tcmrl_data.operations.extension import EXTEND, Extension, extended_episodes
from tcmrl_data.operations.relabelling import RELABEL, Relabelling, relabelled_episodes
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import pack, read_arrays, unpack
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.layout import DECODED_FLOOR, DECODED_RATIO
from tcmrl_data.store.part_record import PartRecord

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
        platform_differences: how this platform differs from the part's. On an equal platform every bit is
            compared, otherwise the values are within the tolerances of this module.
        problems: differences from the stored arrays.
    """

    task: int
    step: int
    run: str
    platform_differences: tuple[str, ...]
    problems: tuple[str, ...]

    @property
    def exact(self) -> bool:
        """Whether every bit was compared."""
        return not self.platform_differences


def spread_parts(keys: Sequence[PartKey], number: int) -> list[PartKey]:
    """At most `number` parts, evenly spread over all, the first and the last among them."""
    positions = np.linspace(0, len(keys) - 1, min(number, len(keys))).round().astype(int)
    return [keys[position] for position in positions]


def replay_part(archive: Archive, record: PartRecord, key: PartKey, recipe: Recipe) -> Replay:
    """Rolls a part out again, whole lane batches, and compares.

    Args:
        archive: the part.
        record: its record.
        key: the part's.
        recipe: what it was built from.
    """
    identity = record.identity
    differences: tuple[str, ...] = ()
    try:
        if identity.seed is None or identity.policy is None:
            raise ValueError("its seed or its policy is not known")
        _check_cost(archive, record, recipe)
        task = Task(identity.task, "train", identity.parameters)  # the split has no part in rollouts
        plan = BuildPlan.of_tasks(recipe, seed=identity.seed, tasks=[task])
        differences = tuple(plan.platform.differences(record.platform))
        made = _make_again(archive, record, plan)
        stored = read_arrays(archive, identity.arrays)
        compare = _drift_problems if differences else _bit_problems
        problems = tuple(compare(stored, made))
    except (TcmrlError, ValidationError, KeyError, IndexError, ValueError, TypeError, RuntimeError) as error:
        problems = (f"cannot be made again ({' '.join(str(error).split())[:200]})",)
    return Replay(key.task, key.step, key.run, differences, problems)


def _check_cost(archive: Archive, record: PartRecord, recipe: Recipe) -> None:
    """Refuses lane batches and numbers of episodes that the part's size does not justify."""
    stored = record.identity.arrays["episode_offsets"].shape[0] - 1
    if stored != recipe.rollouts.episodes:
        raise ValueError(f"{stored} episodes are stored, the recipe has {recipe.rollouts.episodes}")
    horizon, lanes = recipe.environment.horizon, recipe.rollouts.lanes
    shapes = record.identity.arrays
    columns = shapes["observations"].shape[1] + shapes["actions"].shape[1] + 2
    if lanes * (horizon + 1) * columns * 4 > max(DECODED_FLOOR, DECODED_RATIO * archive.size):
        raise ValueError(f"{lanes} lanes of {horizon} steps are more than the part's size justifies")


def _make_again(archive: Archive, record: PartRecord, plan: BuildPlan) -> dict[str, npt.NDArray[Any]]:
    (task,) = plan.tasks
    derived, place = record.identity.derived, str(archive.path)
    parameters = [task.parameters] * plan.recipe.rollouts.lanes
    with one_thread(), contextlib.closing(plan.environment.lanes(parameters)) as lanes:
        if derived is not None and derived.get("operation") == RELABEL:
            settings = read_settings(Relabelling, derived, place)
            return pack(
                relabelled_episodes(
                    plan.environment,
                    unpack(read_arrays(archive, record.identity.arrays)),
                    settings=settings,
                    step=record.identity.step,
                    seed=plan.seed,
                    target=task,
                    lanes=lanes,
                )
            )
        snapshot = read_snapshot(archive.read, record.identity.step, place=place)
        if derived is None:
            return pack(roll_out_part(plan, task=task, snapshot=snapshot, lanes=lanes))
        if derived.get("operation") == EXTEND:
            extension = read_settings(Extension, derived, place)
            return pack(extended_episodes(plan, snapshot, extension, lanes))
    raise ValueError(f"it is the result of {str(derived.get('operation'))[:40]!r}, not of rollouts")


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
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
