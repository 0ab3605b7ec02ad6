# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A node's process, from its arguments to its exit status."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from types import FrameType
from weakref import WeakSet

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from ..core.errors import DcgsError
from .transport import prepare

_WAKE_S = 1.0
_failed: WeakSet[Node] = WeakSet()  # nodes of which a worker raised
_initialised = threading.Event()
_left: WeakSet[Node] = WeakSet()  # nodes of which a worker goes on, since it cannot be interrupted


def run(make: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Make a node and spin it until it is told to end; return the exit status of the process.

    SIGINT, SIGTERM and a shutdown of ROS end it with 0, after calling its `close`, if it has one.
    A node whose constructor raises a `DcgsError` prints it in one line and returns 2; one whose
    worker raised returns 1. `args` are those of the command line by default.
    """
    prepare()
    # rclpy ends spinning at a signal. Python must not interrupt `close` at a second one, which
    # launchers send.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _handle)
    rclpy.init(args=None if args is None else list(args))
    _initialised.set()
    node: Node | None = None
    try:
        executor = SingleThreadedExecutor()  # first: a signal while it is made would break it
        node = make()
        executor.add_node(node)
        while True:  # `spin` may miss the signal that ends it, unless a timer wakes it up
            executor.spin_once(timeout_sec=_WAKE_S)
    except ExternalShutdownException:
        pass
    except Exception as error:
        if rclpy.ok() and node is None and isinstance(error, DcgsError):
            print(error, file=sys.stderr)
            return 2
        if rclpy.ok():
            raise
        # A signal shuts ROS down at once: what was being published then fails.
    finally:
        _end(node)
    status = int(node is not None and has_failed(node))
    if node in _left:  # Python's own end would wait for the compiler, or crash in it
        sys.stdout.flush()
        os._exit(status)
    return status


def has_failed(node: Node) -> bool:
    """Return whether a worker of the node has raised."""
    return node in _failed


class Worker:
    """A thread of a node; where it raises, it logs the error and shuts ROS down."""

    def __init__(self, node: Node, work: Callable[[], None], name: str) -> None:
        """Start the thread."""
        self._node, self._work = node, work
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._work()
        except Exception as error:
            if self._node.context.ok():  # else a signal came while something was being published
                expected = isinstance(error, DcgsError)
                self._node.get_logger().fatal(str(error) if expected else traceback.format_exc())
                _failed.add(self._node)
                self._node.context.try_shutdown()

    def join(self) -> None:
        """Wait for the end of the thread."""
        self._thread.join()

    def leave(self) -> None:
        """Wait for nothing: `run` ends the process although the thread goes on."""
        _left.add(self._node)


def _end(node: Node | None) -> None:
    try:
        if node is not None:
            close = getattr(node, 'close', None)
            if close is not None:
                close()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def _handle(number: int, frame: FrameType | None) -> None:
    """Replace Python's own handler, which rclpy calls after its own, once it has one."""
    if not _initialised.is_set():
        os._exit(0)
