# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's motion as that of the base it is mounted on: nav_msgs/Odometry."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Vector3
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from std_msgs.msg import Header

from ...core import se3
from ...io.ros_images import MessageError
from .poses import matrix, pose_message

_ROUNDING = 1e-6  # m^2, rad^2: a covariance that was rounded to text


class CameraToBase:
    """Turns poses, covariances and velocities of the camera into those of the base.

    With the camera at T_world_cam exp(xi), the base is at T_odom_base exp(Ad xi), where Ad is the
    adjoint of T_base_cam: it maps errors and velocities of the camera to those of the base.
    """

    def __init__(self, T_base_cam: NDArray[np.float64]) -> None:
        """Take the pose (4, 4) of the camera's optical frame in the base frame."""
        self.T_base_cam = T_base_cam
        self._T_cam_base = se3.inverse(T_base_cam)
        self._adjoint = se3.adjoint(T_base_cam)

    def pose(self, T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return T_odom_base (4, 4) for the camera at `T_world_cam`; odom is the world."""
        return T_world_cam @ self._T_cam_base

    def covariance(
        self, cov_cam: NDArray[np.floating], T_odom_base: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the base in ROS's order: x y z, turns about odom's axes.

        `cov_cam` (6, 6) is that of xi in T_world_cam exp(xi), translation first: m^2, rad^2.
        """
        return _propagated(self._to_ros(T_odom_base), cov_cam)

    def camera_covariance(
        self, cov_base: NDArray[np.floating], T_odom_base: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return that of the camera (6, 6) for that of the base in ROS's order: the inverse."""
        J = np.asarray(np.linalg.inv(self._to_ros(T_odom_base)), np.float64)
        return _propagated(J, cov_base)

    def _to_ros(self, T_odom_base: NDArray[np.float64]) -> NDArray[np.float64]:
        axes = np.zeros((6, 6))
        axes[:3, :3] = axes[3:, 3:] = T_odom_base[:3, :3]
        return np.asarray(axes @ self._adjoint)

    def twist(
        self, twist_cam: NDArray[np.floating], cov_cam: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the velocity (6,) of the base along its own axes, m/s and rad/s, and covariance.

        `twist_cam` (6,) and `cov_cam` (6, 6) are the camera's, along the camera's axes.
        """
        return self._adjoint @ twist_cam, _propagated(self._adjoint, cov_cam)


def odometry_message(
    header: Header,
    child_frame: str,
    T_odom_base: NDArray[np.float64],
    covariance: NDArray[np.float64],
    twist: NDArray[np.float64],
    twist_covariance: NDArray[np.float64],
) -> Odometry:
    """Return the Odometry of `child_frame` in the header's frame; arrays as of `CameraToBase`."""
    message = Odometry(header=header, child_frame_id=child_frame)
    message.pose.pose = pose_message(T_odom_base)
    message.pose.covariance = np.asarray(covariance, np.float64).ravel()
    x, y, z, about_x, about_y, about_z = np.asarray(twist, np.float64).tolist()
    message.twist.twist.linear = Vector3(x=x, y=y, z=z)
    message.twist.twist.angular = Vector3(x=about_x, y=about_y, z=about_z)
    message.twist.covariance = np.asarray(twist_covariance, np.float64).ravel()
    return message


def pose_with_covariance(
    header: Header, T: NDArray[np.float64], covariance: NDArray[np.float64]
) -> PoseWithCovarianceStamped:
    """Return a pose in the header's frame; `covariance` (6, 6) as of `CameraToBase`."""
    message = PoseWithCovarianceStamped(header=header)
    message.pose.pose = pose_message(T)
    message.pose.covariance = np.asarray(covariance, np.float64).ravel()
    return message


def read_pose_with_covariance(
    message: PoseWithCovarianceStamped,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose (4, 4), and its covariance (6, 6) in ROS's order.

    Raises `MessageError` where one of them is none.
    """
    covariance = np.asarray(message.pose.covariance, np.float64).reshape(6, 6)
    covariance = 0.5 * (covariance + covariance.T)
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] < -_ROUNDING:
        raise MessageError(f'its covariance is none: variances {np.diag(covariance).tolist()}')
    return matrix(message.pose.pose), covariance


def _propagated(J: NDArray[np.float64], covariance: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return J C J', exactly symmetric."""
    moved = J @ covariance @ J.T
    return 0.5 * (moved + moved.T)
