"""Parts made again, and compared with what is stored."""

import contextlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.foundation.errors import ManifestError, SnapshotError, StoreError, TcmrlError
from tcmrl_data.parts.making import one_thread
from tcmrl_data.parts.operation import (
    MissingSourceError,
    Operation,
    Simulator,
    Sources,
    StoredPart,
    can_be_made_again,
)
from tcmrl_data.parts.own_operations import SUBSET, operation_of
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import DECODED_FLOOR, DECODED_RATIO, pack, read_arrays
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part import PartRecord, read_part_record
from tcmrl_data.store.part_table import PartTable
from tcmrl_data.store.tables import PartKey, part_file
from tcmrl_data.verification.description import NO_SOURCE

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


def replay_part(
    archive: Archive,
    record: PartRecord,
    key: PartKey,
    recipe: Recipe,
    files: Mapping[str, Path] | None = None,
) -> Replay | None:
    """Makes a part again by its operation and compares; None if a part that it was made from is not at hand.

    Args:
        files: of the parts that it may name as its sources, by their ids.
    """
    identity, place = record.identity, str(archive.path)
    differences: tuple[str, ...] = ()
    try:
        stored = StoredPart.in_archive(archive, record)
        operation = operation_of(identity, place)
        with contextlib.ExitStack() as stack:
            simulator = None
            if operation.simulates:
                _check_cost(operation, archive, record, recipe)
                assert identity.seed is not None
                simulator = Simulator(recipe, seed=identity.seed, task=stored.task)
                stack.callback(simulator.close)
                differences = tuple(simulator.platform.differences(record.platform))
            stack.enter_context(one_thread())
            sources = list(_open_sources(stack, record, files or {}).values())
            if not sources and {"observations", "actions"} <= {*operation.keeps}:
                sources = [stored]
            made = pack(operation.make(stored.wanted(), Sources(simulator, sources)))
        compare = _drift_problems if differences else _bit_problems
        problems = tuple(compare(read_arrays(archive, identity.arrays), made))
    except MissingSourceError:
        return None
    except (TcmrlError, ValidationError, KeyError, IndexError, ValueError, TypeError, RuntimeError) as error:
        problems = (f"cannot be made again ({' '.join(str(error).split())[:200]})",)
    return Replay(key.task, key.step, key.run, differences, problems)


def derived_problems(
    folder: Path,
    table: PartTable,
    runs: Mapping[str, Run],
    files: Mapping[str, Path],
    *,
    only: Collection[str],
) -> Iterator[tuple[str, str]]:
    """Makes the parts that were made from others again, and yields files and how they differ: forged ones do.

    Simulated parts of another platform are left out, since they come out with other bits here, and cut parts
    whose source is not at hand.

    Args:
        files: of the parts that others may be made from, by their ids.
        only: files of the parts that are made again.
    """
    keys = {entry.id: entry.key for entry in table.entries()}
    for entry in table.entries():
        file, run = part_file(entry.key), runs.get(entry.run)
        if run is None or run.recipe is None or run.kind == "built" or file not in only:
            continue
        with contextlib.ExitStack() as stack:
            archive = stack.enter_context(Archive(folder / file))
            record = read_part_record(archive)
            is_cut = (record.identity.derived or {}).get("operation") == SUBSET
            if not is_cut and not can_be_made_again(run):
                continue
            replay = replay_part(archive, record, entry.key, run.recipe, files)
            if replay is None and not is_cut:
                yield file, NO_SOURCE
            for problem in replay.problems if replay is not None and replay.exact else ():
                yield file, f"made again: {problem}"
            for part_id, source in _open_sources(stack, record, files).items():
                for what in _contradictions(record, source.record):
                    named = keys.get(part_id, files[part_id])
                    yield file, f"{what} the part of {named}, which it names as its source"


def _open_sources(
    stack: contextlib.ExitStack, record: PartRecord, files: Mapping[str, Path]
) -> dict[str, StoredPart]:
    """The parts that a part names as its sources, those that are at hand."""
    named = (record.identity.derived or {}).get("from")
    found = {}
    for part_id in named if isinstance(named, list) else ():
        if isinstance(part_id, str) and part_id in files:
            with contextlib.suppress(StoreError, ManifestError, SnapshotError):  # a finding of its own
                archive = stack.enter_context(Archive(files[part_id]))
                found[part_id] = StoredPart.in_archive(archive, read_part_record(archive))
    return found


def _contradictions(record: PartRecord, source: PartRecord) -> Iterator[str]:
    if record.identity.policy != source.identity.policy:
        yield "its policy is not that of"
    try:
        keeps = operation_of(record.identity, "").keeps
    except TcmrlError:
        return
    if any(record.identity.arrays[name] != source.identity.arrays[name] for name in keeps):
        yield "its episodes are not those of"


def _check_cost(operation: Operation[Any], archive: Archive, record: PartRecord, recipe: Recipe) -> None:
    """Refuses lane batches and numbers of episodes that the part's size does not justify."""
    stored = record.identity.arrays["episode_offsets"].shape[0] - 1
    if operation.own_seeds and stored != recipe.rollouts.episodes:
        raise ValueError(f"{stored} episodes are stored, the recipe has {recipe.rollouts.episodes}")
    horizon, lanes = recipe.environment.horizon, recipe.rollouts.lanes
    shapes = record.identity.arrays
    columns = shapes["observations"].shape[1] + shapes["actions"].shape[1] + 2
    if lanes * (horizon + 1) * columns * 4 > max(DECODED_FLOOR, DECODED_RATIO * archive.size):
        raise ValueError(f"{lanes} lanes of {horizon} steps are more than the part's size justifies")


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
