# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""IMU and odometry: what was written is read, and what is no measurement is refused."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('sensor_msgs')

from dcgs_ros.core import se3
from dcgs_ros.datasets.source import ImuSample, OdometrySample
from dcgs_ros.io.ros_images import MessageError
from dcgs_ros.nodes.messages.robot import (
    read_force,
    read_odometry,
    read_rate,
    write_imu,
    write_odometry,
)

STAMP = 1_700_000_000_123_456_789
BOTH = ImuSample(STAMP, 'imu', (0.1, -9.8, 0.3), (0.01, -0.02, 3.0))
ROLLED = OdometrySample(STAMP, 'odom', 'base_link', (1.0, 2.0, np.pi / 2), (0.5, 0.0, -0.3))


def test_a_rate_comes_back() -> None:
    message = write_imu(BOTH, shift_ns=5)
    assert message.header.frame_id == 'imu'
    assert message.linear_acceleration.y == -9.8
    reading = read_rate(message)
    assert reading is not None and reading.stamp_ns == STAMP + 5
    np.testing.assert_array_equal(reading.rate, [0.01, -0.02, 3.0])
    force = read_force(message)
    assert force is not None and force.stamp_ns == STAMP + 5
    np.testing.assert_array_equal(force.force, [0.1, -9.8, 0.3])


def test_one_quantity_is_not_taken_for_the_other() -> None:
    assert read_rate(write_imu(ImuSample(STAMP, 'imu', (0.1, -9.8, 0.3), None))) is None
    assert read_force(write_imu(ImuSample(STAMP, 'imu', None, (0.1, -9.8, 0.3)))) is None


def test_a_base_pose_comes_back() -> None:
    message = write_odometry(ROLLED, shift_ns=5)
    assert (message.header.frame_id, message.child_frame_id) == ('odom', 'base_link')
    assert message.twist.twist.angular.z == -0.3
    reading = read_odometry(message)
    assert reading.stamp_ns == STAMP + 5 and reading.variance is None
    expected = se3.from_quaternion(np.array([0.5, 0, 0, 0.5]) * np.sqrt(2), np.array([1, 2, 0.0]))
    np.testing.assert_allclose(reading.T_odom_base, expected, atol=1e-12)


@pytest.mark.parametrize('bad', [0.0, -1.0, 1e6, np.nan, np.inf])
def test_only_a_sane_covariance_is_taken(bad: float) -> None:
    message = write_odometry(ROLLED)
    covariance = np.diag([0.04, 0.01, 1e6, 1e6, 1e6, 0.09])
    message.twist.covariance = covariance.ravel()
    variance = read_odometry(message).variance
    assert variance is not None
    np.testing.assert_array_equal(variance, [0.04, 0.01, 0.09])
    covariance[5, 5] = bad
    message.twist.covariance = covariance.ravel()
    assert read_odometry(message).variance is None


def test_what_is_no_measurement_is_refused() -> None:
    imu, odometry = write_imu(BOTH), write_odometry(ROLLED)
    imu.angular_velocity.y = np.nan
    with pytest.raises(MessageError):
        read_rate(imu)
    odometry.pose.pose.position.x = np.inf
    with pytest.raises(MessageError):
        read_odometry(odometry)
