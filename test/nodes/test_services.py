# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Services whose work another thread does: the executor goes on meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import pytest

pytest.importorskip('rclpy')

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from dcgs_ros.core.errors import DcgsError
from dcgs_ros.nodes.services import answered, offer, refused

HANGS_S = 60.0  # only a failure takes so long

Call = Callable[..., Any]


@pytest.fixture
def call(ros: None) -> Iterator[Call]:
    """Return what calls a service that begins work, and spins until something has come true."""
    node = rclpy.create_node('served')
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def called(begin: Callable[[], Future[str]], name: str) -> tuple[Any, Callable[..., None]]:
        def spin_until(condition: Callable[[], bool]) -> None:
            end = time.monotonic() + HANGS_S
            while not condition():
                assert time.monotonic() < end
                executor.spin_once(timeout_sec=0.02)

        offer(node, name, begin)
        client = node.create_client(Trigger, name)
        spin_until(client.service_is_ready)
        return client.call_async(Trigger.Request()), spin_until

    yield called
    executor.shutdown()
    node.destroy_node()


def test_the_executor_goes_on_while_the_work_is_done(call: Call) -> None:
    work: list[Future[str]] = []

    def begin() -> Future[str]:
        work.append(Future())
        return work[-1]

    answer, spin_until = call(begin, 'slow')
    spin_until(lambda: bool(work))
    quick, _ = call(lambda: answered('at once'), 'quick')
    spin_until(quick.done)
    assert quick.result().message == 'at once' and not answer.done()
    work[0].set_result('saved')
    spin_until(answer.done)
    assert (answer.result().success, answer.result().message) == (True, 'saved')


def test_what_cannot_be_done_is_answered_with_the_reason(call: Call) -> None:
    answer, spin_until = call(lambda: refused('there is no map yet'), 'refusing')
    spin_until(answer.done)
    assert (answer.result().success, answer.result().message) == (False, 'there is no map yet')
    work: Future[str] = Future()
    answer, spin_until = call(lambda: work, 'failing')
    spin_until(lambda: not answer.done())
    work.set_exception(DcgsError('disk is full'))
    spin_until(answer.done)
    assert (answer.result().success, answer.result().message) == (False, 'disk is full')
