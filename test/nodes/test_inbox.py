# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What waits for a working thread: the newest items, and every order."""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcgs_ros.core.errors import DcgsError
from dcgs_ros.nodes.inbox import Inbox

SOON_S = 120.0  # only a failure takes so long
AT_ONCE_S = 60.0  # less than what waits would take


@given(st.lists(st.one_of(st.integers(0, 99), st.just(None)), max_size=60), st.integers(1, 5))
def test_of_items_the_newest_wait_in_their_order(events: list[int | None], capacity: int) -> None:
    """None takes; the rest is put."""
    inbox: Inbox[int] = Inbox(capacity)
    expected: list[int] = []
    dropped = 0
    for event in events:
        if event is None:
            assert inbox.take(0.0) == (expected.pop(0) if expected else None)
        else:
            inbox.put(event)
            expected.append(event)
            dropped += len(expected) > capacity
            expected = expected[-capacity:]
        assert (len(inbox), inbox.dropped) == (len(expected), dropped)


def test_orders_are_done_all_of_them_in_turn_before_the_next_item() -> None:
    inbox: Inbox[str] = Inbox(1)
    done: list[int] = []
    inbox.put('item')

    def do(k: int) -> int:
        done.append(k)
        return k

    futures = [inbox.order(partial(do, k)) for k in range(50)]
    assert not done and not any(future.done() for future in futures)
    assert inbox.take(0.0) == 'item'
    assert done == list(range(50)) == [future.result(0) for future in futures]
    assert inbox.take(0.0) is None


def test_what_an_order_raises_is_for_who_waits_for_it() -> None:
    def refuse() -> None:
        raise DcgsError('no')

    inbox: Inbox[str] = Inbox(1)
    failed = inbox.order(refuse)
    fine = inbox.order(lambda: 'done')
    inbox.put('item')
    assert inbox.take(0.0) == 'item'
    assert fine.result(0) == 'done'
    with pytest.raises(DcgsError, match='no'):
        failed.result(0)


def test_a_fault_in_an_order_reaches_the_thread_too() -> None:
    inbox: Inbox[str] = Inbox(1)
    failed: Future[float] = inbox.order(lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        inbox.take(0.0)
    with pytest.raises(ZeroDivisionError):
        failed.result(0)


def test_an_order_may_give_another() -> None:
    inbox: Inbox[str] = Inbox(1)
    later: list[Future[int]] = []
    inbox.order(lambda: later.append(inbox.order(lambda: 5)))
    inbox.take(0.0)
    assert later[0].result(0) == 5


def test_who_waits_wakes_for_an_item_an_order_and_the_end() -> None:
    inbox: Inbox[str] = Inbox(2)
    found: list[str | None] = []

    def work() -> None:
        while not inbox.closed:
            found.append(inbox.take(SOON_S))

    thread = threading.Thread(target=work)
    start = time.monotonic()
    thread.start()
    time.sleep(0.02)
    inbox.put('item')
    assert inbox.order(lambda: 3).result(SOON_S) == 3
    time.sleep(0.02)
    inbox.close()
    thread.join(SOON_S)
    assert not thread.is_alive() and time.monotonic() - start < AT_ONCE_S
    assert [item for item in found if item] == ['item']


def test_closed_it_waits_for_nothing() -> None:
    inbox: Inbox[str] = Inbox(2)
    inbox.put('left')
    inbox.close()
    start = time.monotonic()
    assert inbox.closed and inbox.take(SOON_S) == 'left' and inbox.take(SOON_S) is None
    assert time.monotonic() - start < AT_ONCE_S


def test_without_anything_it_waits_as_long_as_it_was_told() -> None:
    start = time.monotonic()
    assert Inbox(1).take(0.05) is None
    assert 0.05 <= time.monotonic() - start < AT_ONCE_S


def test_many_threads_may_put_and_order() -> None:
    inbox: Inbox[int] = Inbox(10_000)
    futures: list[Future[int]] = []

    def give(base: int) -> None:
        for k in range(300):
            inbox.put(base + k)
            futures.append(inbox.order(lambda: 1))

    threads = [threading.Thread(target=give, args=(1000 * n,)) for n in range(4)]
    taken: list[int] = []
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads) or len(inbox):
        item = inbox.take(0.001)
        if item is not None:
            taken.append(item)
    inbox.take(0.0)
    assert sorted(taken) == [1000 * n + k for n in range(4) for k in range(300)]
    for n in range(4):
        mine = [item for item in taken if item // 1000 == n]
        assert mine == sorted(mine)
    assert sum(future.result(0) for future in futures) == 1200 and inbox.dropped == 0
