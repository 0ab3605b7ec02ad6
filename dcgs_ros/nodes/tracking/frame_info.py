# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What came of every frame, for those who watch: diagnostics with the image's stamp."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from ...core.tracking.result import TrackingState, TrackResult
from ..health import Level, Verdict
from ..messages.diagnostics import diagnostics
from ..messages.images import time_message
from ..transport import RELIABLE
from .health import numbers

_LEVELS = {TrackingState.OK: Level.OK, TrackingState.LOST: Level.ERROR}  # others: WARN
_USED = 'used'  # the reason of a prior that is


class FrameInfo:
    """Publishes a DiagnosticArray with one status for each frame that is not refused."""

    def __init__(self, node: Node) -> None:
        """Advertise the topic."""
        self._name = f'{node.get_fully_qualified_name().lstrip("/")}: frame'
        self._publisher = node.create_publisher(DiagnosticArray, '~/frame_info', RELIABLE)

    def publish(
        self, result: TrackResult, ms: float, reasons: Callable[[], Mapping[str, str]]
    ) -> None:
        """Publish, if somebody listens; `reasons` tells of each prior 'used', or why it is not."""
        if not self._publisher.get_subscription_count():
            return
        level = _LEVELS.get(result.state, Level.WARN)
        used = [name for name, said in reasons().items() if said == _USED]
        values: dict[str, object] = {
            **numbers(result), 'ms': ms, 'keyframe': result.keyframe, 'carried': result.carried,
            'prior': ', '.join(['constant velocity', *used]),
        }  # fmt: skip
        stamp = time_message(result.stamp_ns)
        verdict = Verdict(level, result.state.value)
        self._publisher.publish(diagnostics(stamp, self._name, verdict, values))
