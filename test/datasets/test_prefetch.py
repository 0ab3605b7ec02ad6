# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Prefetching changes when items are made, never which or in what order."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing

import pytest

from dcgs_ros.datasets.prefetch import prefetch

TIMEOUT_S = 120.0  # only a failure takes so long


class Counter:
    """Yields 0, 1, 2, ..., and keeps its progress and thread."""

    def __init__(self, count: int, fail_at: int | None = None) -> None:
        self.count = count
        self.fail_at = fail_at
        self.made = 0
        self.thread = 0
        self.progress = threading.Condition()

    def __iter__(self) -> Iterator[int]:
        self.thread = threading.get_ident()
        for k in range(self.count):
            if k == self.fail_at:
                raise OSError(f'disk gone at {k}')
            with self.progress:
                self.made = k + 1
                self.progress.notify_all()
            yield k

    def reaches(self, made: int, within_s: float) -> bool:
        with self.progress:
            return self.progress.wait_for(lambda: self.made >= made, within_s)


def running() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == 'prefetch']


@pytest.mark.parametrize('count', [0, 1, 3, 100])
@pytest.mark.parametrize('depth', [1, 4])
def test_items_come_in_order(count: int, depth: int) -> None:
    assert list(prefetch(Counter(count), depth)) == list(range(count))
    assert not running()


def test_items_are_made_ahead_in_another_thread_but_not_too_far() -> None:
    source = Counter(100)
    items = prefetch(source, depth=3)
    assert next(items) == 0
    # One is taken, three are in the queue, one waits to get in.
    assert source.reaches(5, within_s=TIMEOUT_S)
    assert not source.reaches(6, within_s=0.1)
    assert source.thread != threading.get_ident()
    items.close()


def test_an_exception_comes_after_the_items_before_it() -> None:
    seen = []
    with pytest.raises(OSError, match='disk gone at 3'):
        for item in prefetch(Counter(10, fail_at=3), depth=2):
            seen.append(item)
    assert seen == [0, 1, 2]
    assert not running()


@pytest.mark.parametrize('taken', [1, 2, 7])
def test_closing_early_stops_the_thread(taken: int) -> None:
    source = Counter(1_000_000)
    items = prefetch(source, depth=4)
    for _ in range(taken):
        next(items)
    items.close()
    assert not running()
    assert source.made <= taken + 6


def test_a_loop_left_by_an_exception_stops_the_thread() -> None:
    with pytest.raises(KeyboardInterrupt), closing(prefetch(Counter(1_000_000))) as items:
        for item in items:
            if item == 3:
                raise KeyboardInterrupt
    assert not running()


def test_a_depth_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match='at least 1, got 0'):
        next(prefetch(Counter(3), depth=0))
