# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Publishes the depth of tracked frames as points, for the obstacle layers of a planner."""

from __future__ import annotations

import time

from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from ...core.frame import RgbdFrame
from ...core.navigation.depth_points import depth_points
from ...core.tracking.result import TrackResult
from ...core.tracking.tracker import Tracker
from ..messages.clouds import point_rows, write_cloud
from ..messages.images import header
from ..transport import sensor_qos


class LivePoints:
    """Points in the camera's frame at the stamp of the pose, so that TF places them by it."""

    def __init__(self, node: Node, rate_hz: float) -> None:
        """Advertise the topic."""
        self._rate_hz = rate_hz
        self._points = node.create_publisher(PointCloud2, '~/points', sensor_qos('reliable'))
        self._due_s = 0.0

    def publish(
        self, frame: RgbdFrame, result: TrackResult, tracker: Tracker, camera_frame: str
    ) -> None:
        """Publish a frame that was tracked, if that is due and subscribed to."""
        now, rate_hz = time.monotonic(), self._rate_hz
        if rate_hz <= 0 or now < self._due_s or not self._points.get_subscription_count():
            return
        self._due_s = now + 1.0 / rate_hz
        points = depth_points(
            tracker.corrected(frame).depth_m, tracker.camera, tracker.config.sensor,
            result.T_cam_cam_at_depth,
        )  # fmt: skip
        in_camera = header(frame.stamp_ns, camera_frame)
        self._points.publish(write_cloud(point_rows(points), in_camera))
