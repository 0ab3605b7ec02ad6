# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Where somebody says that the base is: RViz's "2D Pose Estimate", nav2, another estimator."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from ...core.tracking.expectation import ExpectedPlace
from ...io.ros_images import MessageError
from ..messages.odometry import CameraToBase, read_pose_with_covariance
from ..transport import RELIABLE


class InitialPose:
    """Keeps the newest pose until a frame comes, which tells where the camera is on the base."""

    def __init__(self, node: Node, map_frame: str, warn: Callable[[str], None]) -> None:
        """Subscribe; `warn` gets the lines for the log."""
        self._map_frame, self._warn = map_frame, warn
        self._newest: PoseWithCovarianceStamped | None = None
        topic = 'initialpose'  # relative, as nav2 has it
        node.create_subscription(PoseWithCovarianceStamped, topic, self._on_pose, RELIABLE)

    def _on_pose(self, pose: PoseWithCovarianceStamped) -> None:
        self._newest = pose

    def take(self, to_base: CameraToBase) -> ExpectedPlace | None:
        """Return where the camera then is, once; None without news."""
        pose, self._newest = self._newest, None
        if pose is None:
            return None
        try:
            frame = pose.header.frame_id
            if frame != self._map_frame:
                raise MessageError(f'it is in the frame {frame!r}, not in {self._map_frame!r}')
            T_map_base, covariance = read_pose_with_covariance(pose)
        except MessageError as error:
            self._warn(f'initialpose refused: {error}')
            return None
        return ExpectedPlace(
            T_map_base @ to_base.T_base_cam, to_base.camera_covariance(covariance, T_map_base)
        )
