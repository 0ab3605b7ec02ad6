# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Poses of the base as ROS has them: Odometry, PoseStamped, Path and TF."""

from __future__ import annotations

import time

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node

from ...core import se3
from ...core.config.nodes import TrackerNodeSettings
from ...core.tracking.tracker import TrackResult
from ..messages.odometry import Body, odometry_message
from ..messages.poses import path, pose_stamped, transform_stamped
from ..messages.standard import header
from ..transforms import Transforms
from ..transport import RELIABLE

_MAP_FRAME = 'map'
_MAX_GAP_S = 0.5  # between two poses that tell a velocity


class TrackerOutputs:
    """Publishes what a tracked frame says of the base."""

    def __init__(self, node: Node, settings: TrackerNodeSettings, transforms: Transforms) -> None:
        """Advertise the topics."""
        self.settings, self._transforms = settings, transforms
        corrects = settings.tf == 'map_to_odom'
        self.world = _MAP_FRAME if corrects else settings.odom_frame
        self._odometry = node.create_publisher(Odometry, '~/odometry', RELIABLE)
        self._pose = node.create_publisher(PoseStamped, '~/pose', RELIABLE)
        self._camera_pose = node.create_publisher(PoseStamped, '~/camera_pose', RELIABLE)
        self._path = node.create_publisher(Path, '~/path', RELIABLE)
        self._way: list[PoseStamped] = []
        self._every, self._passed, self._path_due_s = 1, 0, 0.0
        self._last: TrackResult | None = None

    def publish(self, result: TrackResult, body: Body) -> None:
        """Publish a pose; the last frame's gives the velocity."""
        T_world_base = body.pose(result.T_world_cam)
        placed = header(result.stamp_ns, self.world)
        twist, twist_covariance = body.twist(*self._motion(result))
        self._odometry.publish(
            odometry_message(
                placed, self.settings.base_frame, T_world_base,
                body.covariance(result.covariance, T_world_base), twist, twist_covariance,
            )
        )  # fmt: skip
        stamped = pose_stamped(T_world_base, placed)
        self._pose.publish(stamped)
        self._camera_pose.publish(pose_stamped(result.T_world_cam, placed))
        self._send_transform(T_world_base, result.stamp_ns)
        self._walk(stamped)
        self._last = result

    def forget(self) -> None:
        """Begin a new path."""
        self._way.clear()
        self._every, self._last = 1, None

    def _motion(self, result: TrackResult) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Twist of the camera since the last pose, per second, and its covariance.

        Without a recent pose it is unknown: zero, with a covariance of a metre and a radian.
        """
        last = self._last
        if last is None or not 0 < (result.stamp_ns - last.stamp_ns) * 1e-9 < _MAX_GAP_S:
            return np.zeros(6), np.eye(6)
        dt = (result.stamp_ns - last.stamp_ns) * 1e-9
        moved = se3.log(se3.inverse(last.T_world_cam) @ result.T_world_cam)
        return moved / dt, (last.covariance + result.covariance) / dt**2

    def _send_transform(self, T_world_base: NDArray[np.float64], stamp_ns: int) -> None:
        settings = self.settings
        if settings.tf == 'odom_to_base':
            placed = header(stamp_ns, self.world)
            self._transforms.send(transform_stamped(T_world_base, placed, settings.base_frame))
        elif settings.tf == 'map_to_odom':
            T_odom_base = self._transforms.lookup(settings.odom_frame, settings.base_frame)
            if T_odom_base is not None:
                T_map_odom = T_world_base @ se3.inverse(T_odom_base)
                placed = header(stamp_ns, self.world)
                self._transforms.send(transform_stamped(T_map_odom, placed, settings.odom_frame))

    def _walk(self, stamped: PoseStamped) -> None:
        """Add to the path, every pose at first, every second when it is full, and so on."""
        self._passed += 1
        if self._passed % self._every == 0:
            self._way.append(stamped)
        if len(self._way) > self.settings.path_poses:
            self._way = self._way[::2]
            self._every *= 2
        now, rate_hz = time.monotonic(), self.settings.path_rate_hz
        if rate_hz > 0 and now >= self._path_due_s and self._path.get_subscription_count():
            self._path_due_s = now + 1.0 / rate_hz
            self._path.publish(path(self._way, stamped.header))
