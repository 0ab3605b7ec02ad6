# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What waits for a working thread: the newest items, and every call."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcgs_ros.core.errors import DcgsError
from dcgs_ros.nodes.work_queue import WorkQueue

SOON_S = 120.0  # only a failure takes so long
AT_ONCE_S = 60.0  # less than what waits would take


@given(st.lists(st.one_of(st.integers(0, 99), st.just(None)), max_size=60), st.integers(1, 5))
def test_of_items_the_newest_wait_in_their_order(events: list[int | None], capacity: int) -> None:
    """None takes; the rest is put."""
    queue: WorkQueue[int] = WorkQueue(capacity)
    expected: list[int] = []
    dropped = 0
    for event in events:
        if event is None:
            assert queue.take(0.0) == (expected.pop(0) if expected else None)
        else:
            queue.put(event)
            expected.append(event)
            dropped += len(expected) > capacity
            expected = expected[-capacity:]
        assert (len(queue), queue.dropped) == (len(expected), dropped)


def test_all_calls_are_made_in_turn_before_the_next_item() -> None:
    queue: WorkQueue[str] = WorkQueue(1)
    done: list[int] = []
    queue.put('item')

    def do(k: int) -> int:
        done.append(k)
        return k

    futures = [queue.submit(partial(do, k)) for k in range(50)]
    assert not done and not any(future.done() for future in futures)
    assert queue.take(0.0) == 'item'
    assert done == list(range(50)) == [future.result(0) for future in futures]
    assert queue.take(0.0) is None


def test_what_a_call_raises_is_for_the_caller_that_waits() -> None:
    def refuse() -> None:
        raise DcgsError('no')

    queue: WorkQueue[str] = WorkQueue(1)
    failed = queue.submit(refuse)
    fine = queue.submit(lambda: 'done')
    queue.put('item')
    assert queue.take(0.0) == 'item'
    assert fine.result(0) == 'done'
    with pytest.raises(DcgsError, match='no'):
        failed.result(0)


def test_a_bug_in_a_call_reaches_the_thread_too() -> None:
    queue: WorkQueue[str] = WorkQueue(1)
    failed: Future[float] = queue.submit(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        queue.take(0.0)
    with pytest.raises(ZeroDivisionError):
        failed.result(0)


def test_a_call_may_submit_another() -> None:
    queue: WorkQueue[str] = WorkQueue(1)
    later: list[Future[int]] = []
    queue.submit(lambda: later.append(queue.submit(lambda: 5)))
    queue.take(0.0)
    assert later[0].result(0) == 5


def test_a_waiting_thread_wakes_for_an_item_a_call_and_the_end() -> None:
    queue: WorkQueue[str] = WorkQueue(2)
    found: list[str | None] = []

    def work() -> None:
        while not queue.closed:
            found.append(queue.take(SOON_S))

    thread = threading.Thread(target=work)
    start = time.monotonic()
    thread.start()
    time.sleep(0.02)
    queue.put('item')
    assert queue.submit(lambda: 3).result(SOON_S) == 3
    time.sleep(0.02)
    queue.close()
    thread.join(SOON_S)
    assert not thread.is_alive() and time.monotonic() - start < AT_ONCE_S
    assert [item for item in found if item] == ['item']


def test_closed_it_waits_for_nothing() -> None:
    queue: WorkQueue[str] = WorkQueue(2)
    queue.put('left')
    queue.close()
    start = time.monotonic()
    assert queue.closed and queue.take(SOON_S) == 'left' and queue.take(SOON_S) is None
    assert time.monotonic() - start < AT_ONCE_S


def test_without_work_it_waits_for_the_timeout() -> None:
    start = time.monotonic()
    assert WorkQueue(1).take(0.05) is None
    assert 0.05 <= time.monotonic() - start < AT_ONCE_S


def test_many_threads_may_put_and_submit() -> None:
    queue: WorkQueue[int] = WorkQueue(10_000)
    futures: list[Future[int]] = []

    def give(base: int) -> None:
        for k in range(300):
            queue.put(base + k)
            futures.append(queue.submit(lambda: 1))

    threads = [threading.Thread(target=give, args=(1000 * n,)) for n in range(4)]
    taken: list[int] = []
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads) or len(queue):
        item = queue.take(0.001)
        if item is not None:
            taken.append(item)
    queue.take(0.0)
    assert sorted(taken) == [1000 * n + k for n in range(4) for k in range(300)]
    for n in range(4):
        mine = [item for item in taken if item // 1000 == n]
        assert mine == sorted(mine)
    assert sum(future.result(0) for future in futures) == 1200 and queue.dropped == 0
