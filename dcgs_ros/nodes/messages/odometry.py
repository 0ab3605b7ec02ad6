# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's motion as that of the body that carries it: nav_msgs/Odometry."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from std_msgs.msg import Header

from ...core import se3
from .poses import pose_message


class Body:
    """A rigid body, the base, and where on it the camera is.

    With the camera at T_world_cam exp(xi), the base is at T_odom_base exp(Ad xi), Ad being the
    adjoint of T_base_cam: errors and velocities of the one become those of the other by Ad.
    """

    def __init__(self, T_base_cam: NDArray) -> None:
        """Take the camera's (4, 4) optical frame in the base's."""
        self._T_cam_base = se3.inverse(T_base_cam)
        self._adjoint = se3.adjoint(T_base_cam)

    def pose(self, T_world_cam: NDArray) -> NDArray[np.float64]:
        """T_odom_base (4, 4) where the camera is at `T_world_cam`; odom is the world."""
        return T_world_cam @ self._T_cam_base

    def covariance(self, cov_cam: NDArray, T_odom_base: NDArray) -> NDArray[np.float64]:
        """Covariance (6, 6) of the base as ROS has it: x y z, then turns about odom's axes.

        `cov_cam` (6, 6) is that of xi in T_world_cam exp(xi), translation first: m^2, rad^2.
        """
        axes = np.zeros((6, 6))
        axes[:3, :3] = axes[3:, 3:] = T_odom_base[:3, :3]
        return _propagated(axes @ self._adjoint, cov_cam)

    def twist(
        self, twist_cam: NDArray, cov_cam: NDArray
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Velocity (6,) of the base along its own axes, m/s and rad/s, and its covariance.

        `twist_cam` (6,) and `cov_cam` (6, 6) are the camera's, along the camera's axes.
        """
        return self._adjoint @ twist_cam, _propagated(self._adjoint, cov_cam)


def odometry_message(
    header: Header,
    child_frame: str,
    T_odom_base: NDArray,
    covariance: NDArray,
    twist: NDArray,
    twist_covariance: NDArray,
) -> Odometry:
    """Odometry of `child_frame` in the header's frame, from what `Body` returns."""
    message = Odometry(header=header, child_frame_id=child_frame)
    message.pose.pose = pose_message(T_odom_base)
    message.pose.covariance = np.asarray(covariance, np.float64).ravel()
    x, y, z, about_x, about_y, about_z = np.asarray(twist, np.float64).tolist()
    message.twist.twist.linear = Vector3(x=x, y=y, z=z)
    message.twist.twist.angular = Vector3(x=about_x, y=about_y, z=about_z)
    message.twist.covariance = np.asarray(twist_covariance, np.float64).ravel()
    return message


def _propagated(J: NDArray, covariance: NDArray) -> NDArray[np.float64]:
    """J C J', symmetric to the last bit."""
    moved = J @ covariance @ J.T
    return 0.5 * (moved + moved.T)
