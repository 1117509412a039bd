"""Simulated disks that fail or lose data, and an engine that publishes finished parts."""

import errno
import os
import shutil
import signal
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

import tcmrl_data
from tcmrl_data import BuildEvent, BuildReport, Dataset, Recipe, TcmrlError
from tcmrl_data.building import build, ledger
from tcmrl_data.engine.base import BaseEngine, Message, Result, Unit
from tcmrl_data.foundation import disk as publish
from tcmrl_data.foundation.disk import STAGING, Disk, replace_file
from tcmrl_data.parts.making import read_published
from tcmrl_data.store import tables
from tcmrl_data.store.tables import PartKey, part_file

Fault = Literal["kill", "torn", "full", "broken", "once"]
FAULTS: tuple[Fault, ...] = ("kill", "torn", "full", "broken", "once")
Loss = Literal["all", "content", "nothing", "half", "zeros", "even names", "odd names"]
LOSSES: tuple[Loss, ...] = ("all", "content", "nothing", "half", "zeros", "even names", "odd names")
"""What a power cut takes of what was not forced to disk."""
KeysOf = Callable[[Unit], Sequence[PartKey]]
Operation = tuple[str, Path, Path | bytes | tuple[int, bytes] | None]


def prepared_engine(out: Path, files: Mapping[PartKey, bytes], keys_of: KeysOf) -> BaseEngine:
    """An engine whose units publish finished parts in a folder, as workers do.

    Args:
        out: the folder.
        files: the parts.
        keys_of: which of them a unit publishes.
    """

    def publish_part(key: PartKey) -> Mapping[str, Any]:
        file = out / part_file(key)
        if not file.exists():
            replace_file(file, files[key], staging=out / STAGING)
        return read_published(file, key.run)[0].to_message()

    class Engine(BaseEngine):
        def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
            for unit in units:
                error = None
                for key in keys_of(unit):
                    if error is None:
                        try:
                            message = publish_part(key)
                        except TcmrlError as problem:
                            error = str(problem)
                        else:
                            on_message(unit.id, message)
                yield Result(unit.id, error is None, None if error else "digest", error, 1, "here")

    return Engine()


class PreparedParts:
    """Parts of a real dataset, which builds publish again as workers do, instead of making them."""

    def __init__(self, dataset: Dataset, recipe: Recipe, tasks: Sequence[int]) -> None:
        self.recipe, self.tasks = recipe, tasks
        self.files = {
            key: dataset.file_of(key).read_bytes() for task in tasks for key in dataset.parts.keys_of(task)
        }

    def build(
        self,
        out: Path,
        patch: pytest.MonkeyPatch,
        *,
        tasks: Sequence[int] | None = None,
        progress: Callable[[BuildEvent], None] = lambda event: None,
    ) -> BuildReport:
        """A build whose units publish the prepared parts."""

        def keys_of(unit: Unit) -> list[PartKey]:
            indices = {task["index"] for task in unit.spec["plan"]["tasks"]}
            return [key for key in self.files if key.task in indices]

        engine = prepared_engine(out, self.files, keys_of)
        patch.setattr(build, "make_engine", lambda name, workers, address: engine)
        tasks = self.tasks if tasks is None else tasks
        return tcmrl_data.build_dataset(self.recipe, out, tasks=tasks, workers=1, progress=progress)


class RecordingDisk(Disk):
    """Executes and records every operation."""

    def __init__(self) -> None:
        self.log: list[Operation] = []

    def make_folder(self, path: Path) -> None:
        super().make_folder(path)
        self.log.append(("make_folder", path, None))

    def write(self, path: Path, data: bytes) -> None:
        super().write(path, data)
        self.log.append(("write", path, data))

    def write_at(self, path: Path, offset: int, data: bytes) -> None:
        super().write_at(path, offset, data)
        self.log.append(("write_at", path, (offset, data)))

    def truncate(self, path: Path, size: int) -> None:
        super().truncate(path, size)
        self.log.append(("truncate", path, (size, b"")))

    def sync(self, path: Path) -> None:
        super().sync(path)
        self.log.append(("sync", path, None))

    def rename(self, source: Path, target: Path) -> None:
        super().rename(source, target)
        self.log.append(("rename", source, target))


class FaultyDisk(Disk):
    """Fails at one operation: the process dies, dies in the middle of a write, or the system refuses.

    The system refuses all later operations too, but after the fault `once`.
    """

    def __init__(self, at: int, fault: Fault) -> None:
        self._left, self._fault = at, fault

    def _count(self, path: Path, data: bytes = b"", offset: int = 0) -> None:
        self._left -= 1
        if self._left >= 0 or (self._fault == "once" and self._left < -1):
            return
        if self._fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if data:
            Disk().write_at(path, offset, data[: len(data) // 2])
        if self._fault == "torn":
            os.kill(os.getpid(), signal.SIGKILL)
        raise OSError(errno.ENOSPC if self._fault == "full" else errno.EIO, "injected")

    def make_folder(self, path: Path) -> None:
        self._count(path)
        super().make_folder(path)

    def write(self, path: Path, data: bytes) -> None:
        self._count(path, data)
        super().write(path, data)

    def write_at(self, path: Path, offset: int, data: bytes) -> None:
        self._count(path, data, offset)
        super().write_at(path, offset, data)

    def truncate(self, path: Path, size: int) -> None:
        self._count(path)
        super().truncate(path, size)

    def sync(self, path: Path) -> None:
        self._count(path)
        super().sync(path)

    def rename(self, source: Path, target: Path) -> None:
        self._count(target)
        super().rename(source, target)


def run_with_fault(work: Callable[[], object], at: int, fault: Fault) -> int:
    """Does some work in a forked process whose disk fails at one operation.

    Returns:
        The process's exit status: 0 if the work was done, 1 if an error said in words why not.
    """
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 3
    try:
        publish.disk = tables.disk = FaultyDisk(at, fault)
        work()
        status = 0
    except TcmrlError:
        status = 1
    finally:
        os._exit(status)


def at_last_part(parts: PreparedParts, out: Path, patch: pytest.MonkeyPatch) -> None:
    """Leaves what a build leaves that is killed after its last part, before the manifest names any."""
    patch.setattr(ledger, "SEAL_SECONDS", 1e9)
    kept = out.with_name("at the last part")

    def copy(event: BuildEvent) -> None:
        if event.kind == "part" and event.parts_done == len(parts.files):
            shutil.copytree(out, kept)

    parts.build(out, patch, progress=copy)
    shutil.rmtree(out)
    kept.rename(out)


@dataclass
class _Node:
    """A file or folder as the system sees it, and its content on disk after a power cut."""

    is_folder: bool
    content: bytes = b""
    durable_content: bytes = b""
    entries: dict[str, "_Node"] = field(default_factory=dict)
    durable_entries: dict[str, "_Node"] = field(default_factory=dict)


class PowerCut:
    """Replays a log of operations and shows what a power cut would leave.

    A file's bytes are durable after it was synced; a name in a folder is durable after the folder was. Of
    what is not durable a power cut may leave nothing, all of it, the first half of a file's new bytes, zeros
    in their place, or some names of a folder and not the others.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._tree = _Node(is_folder=True)

    def load(self, path: Path) -> None:
        """Takes a file or folder below the root as it stands, as forced to disk."""
        node = self._tree if path == self._root else _Node(path.is_dir())
        if path.is_file():
            node.content = node.durable_content = path.read_bytes()
        if path != self._root:
            parent = self._node(path.parent)
            parent.entries[path.name] = parent.durable_entries[path.name] = node
        for child in path.iterdir() if path.is_dir() else ():
            self.load(child)

    def apply(self, operation: Operation) -> None:
        """Applies one recorded operation in memory."""
        name, path, more = operation
        if name == "sync":
            node = self._node(path)
            node.durable_content, node.durable_entries = node.content, dict(node.entries)
        elif name == "rename":
            assert isinstance(more, Path)
            self._node(more.parent).entries[more.name] = self._node(path.parent).entries.pop(path.name)
        elif name == "write_at":
            assert isinstance(more, tuple)
            offset, data = more
            node = self._node(path.parent).entries.setdefault(path.name, _Node(is_folder=False))
            node.content = (
                node.content[:offset].ljust(offset, b"\0") + data + node.content[offset + len(data) :]
            )
        elif name == "truncate":
            assert isinstance(more, tuple)
            self._node(path).content = self._node(path).content[: more[0]]
        else:
            content = more if isinstance(more, bytes) else b""
            self._node(path.parent).entries[path.name] = _Node(name == "make_folder", content)

    def leave(self, out: Path, loss: Loss) -> None:
        """Writes the state after a power cut."""
        self._write(self._tree, out, loss)

    def _write(self, node: _Node, path: Path, loss: Loss) -> None:
        if not node.is_folder:
            path.write_bytes(_surviving_content(node, loss))
            return
        path.mkdir(exist_ok=True)
        for name, child in _surviving_entries(node, loss).items():
            self._write(child, path / name, loss)

    def _node(self, path: Path) -> _Node:
        node = self._tree
        for name in path.relative_to(self._root).parts:
            node = node.entries[name]
        return node


def _surviving_content(node: _Node, loss: Loss) -> bytes:
    new, old = node.content, node.durable_content
    if loss == "nothing":
        return new
    if loss == "half":
        first = min(len(new), len(old))
        return new[: first + (len(new) - first) // 2] if new.startswith(old) else new[: len(new) // 2]
    if loss == "zeros":
        return old[: len(new)].ljust(len(new), b"\0")
    return old


def _surviving_entries(node: _Node, loss: Loss) -> Mapping[str, _Node]:
    new, old = node.entries, node.durable_entries
    if loss in ("all", "nothing", "content", "half", "zeros"):
        return old if loss == "all" else new
    changed = sorted(name for name in {*new, *old} if new.get(name) is not old.get(name))
    changed = changed[loss == "odd names" :: 2]
    kept = {name: node for name, node in old.items() if name not in changed}
    return kept | {name: new[name] for name in changed if name in new}
