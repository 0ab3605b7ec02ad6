# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a robot's other sensors measure: sensor_msgs/Imu and nav_msgs/Odometry."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import Imu

from ...core.priors.readings import AngularRate, BasePose, SpecificForce
from ...datasets.readings import base_pose
from ...datasets.source import ImuSample, OdometrySample
from ...io.ros_images import MessageError, stamp_ns
from .images import header
from .odometry import odometry_message
from .poses import matrix

_NO_VALUE = -1.0  # first entry of a covariance, where the value is not measured
_PLANE = np.array([0, 7, 35])  # of a twist's covariance: x, y, turn about z
_MOST = np.array([1.0, 1.0, 1.0])  # (m/s)^2 and (rad/s)^2: more stands for 'do not use'


def read_rate(imu: Imu) -> AngularRate | None:
    """Return the angular rate, None where the message has none; raises `MessageError`."""
    rate = _vector(imu.angular_velocity, imu.angular_velocity_covariance)
    return None if rate is None else AngularRate(stamp_ns(imu.header.stamp), rate)


def read_force(imu: Imu) -> SpecificForce | None:
    """Return the specific force, None where the message has none; raises `MessageError`."""
    force = _vector(imu.linear_acceleration, imu.linear_acceleration_covariance)
    return None if force is None else SpecificForce(stamp_ns(imu.header.stamp), force)


def read_odometry(odometry: Odometry) -> BasePose:
    """Return the pose, and the variance of the velocity where that is sane.

    The pose's own covariance is of all the way since the start, and tells nothing of a motion.
    Raises `MessageError`.
    """
    variance = np.array(odometry.twist.covariance, np.float64)[_PLANE]
    sane = bool(np.all((variance > 0.0) & (variance <= _MOST)))
    T_odom_base = matrix(odometry.pose.pose)
    return BasePose(stamp_ns(odometry.header.stamp), T_odom_base, variance if sane else None)


def write_imu(sample: ImuSample, shift_ns: int = 0) -> Imu:
    """Return the message of a sample; the orientation is not measured."""
    message = Imu(header=header(sample.stamp_ns + shift_ns, sample.frame))
    message.orientation_covariance[0] = _NO_VALUE
    if sample.angular_velocity is None:
        message.angular_velocity_covariance[0] = _NO_VALUE
    else:
        message.angular_velocity = _vector3(sample.angular_velocity)
    if sample.acceleration is None:
        message.linear_acceleration_covariance[0] = _NO_VALUE
    else:
        message.linear_acceleration = _vector3(sample.acceleration)
    return message


def write_odometry(sample: OdometrySample, shift_ns: int = 0) -> Odometry:
    """Return the message of a sample, without covariances."""
    forward, left, turning = sample.velocity
    twist, unknown = np.array([forward, left, 0.0, 0.0, 0.0, turning]), np.zeros((6, 6))
    in_odom = header(sample.stamp_ns + shift_ns, sample.frame)
    return odometry_message(in_odom, sample.base_frame, base_pose(sample), unknown, twist, unknown)


def _vector(value: Vector3, covariance: Any) -> NDArray[np.float64] | None:
    if covariance[0] == _NO_VALUE:
        return None
    xyz = value.x, value.y, value.z
    if not math.isfinite(sum(xyz)):
        raise MessageError(f'{xyz} is no measurement')
    return np.array(xyz)


def _vector3(xyz: tuple[float, float, float]) -> Vector3:
    return Vector3(**dict(zip('xyz', xyz, strict=True)))
