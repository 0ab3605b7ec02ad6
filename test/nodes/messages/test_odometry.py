# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's motion as the base's: lever arms, axes and their covariance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

pytest.importorskip('rclpy')

from nav_msgs.msg import Odometry
from rclpy.serialization import deserialize_message, serialize_message

from dcgs_ros.core import se3
from dcgs_ros.io.ros_images import MessageError
from dcgs_ros.nodes.messages.images import header
from dcgs_ros.nodes.messages.odometry import (
    CameraToBase,
    odometry_message,
    pose_with_covariance,
    read_pose_with_covariance,
)
from dcgs_ros.nodes.messages.poses import matrix

ROUNDING = 1e-9
STEP = 1e-6
SECOND_ORDER = 1e-4  # of a step's effect: the arm is a few metres
SAMPLES = 4000
SAMPLED = 0.1  # of the deviations: six times the scatter of a correlation over SAMPLES
SEEDS = st.integers(0, 2**32)
# x forward, y left, z up of the base; x right, y down, z forward of the camera.
OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def random_transform(rng: np.random.Generator) -> NDArray[np.float64]:
    return se3.exp(np.concatenate([rng.normal(size=3), rng.normal(size=3)]))


def random_covariance(rng: np.random.Generator, scale: float) -> NDArray[np.float64]:
    root = scale * rng.normal(size=(6, 6))
    return root @ root.T


def moved(T_after: NDArray[np.float64], T_before: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ROS's six: the change of position and the turn about the fixed axes."""
    turn = Rotation.from_matrix(T_after[:3, :3] @ T_before[:3, :3].T).as_rotvec()
    return np.concatenate([T_after[:3, 3] - T_before[:3, 3], turn])


@settings(max_examples=50)
@given(SEEDS)
def test_the_camera_on_the_base_is_where_the_camera_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_base_cam, T_world_cam = random_transform(rng), random_transform(rng)
    T_odom_base = CameraToBase(T_base_cam).pose(T_world_cam)
    np.testing.assert_allclose(T_odom_base @ T_base_cam, T_world_cam, atol=ROUNDING)


@settings(max_examples=50)
@given(SEEDS)
def test_an_error_along_one_direction_moves_the_base_as_it_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    to_base, T_world_cam = CameraToBase(random_transform(rng)), random_transform(rng)
    xi = STEP * rng.normal(size=6)
    T_odom_base = to_base.pose(T_world_cam)
    change = moved(to_base.pose(T_world_cam @ se3.exp(xi)), T_odom_base)
    covariance = to_base.covariance(np.outer(xi, xi), T_odom_base)
    tolerance = SECOND_ORDER * np.abs(change).max() ** 2
    np.testing.assert_allclose(covariance, np.outer(change, change), atol=tolerance)


def test_the_covariance_is_that_of_sampled_poses() -> None:
    rng = np.random.default_rng(4)
    to_base, T_world_cam = CameraToBase(random_transform(rng)), random_transform(rng)
    cov_cam = random_covariance(rng, 1e-3)
    T_odom_base = to_base.pose(T_world_cam)
    errors = rng.multivariate_normal(np.zeros(6), cov_cam, SAMPLES)
    changes = [moved(to_base.pose(T_world_cam @ se3.exp(xi)), T_odom_base) for xi in errors]
    sampled = np.cov(np.array(changes).T)
    deviations = np.sqrt(np.diag(sampled))
    error = to_base.covariance(cov_cam, T_odom_base) - sampled
    assert np.abs(error / np.outer(deviations, deviations)).max() < SAMPLED


def test_a_camera_at_the_base_keeps_its_covariance_at_the_start() -> None:
    covariance = random_covariance(np.random.default_rng(0), 0.01)
    same = CameraToBase(np.eye(4)).covariance(covariance, np.eye(4))
    np.testing.assert_allclose(same, covariance, atol=ROUNDING)


def test_an_optical_frame_only_renames_the_axes() -> None:
    cov_cam = np.diag([1.0, 2, 3, 4, 5, 6])  # right, down, forward; about them
    in_base = CameraToBase(OPTICAL).covariance(cov_cam, np.eye(4))
    np.testing.assert_allclose(in_base, np.diag([3.0, 1, 2, 6, 4, 5]), atol=ROUNDING)


def test_a_turn_of_unknown_size_moves_the_far_end_of_the_arm() -> None:
    T_base_cam = OPTICAL.copy()
    T_base_cam[0, 3] = 2.0  # the camera is two metres ahead of the base
    turn = np.diag([0.0, 0, 0, 0, 1e-6, 0])  # about the camera's y: the base's -z
    covariance = CameraToBase(T_base_cam).covariance(turn, np.eye(4))
    expected = np.zeros((6, 6))
    expected[1, 1], expected[5, 5] = 4e-6, 1e-6
    expected[1, 5] = expected[5, 1] = -2e-6  # counter-clockwise swings the rear to the right
    np.testing.assert_allclose(covariance, expected, atol=ROUNDING * 1e-6)


@settings(max_examples=50)
@given(SEEDS)
def test_a_covariance_stays_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    to_base = CameraToBase(random_transform(rng))
    covariance = to_base.covariance(random_covariance(rng, 0.1), random_transform(rng))
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() >= -ROUNDING


@settings(max_examples=50)
@given(SEEDS)
def test_the_covariance_of_the_camera_is_that_of_the_base_undone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    to_base, T, cov_cam = (
        CameraToBase(random_transform(rng)), random_transform(rng), random_covariance(rng, 0.1)
    )  # fmt: skip
    found = to_base.camera_covariance(to_base.covariance(cov_cam, T), T)
    np.testing.assert_allclose(found, cov_cam, atol=ROUNDING)


@pytest.mark.parametrize('variance', [np.nan, np.inf, -0.1])
def test_a_pose_with_a_covariance_that_is_none_is_refused(variance: float) -> None:
    rng = np.random.default_rng(0)
    T, covariance = random_transform(rng), random_covariance(rng, 0.1)
    sent = pose_with_covariance(header(9, 'map'), T, covariance)
    for found, expected in zip(read_pose_with_covariance(sent), (T, covariance), strict=True):
        np.testing.assert_allclose(found, expected, atol=ROUNDING)
    sent.pose.covariance[7] = variance
    with pytest.raises(MessageError, match='covariance is none'):
        read_pose_with_covariance(sent)


@settings(max_examples=50)
@given(SEEDS, st.floats(0.01, 0.3))
def test_the_twist_leads_the_base_to_where_the_cameras_leads_it(seed: int, time_s: float) -> None:
    rng = np.random.default_rng(seed)
    to_base, T_world_cam = CameraToBase(random_transform(rng)), random_transform(rng)
    twist_cam = rng.normal(size=6)
    twist, _ = to_base.twist(twist_cam, np.zeros((6, 6)))
    there = to_base.pose(T_world_cam @ se3.exp(time_s * twist_cam))
    np.testing.assert_allclose(
        to_base.pose(T_world_cam) @ se3.exp(time_s * twist), there, atol=ROUNDING
    )


@pytest.mark.slow
@settings(max_examples=50)
@given(SEEDS)
def test_the_covariance_of_the_twist_is_that_of_its_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    to_base, error = CameraToBase(random_transform(rng)), rng.normal(size=6)
    in_base, covariance = to_base.twist(error, np.outer(error, error))
    np.testing.assert_allclose(covariance, np.outer(in_base, in_base), atol=ROUNDING)


def test_driving_ahead_is_along_x_of_the_base() -> None:
    twist, _ = CameraToBase(OPTICAL).twist(np.array([0, 0, 1.5, 0, -0.2, 0]), np.zeros((6, 6)))
    np.testing.assert_allclose(twist, [1.5, 0, 0, 0, 0, 0.2], atol=ROUNDING)


def test_odometry_carries_all_of_it() -> None:
    rng = np.random.default_rng(0)
    T, twist = random_transform(rng), rng.normal(size=6)
    pose_cov, twist_cov = random_covariance(rng, 0.1), random_covariance(rng, 0.2)
    sent = odometry_message(header(9, 'odom'), 'base_link', T, pose_cov, twist, twist_cov)
    got = deserialize_message(serialize_message(sent), Odometry)
    assert (got.header.frame_id, got.child_frame_id) == ('odom', 'base_link')
    np.testing.assert_allclose(matrix(got.pose.pose), T, atol=ROUNDING)
    np.testing.assert_array_equal(got.pose.covariance.reshape(6, 6), pose_cov)
    np.testing.assert_array_equal(got.twist.covariance.reshape(6, 6), twist_cov)
    linear, angular = got.twist.twist.linear, got.twist.twist.angular
    assert [linear.x, linear.y, linear.z, angular.x, angular.y, angular.z] == list(twist)
