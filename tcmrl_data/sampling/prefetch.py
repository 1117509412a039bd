"""Prefetching of items by one thread."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Generic, Self, TypeVar, final

Item = TypeVar("Item")


@final
class Prefetch(Generic[Item]):
    """An iterator over items that one thread makes ahead of their use; a context manager.

    Leaving the context ends the thread. An exception raised by `make` is raised again by the iterator, in
    the place of the item.

    Attributes:
        waited: total time in seconds that `next` took so far.

    Args:
        make: makes the item with a given number; called in another thread.
        numbers: numbers of the items, in order.
        depth: maximum number of items made ahead; 0 makes an item when it is needed, without a thread.

    Example:
        >>> with Prefetch(lambda n: n * n, range(3), depth=2) as squares:
        ...     list(squares)
        [0, 1, 4]
    """

    def __init__(self, make: Callable[[int], Item], numbers: Sequence[int], *, depth: int) -> None:
        self._make, self._numbers, self._depth = make, iter(numbers), depth
        self.waited = 0.0
        self._ready: deque[Item] = deque()
        self._problem: BaseException | None = None
        self._is_done, self._is_closed = False, False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="prefetch", daemon=True)

    def __enter__(self) -> Self:
        if self._depth:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        if self._depth:
            self._thread.join()
        self._ready.clear()

    def __iter__(self) -> Iterator[Item]:
        return self

    def __next__(self) -> Item:
        began = time.perf_counter()
        try:
            return self._take() if self._depth else self._make(next(self._numbers))
        finally:
            self.waited += time.perf_counter() - began

    def _take(self) -> Item:
        with self._changed:
            self._changed.wait_for(lambda: self._ready or self._is_done or self._is_closed)
            if self._ready:
                self._changed.notify_all()
                return self._ready.popleft()
            if self._problem is not None and not self._is_closed:
                raise self._problem
            raise StopIteration

    def _run(self) -> None:
        try:
            for number in self._numbers:
                item = self._make(number)
                with self._changed:
                    self._changed.wait_for(lambda: len(self._ready) < self._depth or self._is_closed)
                    if self._is_closed:
                        return
                    self._ready.append(item)
                    self._changed.notify_all()
                del item  # releases the item's buffer before the next item is made
        except Exception as error:  # noqa: BLE001 - any exception is raised again in the consumer's thread
            self._problem = error
        finally:
            with self._changed:
                self._is_done = True
                self._changed.notify_all()
