# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Motions by wheels against true paths; the scales that are learned, and slip."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.priors.readings import BasePose
from dcgs_ros.core.priors.wheels import Wheels

MS = 1_000_000
MILLIMETRE2 = np.diag([1e-6] * 3 + [1e-6] * 3)
# The camera 0.2 m before and 0.5 m above the base's origin, looking forward.
T_BASE_CAM = np.array(
    [[0, 0, 1, 0.2], [-1, 0, 0, 0.05], [0, -1, 0, 0.5], [0, 0, 0, 1]], np.float64
)
ARC = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.4])  # m/s and rad/s of the base
STRAIGHT = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])


def true_base(seconds: float, twist: NDArray[np.float64] = ARC) -> NDArray[np.float64]:
    return se3.exp(seconds * twist)


def driven(seconds: float, twist: NDArray[np.float64] = ARC, scale: float = 1.0) -> Wheels:
    wheels = Wheels(T_BASE_CAM)
    for stamp_ns in range(0, round(seconds * 1e9) + 1, 20 * MS):
        measured = twist * np.array([scale, scale, 1, 1, 1, 1])
        wheels.sense(BasePose(stamp_ns, true_base(stamp_ns * 1e-9, measured)))
    return wheels


def seen(start_s: float, end_s: float, twist: NDArray[np.float64] = ARC) -> NDArray[np.float64]:
    """Return the true motion of the camera."""
    start, end = (true_base(s, twist) @ T_BASE_CAM for s in (start_s, end_s))
    return se3.inverse(start) @ end


@pytest.mark.parametrize('seconds', [0.0, 0.02, 0.031, 0.5])
def test_a_pose_is_interpolated_along_the_twist(seconds: float) -> None:
    pose = driven(1.0).pose(round(seconds * 1e9))
    assert pose is not None
    np.testing.assert_allclose(pose, true_base(seconds), atol=1e-12)


def test_a_pose_goes_on_for_a_moment_after_the_last() -> None:
    wheels = driven(1.0)
    pose = wheels.pose(1030 * MS)
    assert pose is not None
    np.testing.assert_allclose(pose, true_base(1.03), atol=1e-12)
    assert wheels.pose(1100 * MS) is None


def test_the_camera_moves_as_its_place_on_the_base_has_it() -> None:
    factor = driven(1.0).factor(300 * MS, 333 * MS)
    assert factor is not None
    np.testing.assert_allclose(factor.T_before_now, seen(0.3, 0.333), atol=1e-12)


def test_a_base_tilts_and_climbs_only_as_the_floor_does() -> None:
    wheels, Ad = driven(6.0, STRAIGHT), se3.adjoint(T_BASE_CAM)
    for seconds, climb_m, tilt_deg in ((0.033, 0.002, 0.3), (2.0, 0.02, 2.0)):
        factor = wheels.factor(300 * MS, round((0.3 + seconds) * 1e9))
        assert factor is not None
        in_base = np.sqrt(np.diag(Ad @ (factor.noise + factor.drift) @ Ad.T))
        assert 0.5 * climb_m < in_base[2] < climb_m
        assert (np.degrees(in_base[3:5]) < tilt_deg).all()
        assert (np.degrees(in_base[3:5]) > 0.5 * tilt_deg).all()


def test_drift_adds_up_as_a_sigma_and_noise_as_a_variance() -> None:
    wheels, covariance = driven(10.0, STRAIGHT), np.zeros((6, 6))
    Ad = se3.adjoint(T_BASE_CAM)
    one = wheels.factor(0, 100 * MS)
    assert one is not None
    drift_m = np.sqrt((Ad @ one.drift @ Ad.T)[0, 0])
    for k in range(100):
        factor = wheels.factor(100 * MS * k, 100 * MS * (k + 1))
        assert factor is not None
        covariance = factor.added_to(covariance)
    along_m = np.sqrt((Ad @ covariance @ Ad.T)[0, 0])
    assert 100 * drift_m < along_m < 110 * drift_m


@pytest.mark.parametrize('scale', [0.95, 1.05])
def test_a_scale_is_learned_from_the_images(scale: float) -> None:
    wheels = driven(10.0, ARC, scale)
    for k in range(20):
        start_s, end_s = 0.5 * k, 0.5 * (k + 1)
        wheels.learn(round(start_s * 1e9), round(end_s * 1e9), seen(start_s, end_s), MILLIMETRE2)
    assert wheels.scales[0] == pytest.approx(scale - 1.0, abs=5e-3)
    factor = wheels.factor(0, 5000 * MS)
    assert factor is not None
    base = T_BASE_CAM @ factor.T_before_now @ se3.inverse(T_BASE_CAM)
    assert np.linalg.norm(se3.log(base)[:3]) == pytest.approx(2.5, rel=5e-3)
    assert wheels.reason(10_000 * MS) is None


def test_wheels_that_spin_are_left_out_and_taken_back() -> None:
    wheels, x, reasons = Wheels(T_BASE_CAM), 0.0, []
    for k in range(1, 601):  # 50 Hz; from 4 to 6 s they turn in place of a base that stands
        stamp_ns, moves = 20 * MS * k, not 200 <= k < 300
        x += 0.01
        wheels.sense(BasePose(stamp_ns, true_base(x / 0.5, STRAIGHT)))
        if k % 25 == 0 and k > 25:
            way = STRAIGHT * (0.5 if moves else 0.0)
            T = se3.inverse(T_BASE_CAM) @ se3.exp(way) @ T_BASE_CAM
            wheels.learn(stamp_ns - 500 * MS, stamp_ns, T, MILLIMETRE2)
            reasons.append(wheels.reason(stamp_ns))
    assert reasons[5] is None
    assert 'contradicts the images' in str(reasons[9])
    assert 'cm' in str(reasons[9])
    assert reasons[-1] is None


def test_wheels_without_poses_say_so() -> None:
    wheels = Wheels(T_BASE_CAM)
    assert wheels.reason(0) == 'no pose yet'
    assert wheels.factor(0, 33 * MS) is None
    wheels.sense(BasePose(0, np.eye(4)))
    wheels.sense(BasePose(2000 * MS, np.eye(4)))
    assert wheels.factor(0, 1000 * MS) is None  # what was between is not known
    assert wheels.reason(3000 * MS) == 'no pose for 1.00 s'


def test_a_published_covariance_is_the_least_noise_of_a_motion() -> None:
    """Each velocity errs by itself, so that over 50 of them a second the variance is v / 50."""
    wheels, variance = Wheels(np.eye(4)), np.array([0.04, 0.01, 0.09])
    for stamp_ns in range(0, 1001 * MS, 20 * MS):
        wheels.sense(BasePose(stamp_ns, true_base(stamp_ns * 1e-9, STRAIGHT), variance))
    factor = wheels.factor(500 * MS, 600 * MS)
    assert factor is not None
    expected = variance * 0.02 * 0.1
    np.testing.assert_allclose(np.diag(factor.noise)[[0, 1, 5]], expected)


def test_poses_of_another_clock_are_not_used() -> None:
    wheels = driven(1.0)
    assert wheels.reason(500 * MS) is None
    assert wheels.reason(-3_000 * MS) == 'no pose before 3.00 s after the images: of another clock'
