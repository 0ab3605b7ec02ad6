# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""In odom the camera moves as it was tracked, whatever becomes of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.keyframe import Correction
from dcgs_ros.core.tracking.result import Reference, TrackingState, TrackResult
from dcgs_ros.core.tracking.visited import UNKNOWN, origin
from dcgs_ros.nodes.tracking.corrected import Corrected
from dcgs_ros.nodes.tracking.odometry_frame import OdometryFrame

EXACT = 1e-12
OK, RELOCALISED = TrackingState.OK, TrackingState.RELOCALISED
STEP = se3.exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.01]))
BASE_CAM = se3.exp(np.array([0.1, 0.0, 0.2, 0.3, -1.2, 0.4]))
M = se3.exp(np.array([0.4, -0.2, 0.1, 0.0, 0.3, 0.1]))
FRAME = 1e-6 * np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])


def result_at(
    T_world_cam: NDArray[np.float64], state: TrackingState = OK, submap: int = 0,
    keyframe: bool = False,
) -> TrackResult:  # fmt: skip
    reference = Reference(submap, np.eye(4), submap, 7, 0, np.eye(4))
    return TrackResult(
        1, T_world_cam, np.eye(4), FRAME, UNKNOWN, state, None, 0, 0, 0, keyframe, (), 0.0,
        reference,
    )  # fmt: skip


def corrected_by(motion: NDArray[np.float64], submaps: tuple[int, ...] = (0, 0)) -> Corrected:
    n = len(submaps)
    correction = Correction(
        1, np.arange(n), np.tile(motion, (n, 1, 1)), np.zeros((n, 6, 6)),
        np.array(submaps, np.int32),
    )  # fmt: skip
    return Corrected(correction, correction, np.tile(motion, (n, 1, 1)), motion)


def moved(odom: OdometryFrame, result: TrackResult) -> NDArray[np.float64]:
    return odom.follow(result, BASE_CAM).T_odom_cam


def test_it_begins_in_the_map_and_follows_it() -> None:
    odom, T = OdometryFrame(), BASE_CAM
    for _ in range(5):
        np.testing.assert_allclose(moved(odom, result_at(T)), T, atol=EXACT)
        T = T @ STEP


def test_a_correction_is_no_step() -> None:
    odom, T = OdometryFrame(), BASE_CAM
    moved(odom, result_at(T))
    odom.correct(corrected_by(M))
    np.testing.assert_allclose(moved(odom, result_at(M @ T @ STEP)), T @ STEP, atol=EXACT)
    following = moved(odom, result_at(M @ T @ STEP @ STEP))
    np.testing.assert_allclose(following, T @ STEP @ STEP, atol=EXACT)


def test_a_camera_that_is_found_again_goes_on_from_where_it_was() -> None:
    """How far it went meanwhile is not known, and the drift says so once."""
    odom, T = OdometryFrame(), BASE_CAM
    before = odom.follow(result_at(T), BASE_CAM)
    found = odom.follow(result_at(M @ T, RELOCALISED), BASE_CAM)
    np.testing.assert_allclose(found.T_odom_cam, T, atol=EXACT)
    np.testing.assert_allclose(found.covariance - before.covariance, np.eye(6), atol=1.2)
    assert np.all(np.linalg.eigvalsh(found.covariance - before.covariance) > 0.5)
    confirmed = odom.follow(result_at(M @ T @ STEP, RELOCALISED), BASE_CAM)
    np.testing.assert_allclose(confirmed.T_odom_cam, T @ STEP, atol=EXACT)
    odom.lose()
    again = odom.follow(result_at(T, RELOCALISED), BASE_CAM)
    np.testing.assert_allclose(again.T_odom_cam, T @ STEP, atol=EXACT)


def test_neither_a_new_sub_map_nor_its_joining_is_a_step() -> None:
    odom, T, there = OdometryFrame(), BASE_CAM, np.eye(4)
    there[:3, 3] = origin(1)
    moved(odom, result_at(T))
    new = odom.follow(result_at(there @ T, submap=1), BASE_CAM)
    np.testing.assert_allclose(new.T_odom_cam, T, atol=EXACT)
    assert np.linalg.eigvalsh(new.covariance).max() < 10.0  # not that of an unknown place
    odom.correct(corrected_by(se3.inverse(there), (0, 0)))
    joined = replace(result_at(T @ STEP), reference=Reference(1, np.eye(4), 0, 7, 1, np.eye(4)))
    np.testing.assert_allclose(moved(odom, joined), T @ STEP, atol=1e-9)


def test_a_first_frame_in_a_sub_map_is_at_the_base() -> None:
    there = np.eye(4)
    there[:3, 3] = origin(1)
    np.testing.assert_array_equal(
        moved(OdometryFrame(), result_at(there, submap=1)), se3.orthonormalised(BASE_CAM)
    )


def test_drift_adds_up_over_keyframes_and_no_faster() -> None:
    odom, T = OdometryFrame(), np.eye(4)
    for k in range(20):
        pose = odom.follow(result_at(T, keyframe=k % 5 == 0), BASE_CAM)
    expected = (4 + 1) * FRAME  # four keyframes, and the frame's own; the camera stands still
    np.testing.assert_allclose(pose.covariance, expected, rtol=1e-9)


def test_drift_is_that_of_a_lever() -> None:
    """A turn that is wrong by 1 mrad at a keyframe is 1 cm off ten metres farther."""
    odom, ahead = OdometryFrame(), np.eye(4)
    turn = np.diag([0.0, 0.0, 0.0, 0.0, 1e-6, 0.0])
    odom.follow(replace(result_at(np.eye(4), keyframe=True), covariance=turn), BASE_CAM)
    ahead[2, 3] = 10.0
    pose = odom.follow(replace(result_at(ahead), covariance=np.zeros((6, 6))), BASE_CAM)
    np.testing.assert_allclose(np.sqrt(pose.covariance[0, 0]), 0.01, rtol=1e-6)
