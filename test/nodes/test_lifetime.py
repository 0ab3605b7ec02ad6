# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How the process of a node ends, told from outside it."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

pytest.importorskip('rclpy')

pytestmark = pytest.mark.slow  # each test starts a process

PATIENCE_S = 120.0  # only a failure takes so long
PROGRAM = """
import sys, threading, time
import rclpy
from rclpy.node import Node
from std_msgs.msg import String
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.nodes.lifetime import Worker, run


def wait_for_shutdown():
    while rclpy.ok():
        time.sleep(0.01)


class Example(Node):
    def __init__(self):
        {opening}
        super().__init__('example')
        self.sent = self.create_publisher(String, 'sent', 10)
        self.create_timer(0.01, self.on_time)
        print('up', flush=True)

    def on_time(self):
        {work}

    def close(self):
        print('closing', flush=True)
        {closing}
        print('closed', flush=True)


sys.exit(run(Example))
"""

Start = Callable[..., 'subprocess.Popen[str]']


@pytest.fixture
def start(ros_environment: dict[str, str]) -> Iterator[Start]:
    """Return a starter of processes that have said their first line."""
    started: list[subprocess.Popen[str]] = []

    def begin(
        opening: str = 'pass', work: str = 'pass', closing: str = 'pass'
    ) -> subprocess.Popen[str]:
        program = PROGRAM.format(opening=opening, work=work, closing=closing)
        process = subprocess.Popen(
            [sys.executable, '-c', program],
            env=ros_environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        assert process.stdout is not None
        process.stdout.readline()
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_closes_the_node_and_exits_with_0(start: Start, number: int) -> None:
    """In the middle of its work, which is to publish."""
    process = start(work="self.sent.publish(String(data='x'))")
    process.send_signal(number)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out, err) == (0, 'closing\nclosed\n', '')


def test_further_signals_do_not_interrupt_closing(start: Start) -> None:
    """`ros2 launch` passes the terminal's Ctrl-C on, and SIGTERM after a while."""
    process = start(closing='time.sleep(0.5)')
    process.send_signal(signal.SIGINT)
    assert process.stdout is not None
    assert process.stdout.readline() == 'closing\n'
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out, err) == (0, 'closed\n', '')


def test_a_shutdown_of_ros_ends_it_too(start: Start) -> None:
    process = start(work='rclpy.shutdown()')
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out, err) == (0, 'closing\nclosed\n', '')


def test_a_signal_while_the_node_is_made_is_no_error(start: Start) -> None:
    process = start(opening="print('making', flush=True); wait_for_shutdown()")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out, err) == (0, '', '')


def test_a_node_that_cannot_be_made_says_so_in_one_line(start: Start) -> None:
    process = start(opening="raise DcgsError('there is no such camera')")
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out, err) == (2, '', 'there is no such camera\n')


def test_a_mistake_of_ours_shows_where_it_is(start: Start) -> None:
    process = start(work='self.missing()')
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert 'AttributeError' in err and 'on_time' in err
    assert out == 'closing\nclosed\n'


def test_a_thread_that_fails_ends_the_node_and_shows_where(start: Start) -> None:
    process = start(work='self.fails = Worker(self, lambda: 1 / 0, "failing")')
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert 'ZeroDivisionError' in err
    assert out == 'closing\nclosed\n'
