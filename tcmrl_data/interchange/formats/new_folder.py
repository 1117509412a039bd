"""The folder of an export, which is published atomically when it is complete."""

import contextlib
import shutil
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.disk import move_into_place, named_errors, require_room, sync_tree
from tcmrl_data.foundation.errors import StorageError, StoreError

REMEDY = "nothing was exported; make room or choose an --out on another disk, then export again"
FILE_BYTES = 2**16
"""Bytes reserved for a file's content other than episodes."""

COPIES = 4
"""A step is written at most this often: in its episode, and flat with its two observations."""

EPISODE_BYTES = 2**15
"""Room for the records that HDF5 keeps of an episode's arrays; Minari's take 16 kB."""


@contextlib.contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Gives a folder beside `out` to write into; forced to disk and renamed to `out` at the end.

    Raises:
        StoreError: `out` exists and is not empty.
        StorageError: the disk refuses.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"--out {out} exists and is not empty; choose another folder or remove it")
    staged = out.with_name(f".{out.name}.{uuid.uuid4().hex}.partial")
    try:
        with named_errors(out, remedy=REMEDY):
            out.parent.mkdir(parents=True, exist_ok=True)
            staged.mkdir()
            yield staged
            sync_tree(staged)
        if not move_into_place(staged, out):
            raise StoreError(f"--out {out} appeared meanwhile; choose another folder or remove it")
    except StorageError as error:
        raise StorageError(str(error).replace(str(staged), str(out))) from None
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def require_room_for(file: Path, trajectories: Sequence[Trajectory] = ()) -> None:
    """Checks that a file can take episodes; HDF5 leaves a broken process behind where it cannot.

    Args:
        file: written next, or about to be made.
        trajectories: what it takes; none where only the file itself is to be made.

    Raises:
        StorageError: the disk refuses.
    """
    names = ("observations", "actions", "rewards", "terminated", "truncated")
    num_bytes = sum(getattr(trajectory, name).nbytes for trajectory in trajectories for name in names)
    num_bytes += sum(array.nbytes for trajectory in trajectories for array in trajectory.extras.values())
    num_bytes = FILE_BYTES + EPISODE_BYTES * len(trajectories) + COPIES * num_bytes
    require_room(file, num_bytes, remedy=REMEDY)
