"""Gathers the rows of a batch, with one gather per kind, into reused memory."""

import weakref
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from tcmrl_data.envs.base import Reward
from tcmrl_data.sampling.batch import Batch, Steps
from tcmrl_data.sampling.draws import Draw
from tcmrl_data.sampling.endings import Endings
from tcmrl_data.sampling.request import BatchRequest, Kind, Trajectories, Transitions
from tcmrl_data.sampling.rows import Indices, PackedRows, Table

SPARE_BUFFERS = 8
"""Maximum number of unused buffers kept for later batches."""

PINNED_BUFFERS = 4
DEVICE_SHARE = 0.5
"""Maximum share of a device's free memory for rows."""

_Field = tuple[tuple[int, ...], tuple[int, ...], int]
"""Shape, strides and offset of a view."""

_Fields = tuple[list[_Field], Tensor]
"""The first five fields of `Steps`, and the mask."""


@dataclass(frozen=True)
class _Block:
    """Position of a kind in a buffer; does not depend on the number drawn for a batch.

    Attributes:
        kind: the requested kind.
        view: (rows, floats) overlapping blocks of the table; row i is the block that starts at row i.
        offset: number of floats in front of the kind.
    """

    kind: Kind
    view: Tensor
    offset: int


class Gatherer:
    """Gathers batches, given their indices.

    K steps and the observation after them are one contiguous block of the table. In a view with overlapping
    rows (row i is the block that starts at row i), one index selects a transition, window or trajectory.

    Args:
        rows: the packed selection.
        table: the table of the rows, in host memory or on the device.
        request: the content of a batch.
        num_tasks: tasks per batch.
        device: device of the batches.
        endings: endings of the rows by rewards; those of kinds that are requested with `returns=True`.
    """

    def __init__(
        self,
        rows: PackedRows,
        table: Tensor,
        request: BatchRequest,
        *,
        num_tasks: int,
        device: torch.device,
        endings: Mapping[Reward, Endings] = MappingProxyType({}),
    ) -> None:
        self._rows, self._device, self._num_tasks, self._endings = rows, device, num_tasks, endings
        self._width: int = rows.table.shape[1]
        self._longest = rows.episodes.longest
        self._is_ragged = bool((rows.episodes.lengths != self._longest).any())
        self._blocks: dict[str, _Block] = {}
        end = 0
        for name, kind in request.kinds.items():
            view = _overlapping(table, self._floats(kind))
            self._blocks[name] = _Block(kind, view, end)
            end += num_tasks * kind.number * view.shape[1]
        self._buffers: _HostBuffers | _PinnedBuffers | _DeviceBuffers
        if device.type == "cuda":
            self._buffers = (_DeviceBuffers if table.is_cuda else _PinnedBuffers)(end, device)
        else:
            self._buffers = _HostBuffers(end, device)
        self._layouts: dict[tuple[str, int], _Fields | Steps] = {}

    def _floats(self, kind: Kind) -> int:
        """Number of floats of one transition, window or trajectory, with the observation after it."""
        if isinstance(kind, Trajectories):
            return (self._longest + 1) * self._width
        return kind.length * self._width + self._rows.observation_dim

    def __call__(self, draw: Draw) -> Batch:
        """Gathers the batch of a draw on the device."""
        memory = self._buffers.take()
        rows = {name: self._first_rows(name, picks) for name, picks in draw.picks.items()}
        masks = {name: self._gather(memory, block, rows[name]) for name, block in self._blocks.items()}
        memory = self._buffers.hand_out(memory)
        steps = {}
        for name, mask in masks.items():
            layout = self._layout(name, rows[name].shape[1])
            found = layout if isinstance(layout, Steps) else _steps(memory, *layout)
            found = found if mask is None else replace(found, mask=mask)
            kind = self._blocks[name].kind
            if kind.returns:
                found = self._endings[kind.rewards].attach(found, rows[name])
            steps[name] = found
        return Batch(torch.from_numpy(self._rows.task_indices[draw.tasks]), steps)

    def _first_rows(self, name: str, picks: Indices) -> Indices:
        is_trajectory = isinstance(self._blocks[name].kind, Trajectories)
        return self._rows.episodes.starts[picks] if is_trajectory else picks

    def _gather(self, memory: Tensor, block: _Block, rows: Indices) -> Tensor | None:
        """Copies a kind into the buffer; returns its mask, or None if nothing is padding."""
        floats = block.view.shape[1]
        out = memory[block.offset : block.offset + rows.size * floats].view(rows.size, floats)
        if rows.size:
            index = torch.from_numpy(rows.reshape(-1)).to(memory.device)
            torch.index_select(block.view, 0, index, out=out)
        is_padded = isinstance(block.kind, Trajectories) and self._is_ragged
        return self._clear_padding(out, rows) if is_padded else None

    def _clear_padding(self, out: Tensor, rows: Indices) -> Tensor:
        """Sets padding to zero; returns the mask (tasks, number, longest episode)."""
        episodes = self._rows.episodes
        drawn = np.searchsorted(episodes.starts, rows)
        lengths = torch.from_numpy(episodes.lengths[drawn]).to(out.device)[..., None]
        t = torch.arange(self._longest + 1, device=out.device)
        block = out.view(*rows.shape, self._longest + 1, self._width)
        block.masked_fill_((t > lengths)[..., None], 0.0)
        return (t[:-1] < lengths).to(self._device)

    def _layout(self, name: str, number: int) -> _Fields | Steps:
        """Views of a kind's fields in a buffer, or the empty steps if `number` is 0."""
        if (name, number) not in self._layouts:
            block = self._blocks[name]
            floats = block.view.shape[1]
            shape: tuple[int, ...] = (self._num_tasks, number)
            strides: tuple[int, ...] = (number * floats, floats)
            if not isinstance(block.kind, Transitions):
                length = self._longest if isinstance(block.kind, Trajectories) else block.kind.length
                shape, strides = (*shape, length), (*strides, self._width)
            self._layouts[name, number] = self._fields(shape, strides, block)
        return self._layouts[name, number]

    def _fields(self, shape: tuple[int, ...], strides: tuple[int, ...], block: _Block) -> _Fields | Steps:
        """Views of the fields of a kind's steps in a buffer, and a mask of ones."""
        observation_dim, action_dim = self._rows.observation_dim, self._rows.action_dim
        offset, reward = block.offset, self._rows.reward_column(block.kind.rewards)
        vectors, rows = (*shape, observation_dim), (*strides, 1)
        fields = [
            (vectors, rows, offset),
            ((*shape, action_dim), rows, offset + observation_dim),
            (shape, strides, offset + reward),
            (vectors, rows, offset + self._width),
            (shape, strides, offset + self._rows.terminated_column),
        ]
        mask = torch.ones(shape, dtype=torch.bool, device=self._device)
        if 0 in shape:
            empty = torch.empty(0, device=self._device)
            return _steps(empty, [(size, stride, 0) for size, stride, _ in fields], mask)
        return fields, mask


def _steps(memory: Tensor, fields: list[_Field], mask: Tensor) -> Steps:
    observations, actions, rewards, following, terminated = (memory.as_strided(*field) for field in fields)
    return Steps(observations, actions, rewards, following, terminated, mask)


def place_table(table: Table, device: torch.device) -> Tensor:
    """The table on a CUDA device if it takes at most half of the free memory there, else in host memory."""
    tensor = torch.from_numpy(table)
    if device.type == "cuda" and tensor.nbytes <= DEVICE_SHARE * torch.cuda.mem_get_info(device)[0]:
        return tensor.to(device)
    return tensor


def _overlapping(table: Tensor, floats: int) -> Tensor:
    """A view (blocks, floats) of the table; block i starts at row i, and blocks overlap."""
    width = table.shape[1]
    rows = max(0, (table.numel() - floats) // width + 1)
    return table.as_strided((rows, floats), (width, 1))


class _HostBuffers:
    """Host memory that is reused when its last tensor is deleted."""

    def __init__(self, floats: int, device: torch.device) -> None:
        self._floats, self._device = floats, device
        self._spare: deque[Table] = deque(maxlen=SPARE_BUFFERS)

    def take(self) -> Tensor:
        try:
            memory = self._spare.pop()
        except IndexError:
            memory = np.empty(self._floats, dtype=np.float32)
        lease = memory[:]  # a new view; torch keeps it alive as long as a tensor uses the memory
        weakref.finalize(lease, self._spare.append, memory).atexit = False
        return torch.from_numpy(lease)

    def hand_out(self, memory: Tensor) -> Tensor:
        return memory.to(self._device)


class _DeviceBuffers:
    """Memory of the device, reused by torch's allocator."""

    def __init__(self, floats: int, device: torch.device) -> None:
        self._floats, self._device = floats, device

    def take(self) -> Tensor:
        return torch.empty(self._floats, device=self._device)

    def hand_out(self, memory: Tensor) -> Tensor:
        return memory


class _PinnedBuffers:
    """Page-locked memory, copied to the device asynchronously and reused after the copy."""

    def __init__(self, floats: int, device: torch.device) -> None:
        self._device = device
        self._free = deque(
            (torch.empty(floats, pin_memory=True), torch.cuda.Event()) for _ in range(PINNED_BUFFERS)
        )
        self._copied: dict[int, torch.cuda.Event] = {}

    def take(self) -> Tensor:
        memory, copied = self._free.popleft()
        copied.synchronize()  # the oldest copy; usually complete
        self._copied[memory.data_ptr()] = copied
        return memory

    def hand_out(self, memory: Tensor) -> Tensor:
        result = memory.to(self._device, non_blocking=True)
        copied = self._copied.pop(memory.data_ptr())
        copied.record(torch.cuda.current_stream(self._device))
        self._free.append((memory, copied))
        return result
