"""Batches: gathers their rows, with one gather per kind, into reused memory; returns to go of their steps."""

import weakref
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tcmrl_data.envs.base import Reward
from tcmrl_data.foundation.errors import RequestError
from tcmrl_data.sampling.draws import BatchRequest, Draw, Kind, Trajectories, Transitions
from tcmrl_data.sampling.rows import CHUNK_ROWS, Episodes, Indices, PackedRows, Table, Values

SPARE_BUFFERS = 8
"""Maximum number of unused buffers kept for later batches."""

PINNED_BUFFERS = 4
DEVICE_SHARE = 0.5
"""Maximum share of a device's free memory for rows."""


@dataclass(frozen=True)
class Steps:
    """Transitions with any leading shape; observations and next observations share memory.

    Padding after the end of an episode is zero, except that it may repeat the last observation.

    Attributes:
        observations: (..., observation_dim).
        actions: (..., action_dim) in [-1, 1].
        rewards: (...); the dense ones if the kind was requested with `rewards="dense"`.
        next_observations: (..., observation_dim).
        terminated: (...) float, 1 if the task ended the episode, else 0; a time limit is 0.
        mask: (...) bool, False on padding.
        returns_to_go: (...) sum over k of gamma^k r_{t+k} to the end of the episode, for any kind of end.
        discounts_to_end: (...) gamma^(T - t), the weight of the final observation's value; 0 if the task
            ended the episode.
        final_observations: (..., observation_dim), s_T.
        times: (...) int64, t.

    The last four are None unless the kind was requested with `returns=True`.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    next_observations: Tensor
    terminated: Tensor
    mask: Tensor
    returns_to_go: Tensor | None = None
    discounts_to_end: Tensor | None = None
    final_observations: Tensor | None = None
    times: Tensor | None = None

    def map(self, change: Callable[[Tensor], Tensor]) -> "Steps":
        """The steps with all their tensors changed."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        changed: dict[str, Any] = {
            name: None if value is None else change(value) for name, value in given.items()
        }
        return Steps(**changed)


@dataclass(frozen=True)
class Batch:
    """The n-th batch of a stream, float32.

    Its tensors are views into one buffer and must not be written to. The buffer is reused when no tensor
    refers to it any more, so batches may be kept.

    Attributes:
        task_indices: (tasks,) int64, distinct.
        steps: the requested kinds by name. The leading shape of transitions is (tasks, number), of windows
            (tasks, number, length), and of trajectories, padded at the end, (tasks, number, longest episode).
            A window lies within one episode.

    Example:
        >>> batch = sampler.batch(0)  # doctest: +SKIP
        >>> batch["context"].rewards.shape  # doctest: +SKIP
        torch.Size([16, 2, 200])
    """

    task_indices: Tensor
    steps: Mapping[str, Steps]

    def __getitem__(self, name: str) -> Steps:
        """The steps of one kind.

        Raises:
            RequestError: the batch's request has no such kind, or asks for 0 of it.
        """
        if name not in self.steps:
            raise RequestError(f"no kind {name!r} in this batch, which holds {self.names()}; request it")
        return self.steps[name]

    def __contains__(self, name: object) -> bool:
        return name in self.steps

    def names(self) -> list[str]:
        """The names of the kinds, in the order of the request."""
        return list(self.steps)


@dataclass(frozen=True)
class Endings:
    """Returns to go of packed rows; the other values are computed from the positions of episodes.

    Attributes:
        returns_to_go: (rows,) discounted sum of rewards from a step to the end of its episode; 0 for rows
            that are not steps.
        discounts: (longest episode + 1,) powers of gamma, from gamma^0.
    """

    rows: PackedRows
    returns_to_go: Table
    discounts: Table

    @classmethod
    def of(cls, rows: PackedRows, gamma: float, rewards: Reward = "stored") -> "Endings":
        """Computes the endings for a discount factor, in double precision and chunks of whole episodes."""
        column = rows.reward_column(rewards)
        episodes, returns = rows.episodes, np.zeros(len(rows.table), dtype=np.float32)
        ends = episodes.starts + episodes.lengths
        first = 0
        while first < len(ends):
            last = max(first + 1, int(np.searchsorted(ends, episodes.starts[first] + CHUNK_ROWS)))
            chunk = slice(int(episodes.starts[first]), int(ends[last - 1]) + 1)
            within = Episodes(
                episodes.starts[first:last] - chunk.start, episodes.lengths[first:last], episodes.task_ranges
            )
            returns[chunk] = _returns_to_go(rows.table[chunk, column].astype(np.float64), within, gamma)
            first = last
        discounts = gamma ** np.arange(episodes.longest + 1, dtype=np.float64)
        return cls(rows, returns, discounts.astype(np.float32))

    def attach(self, steps: Steps, first_rows: Indices) -> Steps:
        """The steps with their returns to go and other endings; endings are zero on padding.

        Args:
            steps: transitions (tasks, number), or windows or trajectories (tasks, number, length).
            first_rows: (tasks, number) first rows of the transitions, windows or trajectories.
        """
        rows, shape = self.rows, steps.rewards.shape
        length = 1 if len(shape) == 2 else shape[-1]
        episodes = np.searchsorted(rows.episodes.starts, first_rows, side="right") - 1
        starts, lengths = rows.episodes.starts[episodes], rows.episodes.lengths[episodes]
        times = (first_rows - starts)[..., None] + np.arange(length)
        is_step = times < lengths[..., None]
        times = np.where(is_step, times, 0)
        returns = np.where(is_step, self.returns_to_go[starts[..., None] + times], 0)
        ended = rows.table[starts + lengths - 1, rows.terminated_column] > 0
        weighs = is_step & ~ended[..., None]
        discounts = np.where(weighs, self.discounts[lengths[..., None] - times], 0)
        final = rows.table[starts + lengths, : rows.observation_dim][..., None, :] * is_step[..., None]
        vectors = (*shape, rows.observation_dim)
        device = steps.rewards.device
        return replace(
            steps,
            returns_to_go=torch.from_numpy(returns.reshape(shape)).to(device),
            discounts_to_end=torch.from_numpy(discounts.reshape(shape)).to(device),
            final_observations=torch.from_numpy(final.reshape(vectors)).to(device),
            times=torch.from_numpy(times.reshape(shape)).to(device),
        )


def _returns_to_go(rewards: Values, episodes: Episodes, gamma: float) -> Values:
    """G_t = r_t + gamma G_{t+1} with G_T = 0, (rows,); computed backwards in t for all episodes together."""
    result = np.zeros(len(rewards))
    returns = np.zeros(len(episodes.starts))
    for t in range(episodes.longest - 1, -1, -1):
        active = np.flatnonzero(episodes.lengths > t)
        rows = episodes.starts[active] + t
        returns[active] = rewards[rows] + gamma * returns[active]
        result[rows] = returns[active]
    return result


@dataclass(frozen=True)
class _Block:
    """Position of a kind in a buffer; does not depend on the number drawn for a batch.

    Attributes:
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
        table: the table of the rows, in host memory or on the device.
        endings: by rewards, for the kinds that are requested with `returns=True`.
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
        self._rows, self._device, self._endings = rows, device, endings
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
        self._full_masks: dict[tuple[int, ...], Tensor] = {}

    def _floats(self, kind: Kind) -> int:
        """Number of floats of one transition, window or trajectory, with the observation after it."""
        if isinstance(kind, Trajectories):
            return (self._longest + 1) * self._width
        return kind.length * self._width + self._rows.observation_dim

    def __call__(self, draw: Draw) -> Batch:
        """Gathers the batch of a draw on the device."""
        memory = self._buffers.take()
        starts = self._rows.episodes.starts
        rows = {
            name: starts[picks] if isinstance(self._blocks[name].kind, Trajectories) else picks
            for name, picks in draw.picks.items()
        }
        masks = {name: self._gather(memory, block, rows[name]) for name, block in self._blocks.items()}
        memory = self._buffers.hand_out(memory)
        steps = {
            name: self._steps(memory, block, rows[name], masks[name]) for name, block in self._blocks.items()
        }
        return Batch(torch.from_numpy(self._rows.task_indices[draw.tasks]), steps)

    def _gather(self, memory: Tensor, block: _Block, rows: Indices) -> Tensor | None:
        floats = block.view.shape[1]
        out = memory[block.offset : block.offset + rows.size * floats].view(rows.size, floats)
        if rows.size:
            index = torch.from_numpy(rows.reshape(-1)).to(memory.device)
            torch.index_select(block.view, 0, index, out=out)
        is_padded = isinstance(block.kind, Trajectories) and self._is_ragged
        return self._clear_padding(out, rows) if is_padded else None

    def _clear_padding(self, out: Tensor, rows: Indices) -> Tensor:
        episodes = self._rows.episodes
        drawn = np.searchsorted(episodes.starts, rows)
        lengths = torch.from_numpy(episodes.lengths[drawn]).to(out.device)[..., None]
        t = torch.arange(self._longest + 1, device=out.device)
        block = out.view(*rows.shape, self._longest + 1, self._width)
        block.masked_fill_((t > lengths)[..., None], 0.0)
        return (t[:-1] < lengths).to(self._device)

    def _steps(self, memory: Tensor, block: _Block, rows: Indices, mask: Tensor | None) -> Steps:
        """Views of a kind in the buffer; without a mask, nothing is padding."""
        kind, floats, action_dim = block.kind, block.view.shape[1], self._rows.action_dim
        shape: tuple[int, ...] = rows.shape
        strides: tuple[int, ...] = (rows.shape[1] * floats, floats)
        if not isinstance(kind, Transitions):
            length = self._longest if isinstance(kind, Trajectories) else kind.length
            shape, strides = (*shape, length), (*strides, self._width)
        if mask is None and shape not in self._full_masks:
            self._full_masks[shape] = torch.ones(shape, dtype=torch.bool, device=self._device)

        def vectors(column: int, size: int) -> Tensor:
            return memory.as_strided((*shape, size), (*strides, 1), block.offset + column)

        def numbers(column: int) -> Tensor:
            return memory.as_strided(shape, strides, block.offset + column)

        observation_dim = self._rows.observation_dim
        steps = Steps(
            observations=vectors(0, observation_dim),
            actions=vectors(observation_dim, action_dim),
            rewards=numbers(self._rows.reward_column(kind.rewards)),
            next_observations=vectors(self._width, observation_dim),
            terminated=numbers(self._rows.terminated_column),
            mask=self._full_masks[shape] if mask is None else mask,
        )
        return self._endings[kind.rewards].attach(steps, rows) if kind.returns else steps


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
