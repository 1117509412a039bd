"""The sampler of meta-training batches, and their prefetching by a thread."""

import copy
import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, Self, TypeVar, final

import numpy as np
import numpy.typing as npt
import torch

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.base import Reward
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.machine import available_memory, size
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_sequence
from tcmrl_data.sampling.draws import BatchRequest, Draws, Trajectories
from tcmrl_data.sampling.gather import Batch, Endings, Gatherer, place_table
from tcmrl_data.sampling.rows import (
    Indices,
    Moments,
    PackedRows,
    moments_of,
    plan_rows,
    read_rows,
    table_shape,
)

Item = TypeVar("Item")


def open_sampler(
    selection: Selection,
    request: BatchRequest,
    *,
    seed: int,
    stream: int = 0,
    device: str = "cpu",
    memory_limit: int | None = None,
    say: Callable[[str], None] | None = None,
) -> "Sampler":
    """Loads a selection once and serves meta-training batches from it.

    Args:
        selection: training tasks and snapshots.
        seed: seed of the run; batch n is a function of (seed, stream, n).
        stream: number of the stream; streams with the same seed are independent.
        memory_limit: maximum size of the decoded steps in memory, in bytes; None for half of the available
            memory. Larger selections are decoded into the cache once and read from there.
        say: called with a message if the cache is used.

    Raises:
        SelectionError: the selection holds test tasks, parts made from them, fewer than two tasks, or too
            little data of a task, or lacks dense rewards that the request takes.

    Example:
        >>> request = BatchRequest(tasks=16, kinds={"context": Trajectories(2)})
        >>> sampler = open_sampler(dataset.select(split="train"), request, seed=0)  # doctest: +SKIP
        >>> sampler.batch(0)["context"].rewards.shape  # doctest: +SKIP
        torch.Size([16, 2, 200])
    """
    test = [task.index for task in selection.tasks if task.split == "test"]
    if test:
        raise SelectionError(f"test tasks {test} must not be trained on; select split='train'")
    foreign = [] if selection.allow_test else selection.parts_from_test()
    if foreign:
        key, task = foreign[0]
        raise SelectionError(
            f"the part of {key} was made from task {task}, which is no training task; select other parts, or "
            "allow_test=True if its data may be trained on"
        )
    if len(selection.tasks) < 2:
        raise SelectionError(
            f"meta-training needs at least 2 training tasks, the selection has {len(selection.tasks)}"
        )
    return Sampler(
        load_rows(selection, dense=request.takes_dense, memory_limit=memory_limit, say=say),
        request,
        seed=seed,
        stream=stream,
        environment=selection.dataset.name,
        place=str(selection.dataset.folder),
        device=device,
    )


def load_rows(
    selection: Selection,
    *,
    dense: bool = False,
    memory_limit: int | None = None,
    say: Callable[[str], None] | None = None,
) -> PackedRows:
    """The rows of a selection in memory, or mapped from the cache if they exceed the limit.

    Arguments as of `open_sampler`; `dense` loads dense rewards too.
    """
    rows, width = table_shape(selection, plan_rows(selection, dense=dense))
    needed = 4 * rows * width
    limit = available_memory() // 2 if memory_limit is None else memory_limit
    if needed <= limit:
        return read_rows(selection, dense=dense)
    from tcmrl_data.sampling.cache import cached_rows

    if say:
        why = "half of the available memory" if memory_limit is None else "the memory limit"
        say(f"{size(needed)} of steps exceed {why}, {size(limit)}: using the cache")
    return cached_rows(selection, dense=dense, say=say)


class Sampler:
    """Serves batch n as a pure function of (seed, stream, n); made by `open_sampler`.

    A batch draws tasks without replacement. Within a task it draws transitions and windows uniformly with
    replacement, and trajectories uniformly without replacement. The choice of tasks and every kind have
    their own random streams, so that a kind does not change the draws of another kind. Episodes without a
    step are never drawn, and episodes shorter than a window contain no window. Task parameters are never
    loaded.

    With a CUDA device, rows are stored on the device if they take at most half of its free memory;
    otherwise batches are gathered in page-locked memory and copied asynchronously.

    Args:
        environment: the environment's name, part of the seed's key.
        place: name of the selection in error messages.

    Raises:
        SelectionError: a task has too few steps, trajectories or windows for the request, or the request
            takes dense rewards that are not loaded.
    """

    def __init__(
        self,
        rows: PackedRows,
        request: BatchRequest,
        *,
        seed: int,
        stream: int = 0,
        environment: str,
        place: str,
        device: str = "cpu",
    ) -> None:
        self.device = torch.device(device)
        self._rows, self._place = rows, place
        self._table = place_table(rows.table, self.device)
        sequence = keyed_sequence(seed, environment, NO_TASK, Purpose.SAMPLER, stream)
        self._sequence, self._endings = sequence, dict[tuple[float, Reward], Endings]()
        self._serve(request)

    def _serve(self, request: BatchRequest) -> None:
        if request.takes_dense and not self._rows.has_dense:
            raise SelectionError(
                f"{self._place}: dense rewards are not loaded; open a sampler for a request that takes them"
            )
        self.request = request
        self._draws = Draws(self._rows.episodes, request, sequence=self._sequence)
        self._check()
        endings = {
            kind.rewards: self._endings_of(request.gamma, kind.rewards)
            for kind in request.kinds.values()
            if kind.returns
        }
        self._gather = Gatherer(
            self._rows,
            self._table,
            request,
            num_tasks=self._draws.num_tasks,
            device=self.device,
            endings=endings,
        )

    def _endings_of(self, gamma: float, rewards: Reward) -> Endings:
        key = (gamma, rewards)
        if key not in self._endings:
            self._endings[key] = Endings.of(self._rows, gamma, rewards)
        return self._endings[key]

    def with_request(self, request: BatchRequest) -> Self:
        """A sampler for another request with the same steps, seed and stream; loads nothing again.

        Raises:
            SelectionError: a task has too few steps, trajectories or windows for the request, or the request
                takes dense rewards and this sampler's does not.
        """
        other = copy.copy(self)
        other._serve(request)
        return other

    @property
    def task_indices(self) -> npt.NDArray[np.int64]:
        """Indices of the selected tasks, (tasks,)."""
        return self._rows.task_indices

    def short_trajectories(self, length: int) -> int:
        """The number of trajectories that are too short for a window of `length` steps."""
        return int((self._rows.episodes.lengths < length).sum())

    def _check(self) -> None:
        kinds = self.request.kinds
        for name, kind in kinds.items():
            if isinstance(kind, Trajectories):
                partner = kinds.get(kind.apart_from or "")
                needed = kind.number + (partner.number if partner else 0)
                self._need(np.diff(self._rows.episodes.task_ranges)[:, 0], needed, "trajectories")
            else:
                self._need(self._draws.num_starts(name), 1, f"stretches of {kind.length} steps")

    def _need(self, counts: Indices, needed: int, what: str) -> None:
        if (counts >= needed).all():
            return
        position = int((counts < needed).argmax())
        task, count = self.task_indices[position], counts[position]
        raise SelectionError(
            f"{self._place}: task {task} has {count} selected {what}, a batch takes {needed}; "
            "select more snapshots, or request less"
        )

    def batch(self, n: int) -> Batch:
        """The n-th batch, n >= 0; depends only on n, the selection, request, seed and stream."""
        return self._gather(self._draws(n))

    def prefetch(self, first: int, last: int, *, depth: int = 2) -> "Prefetch[Batch]":
        """An iterator over batches `first` to `last - 1`, made ahead by a thread; see `Prefetch`."""
        return Prefetch(self.batch, range(first, last), depth=depth)

    def moments(self) -> Moments:
        """Statistics of all selected transitions."""
        return moments_of(self._rows)


@final
class Prefetch(Generic[Item]):
    """An iterator over items that one thread makes ahead of their use; a context manager.

    Leaving the context ends the thread. An exception raised by `make` is raised by the iterator, in the place
    of the item.

    Attributes:
        waited: total time in seconds that `next` took so far.

    Args:
        make: makes the item with a given number; called in another thread.
        numbers: numbers of the items, in order.
        depth: number of items that are kept ready, while one more is made; 0 makes an item when it is needed,
            without a thread.

    Example:
        >>> with Prefetch(lambda n: n * n, range(3), depth=2) as squares:
        ...     list(squares)
        [0, 1, 4]
    """

    def __init__(self, make: Callable[[int], Item], numbers: Sequence[int], *, depth: int) -> None:
        self._make, self._numbers, self._depth = make, iter(numbers), depth
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
        self._ahead: deque[Future[Item]] = deque()
        self.waited = 0.0

    def __enter__(self) -> Self:
        self._go_ahead()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._numbers = iter(())
        self._thread.shutdown(cancel_futures=True)
        self._ahead.clear()

    def __iter__(self) -> Iterator[Item]:
        return self

    def __next__(self) -> Item:
        began = time.perf_counter()
        try:
            if not self._depth:
                return self._make(next(self._numbers))
            if not self._ahead:
                raise StopIteration
            item = self._ahead.popleft().result()
            self._go_ahead()
            return item
        finally:
            self.waited += time.perf_counter() - began

    def _go_ahead(self) -> None:
        if self._depth:
            for number in itertools.islice(self._numbers, self._depth + 1 - len(self._ahead)):
                self._ahead.append(self._thread.submit(self._make, number))
