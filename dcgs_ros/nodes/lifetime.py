# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A node's process, from its arguments to its exit status."""

from __future__ import annotations

import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from types import FrameType

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from ..core.errors import DcgsError
from .transport import prepare

_WAKE_S = 1.0
_FAILED = threading.Event()  # a thread of this process' node did


def run(make: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Make a node and spin it until it is told to end; return the process's exit status.

    SIGINT, SIGTERM and a shutdown of ROS end it with 0, after its `close`, where it has one. A
    node that cannot be made says so in one line: 2; one whose thread failed: 1. `args` are the
    command line's by default.
    """
    prepare()
    # rclpy ends spinning at a signal; Python is not to interrupt `close` for the second one, which
    # launchers send.
    signal.signal(signal.SIGINT, _ignored)
    rclpy.init(args=None if args is None else list(args))
    node: Node | None = None
    try:
        executor = SingleThreadedExecutor()  # first: it does not like a signal while it is made
        node = make()
        executor.add_node(node)
        while True:  # `spin` may miss the signal that ends it, where no timer wakes it up again
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
    return int(_FAILED.is_set())


class Worker:
    """A thread of a node: if it fails, the node ends, and says why."""

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
                _FAILED.set()
                self._node.context.try_shutdown()

    def join(self) -> None:
        """Wait for its end."""
        self._thread.join()


def _end(node: Node | None) -> None:
    try:
        if node is not None:
            close = getattr(node, 'close', None)
            if close is not None:
                close()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def _ignored(number: int, frame: FrameType | None) -> None:
    """Stand in for Python's own handler, which rclpy calls after its own."""
