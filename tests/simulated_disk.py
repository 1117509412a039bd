"""Simulated disks that fail or lose data, and an engine that publishes finished parts."""

import errno
import os
import signal
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

import tcmrl_data
from tcmrl_data import BuildReport, Dataset, Recipe, TcmrlError
from tcmrl_data.build import build
from tcmrl_data.engine.base import BaseEngine, Message, Result, Unit
from tcmrl_data.foundation import disk as publish
from tcmrl_data.foundation.disk import Disk, publish_folder
from tcmrl_data.store.manifest import part_folder

Fault = Literal["kill", "torn", "full", "broken"]
FAULTS: tuple[Fault, ...] = ("kill", "torn", "full", "broken")
Operation = tuple[str, Path, Path | bytes | None]


class PreparedParts:
    """All parts of one task of a real dataset, published again by the code that workers use."""

    def __init__(self, dataset: Dataset, recipe: Recipe, task: int) -> None:
        self.recipe, self.task = recipe, task
        self.parts = {
            step: {
                path.relative_to(folder).as_posix(): path.read_bytes()
                for path in sorted(folder.rglob("*"))
                if path.is_file()
            }
            for step in dataset.snapshots(task)
            for folder in [dataset.folder_of(task, step)]
        }

    def build(self, out: Path, patch: pytest.MonkeyPatch) -> BuildReport:
        """A build of the task whose one unit publishes the prepared parts."""
        parts, task = self.parts, self.task

        class Engine(BaseEngine):
            def run(self, units: Sequence[Unit], on_message: Message) -> Generator[Result, None, None]:
                for unit in units:
                    try:
                        for step, files in parts.items():
                            publish_folder(out, out / part_folder(task, step), files, attempt="prepared")
                            on_message(unit.id, {"kind": "part", "task": task, "step": step})
                    except TcmrlError as error:
                        yield Result(unit.id, False, None, str(error), 1, "here")
                    else:
                        yield Result(unit.id, True, "digest", None, 1, "here")

        patch.setattr(build.ENGINES, "get", lambda name: Engine)
        return tcmrl_data.build_dataset(self.recipe, out, tasks=[task], workers=1)


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

    def sync(self, path: Path) -> None:
        super().sync(path)
        self.log.append(("sync", path, None))

    def rename(self, source: Path, target: Path) -> None:
        super().rename(source, target)
        self.log.append(("rename", source, target))


class FaultyDisk(Disk):
    """Fails at one operation: the process dies, dies in the middle of a write, or the system refuses."""

    def __init__(self, at: int, fault: Fault) -> None:
        self._left, self._fault = at, fault

    def _count(self, path: Path, data: bytes = b"") -> None:
        self._left -= 1
        if self._left >= 0:
            return
        if self._fault == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if data:
            path.write_bytes(data[: len(data) // 2])
        if self._fault == "torn":
            os.kill(os.getpid(), signal.SIGKILL)
        raise OSError(errno.ENOSPC if self._fault == "full" else errno.EIO, "injected")

    def make_folder(self, path: Path) -> None:
        self._count(path)
        super().make_folder(path)

    def write(self, path: Path, data: bytes) -> None:
        self._count(path, data)
        super().write(path, data)

    def sync(self, path: Path) -> None:
        self._count(path)
        super().sync(path)

    def rename(self, source: Path, target: Path) -> None:
        self._count(target)
        super().rename(source, target)


def run_with_fault(parts: PreparedParts, out: Path, at: int, fault: Fault) -> int:
    """Builds in a forked process whose disk fails at one operation; its exit status."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 3
    try:
        publish.disk = FaultyDisk(at, fault)
        with pytest.MonkeyPatch.context() as patch:
            status = 1 if parts.build(out, patch).failed else 0
    except TcmrlError:
        status = 1
    finally:
        os._exit(status)


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

    A file's bytes are durable after it was synced; a name in a folder is durable after the folder was.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._tree = _Node(is_folder=True)

    def apply(self, operation: Operation) -> None:
        """Applies one recorded operation in memory."""
        name, path, more = operation
        if name == "sync":
            node = self._node(path)
            node.durable_content, node.durable_entries = node.content, dict(node.entries)
        elif name == "rename":
            assert isinstance(more, Path)
            self._node(more.parent).entries[more.name] = self._node(path.parent).entries.pop(path.name)
        else:
            content = more if isinstance(more, bytes) else b""
            self._node(path.parent).entries[path.name] = _Node(name == "make_folder", content)

    def leave(self, out: Path, *, names_survive: bool) -> None:
        """Writes the state after a power cut, without unsynced bytes; unsynced names may survive."""
        self._write(self._tree, out, names_survive)

    def _write(self, node: _Node, path: Path, names_survive: bool) -> None:
        if not node.is_folder:
            path.write_bytes(node.durable_content)
            return
        path.mkdir(exist_ok=True)
        entries: Mapping[str, _Node] = node.entries if names_survive else node.durable_entries
        for name, child in entries.items():
            self._write(child, path / name, names_survive)

    def _node(self, path: Path) -> _Node:
        node = self._tree
        for name in path.relative_to(self._root).parts:
            node = node.entries[name]
        return node
