# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Pieces of work among threads."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import Counter
from contextlib import closing

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.kernels.workers import PIECES, Workers, give_way

PATIENCE_S = 120.0  # far more than any wait here takes
SLOW_S = 0.05


class DeliberateError(Exception):
    """What a kernel of these tests raises."""


@pytest.mark.parametrize('pieces', [1, 3, PIECES, 100])
@pytest.mark.parametrize('threads', [1, 2, 5])
def test_every_piece_is_done_once(threads: int, pieces: int) -> None:
    done: list[tuple[int, int]] = []
    with closing(Workers(threads)) as workers:
        workers.run(lambda piece, of: done.append((piece, of)), pieces=pieces)
    assert Counter(done) == Counter((piece, pieces) for piece in range(pieces))


def test_arguments_are_handed_on_and_results_come_back_through_them() -> None:
    def kernel(piece: int, pieces: int, out: NDArray[np.floating], factor: int) -> None:
        out[piece] = factor * piece

    out = np.zeros(PIECES)
    with closing(Workers(2)) as workers:
        workers.run(kernel, out, 3)
    np.testing.assert_array_equal(out, 3 * np.arange(PIECES))


def test_as_many_threads_work_at_once_as_there_are_workers() -> None:
    threads = 3
    together = threading.Barrier(threads)  # breaks where fewer come
    with closing(Workers(threads)) as workers:
        workers.run(lambda piece, pieces: together.wait(PATIENCE_S), pieces=threads)


def test_fewer_than_one_thread_is_one_and_it_is_the_callers() -> None:
    callers: set[int] = set()
    with closing(Workers(0)) as workers:
        assert workers.threads == 1
        workers.run(lambda piece, pieces: callers.add(threading.get_ident()))
    assert callers == {threading.get_ident()}


def test_the_next_piece_goes_to_whoever_is_free() -> None:
    """One thread is held up by its first piece; the other does all the rest."""
    rest = threading.Semaphore(0)
    by: list[int] = []

    def kernel(piece: int, pieces: int) -> None:
        by.append(threading.get_ident())
        if piece == 0:
            assert all(rest.acquire(timeout=PATIENCE_S) for _ in range(pieces - 1))
        else:
            rest.release()

    with closing(Workers(2)) as workers:
        workers.run(kernel)
    assert sorted(Counter(by).values()) == [1, PIECES - 1]


@pytest.mark.parametrize('threads', [1, 2])
@pytest.mark.parametrize('piece', [0, PIECES - 1])
def test_what_a_piece_raises_reaches_the_caller_and_the_next_run_works(
    threads: int, piece: int
) -> None:
    def failing(here: int, pieces: int) -> None:
        if here == piece:
            raise DeliberateError

    done: list[int] = []
    with closing(Workers(threads)) as workers:
        with pytest.raises(DeliberateError):
            workers.run(failing)
        workers.run(lambda here, pieces: done.append(here))
    assert sorted(done) == list(range(PIECES))


def test_nothing_runs_any_more_when_run_has_raised() -> None:
    """Else a kernel goes on writing to buffers that the caller has given up."""
    caller, both = threading.get_ident(), threading.Barrier(2)
    ended: list[int] = []

    def kernel(piece: int, pieces: int) -> None:
        both.wait(PATIENCE_S)
        if threading.get_ident() == caller:
            raise DeliberateError
        time.sleep(SLOW_S)
        ended.append(piece)

    with closing(Workers(2)) as workers:
        with pytest.raises(DeliberateError):
            workers.run(kernel, pieces=2)
        assert len(ended) == 1


def test_two_callers_share_the_threads_without_waiting_for_ever() -> None:
    done: list[str] = []

    def call(workers: Workers, name: str) -> None:
        for _ in range(50):
            workers.run(lambda piece, pieces: done.append(name), pieces=4)

    with closing(Workers(2)) as workers:
        callers = [
            threading.Thread(target=call, args=(workers, name), daemon=True) for name in 'ab'
        ]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join(PATIENCE_S)
    assert Counter(done) == {'a': 200, 'b': 200}


def test_closing_ends_the_threads() -> None:
    before = set(threading.enumerate())
    workers = Workers(3)
    workers.run(lambda piece, pieces: time.sleep(0.001))
    started = set(threading.enumerate()) - before
    assert started
    workers.close()
    assert not any(thread.is_alive() for thread in started)
    Workers(1).close()  # has none to end


@pytest.mark.skipif(sys.platform != 'linux', reason='threads have no priority of their own')
def test_a_thread_gives_way_as_far_as_it_is_told_and_never_takes_back() -> None:
    found = list[int]()

    def work() -> None:
        for nice in (5, 12, 3):
            give_way(nice)
            found.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(PATIENCE_S)
    mine = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    assert found == [max(mine, nice) for nice in (5, 12, 12)]
