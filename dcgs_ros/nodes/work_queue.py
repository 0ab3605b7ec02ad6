# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What waits for a working thread: orders, each of them, and frames, the newest."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

from ..core.errors import DcgsError

Item = TypeVar('Item')
Result = TypeVar('Result')


class WorkQueue(Generic[Item]):
    """Hands what arrives to one thread; of items no more than `capacity` wait, the newest ones."""

    def __init__(self, capacity: int) -> None:
        """Start empty."""
        self._items: deque[Item] = deque()
        self._orders: deque[Callable[[], None]] = deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._closed = False
        self.dropped = 0  # items that newer ones pushed out

    def put(self, item: Item) -> None:
        """Add an item; returns at once."""
        with self._changed:
            self._items.append(item)
            if len(self._items) > self._capacity:
                self._items.popleft()
                self.dropped += 1
            self._changed.notify()

    def order(self, work: Callable[[], Result]) -> Future[Result]:
        """Have the thread do something between two items."""
        future: Future[Result] = Future()

        def done() -> None:
            try:
                future.set_result(work())
            except DcgsError as error:  # shown to who waits for the result
                future.set_exception(error)
            except BaseException as error:  # a fault, which is to end the thread too
                future.set_exception(error)
                raise

        with self._changed:
            self._orders.append(done)
            self._changed.notify()
        return future

    def take(self, timeout_s: float) -> Item | None:
        """Do the orders, and return the oldest item; None after `timeout_s` without one."""
        with self._changed:
            if not self._orders and not self._items and not self._closed:
                self._changed.wait(timeout_s)
        while self._orders:
            self._orders.popleft()()
        with self._changed:
            return self._items.popleft() if self._items else None

    def __len__(self) -> int:
        with self._changed:
            return len(self._items)

    @property
    def closed(self) -> bool:
        """Tell whether the thread is to end."""
        return self._closed

    def close(self) -> None:
        """Let the thread end."""
        with self._changed:
            self._closed = True
            self._changed.notify()
