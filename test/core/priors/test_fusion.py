# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Priors fused in information form, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.priors.fusion import ImagePose, Sensed, Way, is_likely
from dcgs_ros.core.priors.gravity import UpPrior
from dcgs_ros.core.priors.gyro import Gyro
from dcgs_ros.core.priors.readings import UNKNOWN, AngularRate, MotionFactor
from dcgs_ros.core.tracking.factors import PosePrior
from dcgs_ros.core.tracking.motion import ConstantVelocity

MS = 1_000_000
T_LAST = se3.exp(np.array([0.5, 0.1, -0.3, 0.2, 0.8, -0.4]))


def along_x(metres: float, sigma_m: float) -> MotionFactor:
    noise = np.diag([sigma_m**2, *[UNKNOWN] * 5])
    return MotionFactor(se3.exp(np.array([metres, 0, 0, 0, 0, 0])), noise, np.zeros((6, 6)))


def hand(sigma_m: float = 0.01) -> PosePrior:
    return PosePrior(T_LAST, sigma_m, 0.02)


def test_two_measurements_meet_at_their_weighted_mean() -> None:
    factors = along_x(0.01, 0.002), along_x(0.004, 0.001)
    fused = Sensed(factors).fused(hand(), T_LAST, np.zeros(6))
    informations = np.array([0.01**-2, 0.002**-2, 0.001**-2])
    mean = informations @ [0.0, 0.01, 0.004] / informations.sum()
    xi = se3.log(se3.inverse(T_LAST) @ fused.T_world_cam)
    np.testing.assert_allclose(xi, [mean, 0, 0, 0, 0, 0], atol=1e-6)
    H = fused.normal_equations(fused.T_world_cam).H
    assert H[0, 0] == pytest.approx(informations.sum(), rel=1e-6)


def test_the_term_is_least_at_the_fused_pose() -> None:
    fused = Sensed((along_x(0.01, 0.002),)).fused(hand(), T_LAST, np.zeros(6))
    np.testing.assert_allclose(fused.normal_equations(fused.T_world_cam).g, 0.0, atol=1e-6)


def test_nothing_sensed_leaves_the_hand() -> None:
    fused = Sensed().fused(hand(), T_LAST, np.zeros(6))
    np.testing.assert_allclose(fused.T_world_cam, T_LAST, atol=1e-12)
    assert fused.sensed is not None
    np.testing.assert_allclose(fused.sensed, 0.0)


def test_a_motion_that_no_hand_makes_is_not_believed() -> None:
    assert is_likely(along_x(0.05, 0.002), T_LAST, hand())
    assert not is_likely(along_x(0.3, 0.001), T_LAST, hand())


@pytest.mark.parametrize('seconds', [1.0 / 30.0, 2.0])
def test_a_camera_beside_the_axis_of_a_turn_goes_round_it(seconds: float) -> None:
    """Its velocity is constant in its own frame, so the gyro alone tells the circle."""
    twist = np.array([0.6, 0.0, 0.0, 0.0, 3.0, 0.0])
    gyro = Gyro(np.eye(3))
    for stamp_ns in range(-50 * MS, 2100 * MS, 5 * MS):
        gyro.sense(AngularRate(stamp_ns, twist[3:]))
    end_ns = round(seconds * 1e9)
    turn = gyro.turn(0, end_ns)
    assert turn is not None
    motion = ConstantVelocity(T_LAST, 0, np.array([*twist[:3], 0.0, 2.7, 0.0]), 0.033)
    sensed = Sensed((gyro.factor(turn),), turn)
    fused = sensed.fused(motion.prior(end_ns), T_LAST, motion.twist)
    off = se3.log(se3.inverse(T_LAST @ se3.exp(seconds * twist)) @ fused.T_world_cam)
    np.testing.assert_allclose(off, 0.0, atol=1e-4)


LIMITS = 0.03, 0.045


def images(metres: float, sigma_x_m: float) -> ImagePose:
    """Return the pose of a camera that the images say has moved along x and by 3 mm along y."""
    T = T_LAST @ se3.exp(np.array([metres, 0.003, 0, 0, 0, 0]))
    return ImagePose(T, np.diag([sigma_x_m**2, *[1e-6] * 5]), LIMITS)


def fused_m(
    sensed_m: float, seen_m: float, sigma_x_m: float, before: float = 1e-8
) -> NDArray[np.float64]:
    """Return the translation (3,) by wheels and images, from a pose of variance `before`."""
    way = Way.of((along_x(sensed_m, 0.001),), before * np.eye(6))
    T, _ = Sensed(way=way).with_images(images(seen_m, sigma_x_m), T_LAST)
    return (se3.inverse(T_LAST) @ T)[:3, 3]


def test_sensors_carry_the_pose_along_what_the_images_do_not_hold() -> None:
    np.testing.assert_allclose(fused_m(0.01, 0.002, 0.02), [0.01, 0.003, 0], atol=2e-4)


def test_images_are_believed_where_the_last_pose_is_not_known() -> None:
    np.testing.assert_allclose(fused_m(0.01, 0.002, 0.002, 1e-4), [0.002, 0.003, 0], atol=5e-4)


def test_sensors_that_contradict_are_not_averaged_with() -> None:
    assert fused_m(0.01, 0.002, 0.002)[0] > 0.004
    assert fused_m(0.06, 0.002, 0.002)[0] < 0.003


def test_up_counts_beside_images_and_wheels() -> None:
    up_world, seen = np.array([0.0, 0.0, 1.0]), images(0.002, 0.002).T_world_cam
    off = se3.exp(np.array([0, 0, 0, 0.02, 0, 0]))[:3, :3]  # by how much the map is tilted
    up_cam = off.T @ seen[:3, :3].T @ up_world
    way = Way.of((along_x(0.002, 0.001),), 1e-6 * np.eye(6))
    for up, shares in ((None, (0.0, 0.1)), (UpPrior(up_world, up_cam, 1e-4), (0.9, 1.0))):
        T, _ = Sensed(way=way, up=up).with_images(images(0.002, 0.002), T_LAST)
        moved = np.linalg.norm((T[:3, :3].T - seen[:3, :3].T) @ up_world)
        whole = np.linalg.norm(up_cam - seen[:3, :3].T @ up_world)
        assert shares[0] <= moved / whole < shares[1]


def test_images_that_hold_a_pose_badly_are_believed_less_than_they_claim() -> None:
    sigmas = [np.sqrt(images(0.0, sigma_m).believed[0, 0]) for sigma_m in (0.003, 0.02)]
    assert sigmas[0] == pytest.approx(0.003)
    assert sigmas[1] > 0.5


def test_sensors_that_are_off_a_little_in_each_frame_do_not_drift_from_the_images() -> None:
    T, covariance, step = np.eye(4), 1e-6 * np.eye(6), np.array([0.011, 0, 0, 0, 0, 0])
    whole = MotionFactor(se3.exp(step), 1e-6 * np.eye(6), np.zeros((6, 6)))
    for k in range(1, 300):
        seen = se3.exp(np.array([0.01 * k, 0, 0, 0, 0, 0]))
        sensed = Sensed(way=Way.of((whole,), covariance))
        believed = ImagePose(seen, np.diag([0.004**2] * 3 + [1e-4] * 3), LIMITS)
        T, covariance = sensed.with_images(believed, T)
    assert 0.0 < T[0, 3] - 0.01 * k < 0.004


def test_a_base_that_turns_carries_its_camera_round_and_rolls_on() -> None:
    """The turn gets faster: what the camera's own velocity was tells little of the end."""
    T_base_cam = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]], float)
    T_cam_base, gyro = se3.inverse(T_base_cam), Gyro(T_base_cam[:3, :3].T)
    T_true = np.eye(4)
    for k in range(401):
        rate, roll = np.array([0, 0, 0.01 * k]), np.array([0.1, 0, 0])
        gyro.sense(AngularRate(5 * MS * k, rate))
        if k < 400:
            T_true = T_true @ se3.exp(0.005 * np.array([*roll, 0, 0, 0.01 * (k + 0.5)]))
    turn = gyro.turn(0, 2000 * MS)
    assert turn is not None
    twist = se3.adjoint(T_cam_base) @ np.array([0.1, 0, 0, 0, 0, 0])
    moved = T_base_cam @ turn.pose(twist, T_base_cam) @ T_cam_base
    np.testing.assert_allclose(moved, T_true, atol=1e-5)
