# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""map -> odom beside perfect wheels is constant however the robot moves, and fresh."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from dcgs_ros.core import se3
from dcgs_ros.nodes.tracking.map_to_odom import MapToOdom, PlacedBase

EXACT = 1e-9
MS, SECOND = 1_000_000, 1_000_000_000
NOW = 1_700_000_000 * SECOND
TOLERANCE = 100 * MS
FRAME, ODOMETRY = 33_333_333, 20 * MS  # 30 Hz, 50 Hz
TURN_RAD_S, SPEED_M_S = 1.0, 0.5
T_MAP_ODOM = se3.exp(np.array([1.0, -2.0, 0.1, 0.02, -0.01, 0.8]))
M = se3.exp(np.array([0.4, -0.2, 0.1, 0.0, 0.3, 0.1]))


def turning(stamp_ns: int) -> NDArray[np.float64]:
    """T_odom_base (4, 4) of a robot that drives in a circle."""
    t = (stamp_ns - NOW) * 1e-9
    return se3.exp(t * np.array([SPEED_M_S, 0.0, 0.0, 0.0, 0.0, TURN_RAD_S]))


class Wheels:
    """TF's buffer of perfect wheel odometry: interpolated as tf2 does it, not extrapolated."""

    def __init__(self) -> None:
        self.newest_ns = NOW  # that has arrived

    def lookup(self, stamp_ns: int) -> NDArray[np.float64] | None:
        before = stamp_ns // ODOMETRY * ODOMETRY
        after = before + ODOMETRY
        if after > self.newest_ns:
            return None
        a, b, share = turning(before), turning(after), (stamp_ns - before) / ODOMETRY
        T = np.eye(4)
        T[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
        both = Rotation.from_matrix(np.stack([a[:3, :3], b[:3, :3]]))
        T[:3, :3] = Slerp([0.0, 1.0], both)(share).as_matrix()
        return T


class Robot:
    def __init__(self) -> None:
        self.wheels, self.warnings = Wheels(), list[str]()
        self.placer = MapToOdom(self.wheels.lookup, 'odom -> base', self.warnings.append)

    def see(self, stamp_ns: int, now_ns: int, keyframe: int = 0) -> None:
        T_map_base = T_MAP_ODOM @ turning(stamp_ns)
        self.placer.place(PlacedBase(stamp_ns, T_map_base, keyframe), now_ns)


@pytest.mark.parametrize('late_ms', [100, 0, -100], ids=['images', 'none', 'wheels'])
def test_a_turn_does_not_show_whichever_comes_later(late_ms: int) -> None:
    """Images are tracked 100 ms after they were taken, or odometry comes 100 ms after them."""
    robot, errors = Robot(), list[NDArray[np.float64]]()
    for k in range(60):
        stamp_ns = NOW + k * FRAME
        robot.wheels.newest_ns = stamp_ns + late_ms * MS
        now_ns = stamp_ns + max(late_ms, 0) * MS
        robot.see(stamp_ns, now_ns)
        found = robot.placer.at(now_ns, TOLERANCE)
        if found is not None:
            errors.append(se3.log(se3.inverse(T_MAP_ODOM) @ found.T_map_odom))
    assert len(errors) > 50
    assert np.linalg.norm(np.array(errors)[:, :3], axis=1).max() < 1e-3
    assert np.linalg.norm(np.array(errors)[:, 3:], axis=1).max() < np.radians(0.1)
    assert not robot.warnings


def test_it_is_as_fresh_after_ten_seconds_without_a_pose_as_before() -> None:
    robot = Robot()
    robot.see(NOW, NOW + 30 * MS)
    robot.wheels.newest_ns = NOW + SECOND
    stamps = list[int]()
    for k in range(200):
        now_ns = NOW + (40 + 50 * k) * MS
        found = robot.placer.at(now_ns, TOLERANCE)
        assert found is not None and found.stamp_ns == now_ns + TOLERANCE
        np.testing.assert_allclose(found.T_map_odom, T_MAP_ODOM, atol=1e-4)
        stamps.append(found.stamp_ns)
    assert stamps == sorted(set(stamps))
    assert robot.placer.at(now_ns, TOLERANCE) is None  # the same stamp again: TF would warn


def test_the_stamps_of_a_recording_go_on_in_its_own_clock() -> None:
    """Played a year later, without simulated time."""
    robot, late_ns = Robot(), 365 * 86400 * SECOND
    robot.wheels.newest_ns = NOW + SECOND
    robot.see(NOW, NOW + late_ns)
    for waited_ns in (0, 50 * MS, 10 * SECOND):
        found = robot.placer.at(NOW + late_ns + waited_ns, TOLERANCE)
        assert found is not None and found.stamp_ns == NOW + waited_ns + TOLERANCE


def test_a_recording_that_begins_again_is_followed() -> None:
    """Whose end waits for odometry that will not come."""
    robot, long_ago = Robot(), NOW - 20 * SECOND
    robot.wheels.newest_ns = NOW + ODOMETRY
    robot.see(NOW, NOW)
    assert robot.placer.at(NOW, TOLERANCE) is not None
    robot.see(NOW + SECOND, NOW + SECOND)
    robot.placer.correct(np.stack([M]))
    robot.see(long_ago, NOW + SECOND)
    found = robot.placer.at(NOW + SECOND, TOLERANCE)
    assert found is not None and found.stamp_ns == long_ago + TOLERANCE
    np.testing.assert_allclose(found.T_map_odom, T_MAP_ODOM, atol=1e-4)


def test_nothing_is_said_before_it_is_known_nor_of_another_map() -> None:
    robot = Robot()
    assert robot.placer.at(NOW, TOLERANCE) is None
    robot.see(NOW, NOW)
    assert robot.placer.at(NOW + 50 * MS, TOLERANCE) is None  # the wheels have not come
    robot.wheels.newest_ns = NOW + SECOND
    assert robot.placer.at(NOW + 100 * MS, TOLERANCE) is not None
    robot.placer.forget()
    assert robot.placer.at(NOW + 150 * MS, TOLERANCE) is None


def test_without_odometry_the_last_place_holds_and_that_is_said_once() -> None:
    robot = Robot()
    robot.wheels.newest_ns = NOW + 100 * MS
    for k in range(90):
        stamp_ns = NOW + k * FRAME
        robot.see(stamp_ns, stamp_ns)
        found = robot.placer.at(stamp_ns, TOLERANCE)
        assert found is not None
        np.testing.assert_allclose(found.T_map_odom, T_MAP_ODOM, atol=1e-4)
    assert len(robot.warnings) == 1 and 'odom -> base' in robot.warnings[0]
    assert robot.placer.doubt == robot.warnings[0]
    robot.wheels.newest_ns = NOW + 10 * SECOND
    robot.placer.at(NOW + 5 * SECOND, TOLERANCE)
    assert robot.placer.doubt is None


def test_a_correction_moves_what_waits_and_what_was_placed() -> None:
    """With the keyframe each was placed by; without images too."""
    motions, robot = np.stack([np.eye(4), M]), Robot()
    robot.wheels.newest_ns = NOW + ODOMETRY
    robot.see(NOW, NOW, keyframe=1)
    assert robot.placer.at(NOW, TOLERANCE) is not None
    robot.see(NOW + FRAME, NOW + FRAME, keyframe=1)
    robot.placer.correct(motions)
    for newest_ns in (NOW + ODOMETRY, NOW + SECOND):  # the second one waits, then does not
        robot.wheels.newest_ns = newest_ns
        found = robot.placer.at(newest_ns, TOLERANCE)
        assert found is not None
        np.testing.assert_allclose(found.T_map_odom, M @ T_MAP_ODOM, atol=1e-4)


def test_a_base_without_a_keyframe_stays() -> None:
    base = PlacedBase(NOW, T_MAP_ODOM, -1)
    np.testing.assert_allclose(base.moved(M[None]).T_map_base, T_MAP_ODOM, atol=EXACT)
