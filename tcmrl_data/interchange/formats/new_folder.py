"""The folder of an export: staged, resumable, and published atomically when it is complete."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import final

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.disk import (
    disk,
    lock_file,
    make_folders,
    move_into_place,
    named_errors,
    remove_tree,
    replace_file,
    require_room,
    sync_files,
    write_file,
)
from tcmrl_data.foundation.errors import StorageError, StoreError
from tcmrl_data.foundation.plain_files import read_plain_file

REMEDY = "nothing was exported; make room or choose an --out on another disk, then export again"
FILE_BYTES = 2**16
"""Bytes reserved for a file's content other than episodes."""

COPIES = 4
"""A step is written at most this often: in its episode, and flat with its two observations."""

EPISODE_BYTES = 2**15
"""Room for the records that HDF5 keeps of an episode's arrays; Minari's take 16 kB."""

CLAIM, LOCK, FINISHED, OPEN = "export", "lock", "finished", "open"
"""In the staging folder: what is exported, the lock, finished tasks, and the task that is being written."""


@final
class NewFolder:
    """A folder that is filled name by name; what an earlier attempt finished is still there.

    Args:
        staged: the staging folder.
    """

    def __init__(self, staged: Path) -> None:
        self._finished, self._open = staged / FINISHED, staged / OPEN

    def holds(self, name: str) -> bool:
        """Whether a file or folder is finished."""
        return (self._finished / name).exists()

    @contextlib.contextmanager
    def adding(self, name: str) -> Iterator[Path]:
        """Gives the path at which to write a file or folder; it is forced to disk and finished at the end."""
        remove_tree(self._open)
        path, target = self._open / name, self._finished / name
        path.parent.mkdir(parents=True)
        yield path
        sync_files(self._open, [path] if path.is_file() else filter(Path.is_file, path.rglob("*")))
        make_folders(target.parent)
        disk.rename(path, target)
        disk.sync(target.parent)

    def add(self, name: str, content: bytes) -> None:
        """Writes a small file."""
        replace_file(self._finished / name, content, staging=self._open)


def staging_folder(out: Path) -> Path:
    """Where the export to `out` is made, and kept when it is interrupted."""
    return out.with_name(f".{out.name}.partial")


def require_free(out: Path) -> None:
    """Checks that an export may appear at a path.

    Raises:
        StoreError: it exists and is not empty.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"--out {out} exists and is not empty; choose another folder or remove it")


@contextlib.contextmanager
def new_folder(out: Path, claim: bytes) -> Iterator[NewFolder]:
    """Gives a folder beside `out` to fill; renamed to `out` at the end.

    After an error nothing is left. After an interruption or a crash, what was finished is kept for the next
    attempt with the same claim.

    Args:
        out: the folder to create; it may exist if it is empty.
        claim: what is exported, and how.

    Raises:
        StoreError: `out` exists and is not empty, or something else lies where the export is staged.
        LockedError: another process exports to `out`.
        StorageError: the disk refuses.
    """
    require_free(out)
    staged = staging_folder(out)
    try:
        with named_errors(out, remedy=REMEDY):
            out.parent.mkdir(parents=True, exist_ok=True)
            _require_ours(staged)
            staged.mkdir(exist_ok=True)
            with lock_file(staged / LOCK, f"the export {out}"):
                try:
                    _take_up(staged, claim)
                    yield NewFolder(staged)
                    if not move_into_place(staged / FINISHED, out):
                        raise StoreError(
                            f"--out {out} appeared meanwhile; choose another folder or remove it"
                        )
                except Exception:
                    remove_tree(staged)
                    raise
                remove_tree(staged)
    except StorageError as error:
        text = str(error)
        for inner in (staged / OPEN, staged / FINISHED, staged):
            text = text.replace(str(inner), str(out))
        raise StorageError(text) from None


def _require_ours(staged: Path) -> None:
    """Refuses a path that no export has made."""
    is_foreign = staged.exists() and not (staged / LOCK).exists() and any(staged.iterdir())
    if staged.is_symlink() or is_foreign:
        raise StoreError(f"{staged} is in the way, where exports are staged; remove it")


def _take_up(staged: Path, claim: bytes) -> None:
    """Keeps what an attempt with the same claim has finished, and nothing of any other."""
    file = staged / CLAIM
    try:
        if read_plain_file(file, limit=len(claim)) == claim:
            return
    except (OSError, ValueError):
        pass  # none, or of another export
    file.unlink(missing_ok=True)
    for folder in (staged / FINISHED, staged / OPEN):
        remove_tree(folder)
    make_folders(staged / FINISHED)
    write_file(file, claim)
    disk.sync(staged)


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
