# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How a node is doing: in /diagnostics once a second, and in its log."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from .health import Level, News, Throttle, Verdict
from .messages.diagnostics import diagnostics
from .transport import RELIABLE


class Reporter:
    """Publishes a verdict and figures, and logs each cause once while it lasts."""

    def __init__(
        self, node: Node, activity: str, ask: Callable[[], tuple[Verdict, Mapping[str, object]]]
    ) -> None:
        """`ask` returns the verdict and the figures of now; robots differ by their namespace."""
        self._node, self._ask = node, ask
        self._name = f'{node.get_fully_qualified_name().lstrip("/")}: {activity}'
        self._news, self._throttle = News(), Throttle()
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', RELIABLE)
        # Simulated time stands still without /clock, which is to be seen from here.
        node.create_timer(1.0, self.report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def report(self) -> None:
        """Publish how the node is doing now."""
        verdict, figures = self._ask()
        stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(diagnostics(stamp, self._name, verdict, figures))
        if verdict.level is Level.OK or verdict.logged or not self._news.is_new(verdict.message):
            return
        if verdict.level is Level.WARN:
            self._node.get_logger().warning(verdict.message)
        else:
            self._node.get_logger().error(verdict.message)

    def warn(self, text: str) -> None:
        """Log an event, unless one like it was logged a moment ago."""
        if self._throttle.admits(text):
            self._node.get_logger().warning(text)

    def inform(self, text: str) -> None:
        """Log what nobody has to mend; as `warn`."""
        if self._throttle.admits(text):
            self._node.get_logger().info(text)
