# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Publishes the pose of the base as Odometry, PoseStamped, Path and TF, and records it."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Header

from ...core import se3
from ...core.config.nodes import TrackerNodeSettings
from ...core.tracking.result import TrackingState, TrackResult
from ..messages.images import header
from ..messages.odometry import CameraToBase, odometry_message
from ..messages.poses import path, pose_stamped, transform_stamped
from ..transforms import make_transforms
from ..transport import RELIABLE
from .extrinsics import Mounting
from .trajectory_recorder import TrajectoryRecorder

_MAP_FRAME = 'map'
_MAX_GAP_S = 0.5  # between two poses that give a velocity


class TrackerOutputs:
    """Publishes what a tracked frame tells about the base."""

    def __init__(
        self, node: Node, settings: TrackerNodeSettings, warn: Callable[[str], None]
    ) -> None:
        """Advertise the topics; raise `ConfigError` where `base_to_camera` is unusable."""
        self._settings, self._transforms = settings, make_transforms(node)
        self.mounting = Mounting(settings, self._transforms, warn)
        self._recorder = TrajectoryRecorder(settings.save_on_exit)
        self.world = _MAP_FRAME if settings.tf == 'map_to_odom' else settings.odom_frame
        self._odometry = node.create_publisher(Odometry, '~/odometry', RELIABLE)
        self._pose = node.create_publisher(PoseStamped, '~/pose', RELIABLE)
        self._camera_pose = node.create_publisher(PoseStamped, 'camera_pose', RELIABLE)
        self._progress = node.create_publisher(Header, '~/progress', RELIABLE)
        self._path = node.create_publisher(Path, '~/path', RELIABLE)
        self._path_poses: list[PoseStamped] = []
        self._path_step, self._path_count, self._path_due_s = 1, 0, 0.0
        self._last: TrackResult | None = None

    def lookup(self, parent: str, child: str) -> NDArray[np.float64] | None:
        """Return TF's T_parent_child (4, 4), metres; None where it does not know it."""
        return self._transforms.lookup(parent, child)

    def publish(self, result: TrackResult, to_base: CameraToBase) -> None:
        """Publish a pose with its covariance in the world, and the velocity since the last one."""
        T_world_base = to_base.pose(result.T_world_cam)
        in_world = header(result.stamp_ns, self.world)
        twist, twist_covariance = to_base.twist(*self._camera_twist(result))
        self._odometry.publish(
            odometry_message(
                in_world, self._settings.base_frame, T_world_base,
                to_base.covariance(result.covariance_world, T_world_base), twist,
                twist_covariance,
            )
        )  # fmt: skip
        stamped = pose_stamped(T_world_base, in_world)
        self._pose.publish(stamped)
        self._camera_pose.publish(pose_stamped(result.T_world_cam, in_world))
        self._send_transform(T_world_base, result.stamp_ns)
        self._extend_path(stamped)
        self._recorder.add(result.stamp_ns, T_world_base)
        self._last = result

    def progress(self, header: Header) -> None:
        """Tell a replay which frame is done, whatever came of it."""
        if self._progress.get_subscription_count():
            self._progress.publish(header)

    def forget(self) -> None:
        """Begin a new path."""
        self._path_poses.clear()
        self._path_step, self._last = 1, None

    def remount(self, assumed: NDArray[np.float64], T_base_cam: NDArray[np.float64]) -> None:
        """Correct where the camera is on the base (4, 4); the path begins anew."""
        self.forget()
        self._recorder.remount(assumed, T_base_cam)

    def close(self) -> str | None:
        """Write the recorded trajectory; return what was written, if anything."""
        return self._recorder.write()

    def _camera_twist(
        self, result: TrackResult
    ) -> tuple[NDArray[np.float64], NDArray[np.floating]]:
        """Return the camera's twist (6,) since the last pose, per second, and covariance (6, 6).

        Both poses are relative to the map around the camera, so what the map adds in the world
        does not count. Without a recent pose, or where the camera was only found again, it is
        unknown: zero, with a covariance of a metre and a radian.
        """
        last = self._last
        if last is None or result.state is TrackingState.RELOCALISED:
            return np.zeros(6), np.eye(6)
        dt = (result.stamp_ns - last.stamp_ns) * 1e-9
        if not 0 < dt < _MAX_GAP_S:
            return np.zeros(6), np.eye(6)
        moved = se3.log(se3.inverse(last.T_world_cam) @ result.T_world_cam)
        return moved / dt, (last.covariance + result.covariance) / dt**2

    def _send_transform(self, T_world_base: NDArray[np.float64], stamp_ns: int) -> None:
        settings = self._settings
        in_world = header(stamp_ns, self.world)
        if settings.tf == 'odom_to_base':
            self._transforms.send(transform_stamped(T_world_base, in_world, settings.base_frame))
        elif settings.tf == 'map_to_odom':
            T_odom_base = self._transforms.lookup(settings.odom_frame, settings.base_frame)
            if T_odom_base is not None:
                T_map_odom = T_world_base @ se3.inverse(T_odom_base)
                self._transforms.send(transform_stamped(T_map_odom, in_world, settings.odom_frame))

    def _extend_path(self, stamped: PoseStamped) -> None:
        """Add every pose; once the path is full every second one, then every fourth, and so on."""
        self._path_count += 1
        if self._path_count % self._path_step == 0:
            self._path_poses.append(stamped)
        if len(self._path_poses) > self._settings.path_poses:
            self._path_poses = self._path_poses[::2]
            self._path_step *= 2
        now, rate_hz = time.monotonic(), self._settings.path_rate_hz
        if rate_hz > 0 and now >= self._path_due_s and self._path.get_subscription_count():
            self._path_due_s = now + 1.0 / rate_hz
            self._path.publish(path(self._path_poses, stamped.header))
