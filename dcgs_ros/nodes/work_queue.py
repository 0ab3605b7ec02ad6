# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Work for one thread: calls, every one of them, and items, the newest ones."""

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
    """Passes work to one thread; at most `capacity` items wait, newer ones push out older ones."""

    def __init__(self, capacity: int) -> None:
        """Start empty."""
        self._items: deque[Item] = deque()
        self._calls: deque[Callable[[], None]] = deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._closed = False
        self.dropped = 0  # items that newer ones pushed out

    def put(self, item: Item) -> None:
        """Add an item; return at once."""
        with self._changed:
            self._items.append(item)
            if len(self._items) > self._capacity:
                self._items.popleft()
                self.dropped += 1
            self._changed.notify()

    def submit(self, function: Callable[[], Result]) -> Future[Result]:
        """Have the thread call a function between two items."""
        future: Future[Result] = Future()

        def call() -> None:
            try:
                future.set_result(function())
            except DcgsError as error:  # for the caller that waits for the result
                future.set_exception(error)
            except BaseException as error:  # a bug, which ends the thread too
                future.set_exception(error)
                raise

        with self._changed:
            self._calls.append(call)
            self._changed.notify()
        return future

    def take(self, timeout_s: float) -> Item | None:
        """Make the calls, and return the oldest item; None after `timeout_s` without one."""
        with self._changed:
            if not self._calls and not self._items and not self._closed:
                self._changed.wait(timeout_s)
        while self._calls:
            self._calls.popleft()()
        with self._changed:
            return self._items.popleft() if self._items else None

    def __len__(self) -> int:
        with self._changed:
            return len(self._items)

    @property
    def closed(self) -> bool:
        """Whether the thread is to end."""
        return self._closed

    def close(self) -> None:
        """Let the thread end."""
        with self._changed:
            self._closed = True
            self._changed.notify()
