"""From rows to a batch: one gather of blocks of rows per kind, into memory that is used again."""

import weakref
from collections import deque
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tcmrl_data.sampling.batch import Batch, BatchSizes, Steps
from tcmrl_data.sampling.draws import Draw
from tcmrl_data.sampling.rows import Rows, Table

SPARE_BUFFERS = 8
"""Buffers kept for later batches; more exist while more batches are held."""

PINNED_BUFFERS = 4
DEVICE_SHARE = 0.5
"""Of a device's free memory, the most that rows may take there."""

_Field = tuple[tuple[int, ...], tuple[int, ...], int]
"""Size, strides and offset of a view."""

_Fields = tuple[list[_Field], Tensor]
"""The fields of steps in their order, and the mask."""


class Gatherer:
    """Fetches a drawn batch.

    K steps and the observation behind them are one stretch of the table, so a view whose rows overlap
    (row i: the block that starts at row i) gives a transition, a window or a trajectory by one index.
    """

    def __init__(self, rows: Rows, sizes: BatchSizes, *, num_tasks: int, device: torch.device) -> None:
        self._rows, self._device = rows, device
        self._width, self._longest = rows.table.shape[1], rows.episodes.longest
        self._is_ragged = bool((rows.episodes.lengths != self._longest).any())
        step = self._width + rows.observation_dim
        window = sizes.window_length * self._width + rows.observation_dim
        trajectory = (self._longest + 1) * self._width
        table = torch.from_numpy(rows.table)
        if device.type == "cuda" and table.nbytes <= DEVICE_SHARE * torch.cuda.mem_get_info(device)[0]:
            table = table.to(device)
        self._views = [_overlapping(table, floats) for floats in (step, window, trajectory)]
        most = max(sizes.context_trajectories) + sizes.execution_trajectories
        each_task = sizes.transitions * step + sizes.windows * window + most * trajectory
        self._buffers: _HostBuffers | _PinnedBuffers | _DeviceBuffers
        if device.type == "cuda":
            kind = _DeviceBuffers if table.is_cuda else _PinnedBuffers
            self._buffers = kind(num_tasks * each_task, device)
        else:
            self._buffers = _HostBuffers(num_tasks * each_task, device)
        self._layouts: dict[int, list[_Fields | Steps]] = {}
        self._window_length = sizes.window_length

    def __call__(self, draw: Draw) -> Batch:
        """The batch of a draw, on the device."""
        starts = self._rows.episodes.starts[draw.trajectories]
        memory = self._buffers.take()
        ends, end = [0], 0
        for view, rows in zip(self._views, (draw.transitions, draw.windows, starts), strict=True):
            if rows.size:
                end += rows.size * view.shape[1]
                block = memory[ends[-1] : end].view(rows.size, view.shape[1])
                index = torch.from_numpy(rows.reshape(-1)).to(memory.device)
                torch.index_select(view, 0, index, out=block)
            ends.append(end)
        mask = self._trajectory_mask(draw, memory[ends[2] : end]) if self._is_ragged else None
        memory = self._buffers.hand_out(memory)
        transitions, windows, context, execution = (
            each if isinstance(each, Steps) else self._steps(memory, *each)
            for each in self._layout(draw, ends)
        )
        if mask is not None:
            context = replace(context, mask=mask[:, : draw.num_context])
            execution = replace(execution, mask=mask[:, draw.num_context :])
        tasks = torch.from_numpy(self._rows.task_indices[draw.tasks])
        return Batch(tasks, transitions, context, execution, windows)

    @staticmethod
    def _steps(memory: Tensor, fields: list[_Field], mask: Tensor) -> Steps:
        observations, actions, rewards, following, terminated = (
            memory.as_strided(*field) for field in fields
        )
        return Steps(observations, actions, rewards, following, terminated, mask)

    def _layout(self, draw: Draw, ends: list[int]) -> list[_Fields | Steps]:
        """Where transitions, windows, context and execution lie, or what they are where they are empty."""
        if draw.num_context not in self._layouts:
            step, window, trajectory = (view.shape[1] for view in self._views)
            count, longest, width = draw.trajectories.shape[1], self._longest, self._width
            split = ends[2] + draw.num_context * trajectory
            windows = (draw.windows.shape[1] * window, window, width)
            trajectories = (count * trajectory, trajectory, width)
            tasks = len(draw.tasks)
            self._layouts[draw.num_context] = [
                self._fields(draw.transitions.shape, (draw.transitions.shape[1] * step, step), ends[0]),
                self._fields((*draw.windows.shape, self._window_length), windows, ends[1]),
                self._fields((tasks, draw.num_context, longest), trajectories, ends[2]),
                self._fields((tasks, count - draw.num_context, longest), trajectories, split),
            ]
        return self._layouts[draw.num_context]

    def _fields(self, shape: tuple[int, ...], strides: tuple[int, ...], offset: int) -> _Fields | Steps:
        """Where the fields of steps lie whose rows lie in a buffer from an offset on, and a full mask."""
        observation_dim, action_dim = self._rows.observation_dim, self._rows.action_dim
        last = offset + self._width - 1
        vectors, rows = (*shape, observation_dim), (*strides, 1)
        fields = [
            (vectors, rows, offset),
            ((*shape, action_dim), rows, offset + observation_dim),
            (shape, strides, last - 1),
            (vectors, rows, offset + self._width),
            (shape, strides, last),
        ]
        mask = torch.ones(shape, dtype=torch.bool, device=self._device)
        if 0 in shape:
            empty = torch.empty(0, device=self._device)
            return self._steps(empty, [(size, stride, 0) for size, stride, _ in fields], mask)
        return fields, mask

    def _trajectory_mask(self, draw: Draw, block: Tensor) -> Tensor:
        """(tasks, trajectories, longest episode); clears in the gathered block what follows an episode."""
        shape = draw.trajectories.shape
        lengths = torch.from_numpy(self._rows.episodes.lengths[draw.trajectories]).to(block.device)[..., None]
        t = torch.arange(self._longest + 1, device=block.device)
        rows = block.view(*shape, self._longest + 1, self._width)
        rows.masked_fill_((t > lengths)[..., None], 0.0)
        return (t[:-1] < lengths).to(self._device)


def _overlapping(table: Tensor, floats: int) -> Tensor:
    """(rows, floats): the block of that many floats from each row on that has one."""
    width = table.shape[1]
    rows = max(0, (table.numel() - floats) // width + 1)
    return table.as_strided((rows, floats), (width, 1))


class _HostBuffers:
    """Memory that comes back by itself when the last tensor over it is gone."""

    def __init__(self, floats: int, device: torch.device) -> None:
        self._floats, self._device = floats, device
        self._spare: deque[Table] = deque(maxlen=SPARE_BUFFERS)

    def take(self) -> Tensor:
        try:
            memory = self._spare.pop()
        except IndexError:
            memory = np.empty(self._floats, dtype=np.float32)
        lease = memory[:]  # a new object over the same memory, which torch holds as long as it needs it
        weakref.finalize(lease, self._spare.append, memory).atexit = False
        return torch.from_numpy(lease)

    def hand_out(self, memory: Tensor) -> Tensor:
        return memory.to(self._device)


class _DeviceBuffers:
    """Memory of the device, where its own allocator uses it again."""

    def __init__(self, floats: int, device: torch.device) -> None:
        self._floats, self._device = floats, device

    def take(self) -> Tensor:
        return torch.empty(self._floats, device=self._device)

    def hand_out(self, memory: Tensor) -> Tensor:
        return memory


class _PinnedBuffers:
    """Page-locked memory, copied to the device without waiting; filled again once it has been copied."""

    def __init__(self, floats: int, device: torch.device) -> None:
        self._device = device
        self._free = deque(
            (torch.empty(floats, pin_memory=True), torch.cuda.Event()) for _ in range(PINNED_BUFFERS)
        )
        self._copied: dict[int, torch.cuda.Event] = {}

    def take(self) -> Tensor:
        memory, copied = self._free.popleft()
        copied.synchronize()  # the oldest copy: long done
        self._copied[memory.data_ptr()] = copied
        return memory

    def hand_out(self, memory: Tensor) -> Tensor:
        result = memory.to(self._device, non_blocking=True)
        copied = self._copied.pop(memory.data_ptr())
        copied.record(torch.cuda.current_stream(self._device))
        self._free.append((memory, copied))
        return result
