# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""One step by itself: it changes nothing it is given, and survives landmarks that are wrong."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tracked_room import SEEN, SOURCE, frames, tracker  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking import estimator
from dcgs_ros.core.tracking.estimator import Estimate, Memory, estimate
from dcgs_ros.core.tracking.landmarks import Landmarks
from dcgs_ros.core.tracking.registration import register

NEAR_M, NEAR_RAD = 0.01, np.radians(0.5)  # of the truth
MISLED_M = 0.05  # off where most landmarks lie together


def estimated(memory: Memory, frame: RgbdFrame | None = None) -> Estimate:
    made = tracker()
    frame = frames()[SEEN] if frame is None else frame
    return estimate(frame, memory, made.gaussians, made.camera, made.config)


def error(found: Estimate) -> tuple[float, float]:
    """Metres and radians off the true motion since the first frame."""
    first, now = (SOURCE.pose(frames()[k].stamp_ns) for k in (0, SEEN))
    xi = se3.log(se3.inverse(found.registered.T_world_cam) @ se3.inverse(first) @ now)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))


def with_landmarks(shift: NDArray[np.float64]) -> Memory:
    """Return the memory with every landmark moved (3,) in the world."""
    memory = tracker()._memory
    targets = memory.landmarks.targets
    moved = replace(targets, points=targets.points + shift.astype(np.float32))
    return replace(memory, landmarks=replace(memory.landmarks, targets=moved))


def state() -> bytes:
    """Return all that an estimate may read."""
    made = tracker()
    memory, gaussians = made._memory, made.gaussians
    assert memory.last is not None
    arrays: list[NDArray[Any]] = [
        memory.motion.T_world_cam, memory.motion.twist, memory.last.grey, memory.last.T_world_cam,
        memory.last.T_cam_cam_at_depth, memory.last.frame.depth_m, memory.landmarks.pixels,
        memory.landmarks.targets.points, gaussians.means, gaussians.normals, gaussians.viewpoints,
        gaussians.flatness, gaussians.ids,
    ]  # fmt: skip
    return b''.join(array.tobytes() for array in arrays)


def test_it_finds_the_pose_and_changes_nothing_that_it_is_given() -> None:
    before = state()
    one, other = (estimated(tracker()._memory) for _ in range(2))
    assert state() == before
    assert one.registered.T_world_cam.tobytes() == other.registered.T_world_cam.tobytes()
    assert one.is_trusted(tracker().config) and len(one.landmarks) > 100
    metres, radians = error(one)
    assert metres < NEAR_M and radians < NEAR_RAD


def test_an_estimate_from_nothing_is_not_trusted() -> None:
    frame = frames()[SEEN]
    board = replace(
        frame, color=np.full_like(frame.color, 120), depth_m=np.full_like(frame.depth_m, 0.35)
    )
    before = state()
    assert not estimated(tracker()._memory, board).is_trusted(tracker().config)
    assert state() == before


@pytest.mark.parametrize('axis', [0, 1])
def test_landmarks_that_lie_together_do_not_take_the_pose_along(axis: int) -> None:
    """Where their start explains far less of the depth than before, the prediction is tried."""
    memory = tracker()._memory
    lies = np.random.default_rng(0).random(len(memory.landmarks)) < 0.75
    memory = with_landmarks(np.outer(lies, 0.8 * np.eye(3)[axis]))
    found = estimated(memory)
    assert error(found)[0] < MISLED_M
    assert found.registration.overlap > 0.8 * memory.overlap
    image, by_image = found.registration.image, found.registration.image_equations
    assert image is not None and by_image is not None  # how sure the pose is
    expected = image.normal_equations(found.registered.T_world_cam).H
    np.testing.assert_array_equal(by_image.H, expected)


def test_along_a_wall_a_few_landmarks_say_more_than_the_prediction() -> None:
    """The nearest Gaussians would hold the camera where they are looked for first."""
    made, memory, wall = tracker(), tracker()._memory, deepcopy(tracker().gaussians)
    ahead = memory.motion.T_world_cam[:3, 2]
    wall.remove(wall.ids[(wall.ids >= 0) & (np.abs(wall.normals @ ahead) < 0.95)])
    beside = memory.motion.T_world_cam @ se3.exp(np.array([0.08, 0, 0, 0, 0, 0]))
    few = np.linspace(0, len(memory.landmarks) - 1, 19).astype(int)
    misplaced = replace(
        memory, motion=replace(memory.motion, T_world_cam=beside), landmarks=memory.landmarks[few]
    )
    found = estimate(frames()[SEEN], misplaced, wall, made.camera, made.config)
    assert len(found.landmarks) < 20 and found.registration.inliers > 1000
    assert error(found)[0] < 0.036  # from the prediction it ends at 0.045


@pytest.mark.parametrize('few', [False, True])
def test_under_an_old_image_depth_looks_no_farther_than_the_motion_is_uncertain(
    few: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matched from afar, the border of the map holds a camera back that goes on along a wall."""
    memory, seen, looked = tracker()._memory, frames()[SEEN], []

    def spied(T: Any, depth: Any, image: Any, config: Any, search_m: float, *others: Any) -> Any:
        looked.append(search_m)
        return register(T, depth, image, config, search_m, *others)

    monkeypatch.setattr(estimator, 'register', spied)
    assert memory.image is not None
    stale = replace(memory, image=replace(memory.image, grey=estimator.to_grey(seen.color)))
    if few:
        stale = replace(stale, landmarks=stale.landmarks[np.arange(9)])
    found, limits = estimated(stale), tracker().config.registration
    assert not found.fresh and found.registration.image is None
    assert looked == [limits.guess_radius_m if few else limits.radius_m]
    assert error(found)[0] < NEAR_M


def test_a_landmark_that_contradicts_the_pose_is_told_from_those_that_do_not() -> None:
    memory = tracker()._memory
    shift = np.zeros((len(memory.landmarks), 3))
    shift[::10] = [0.0, 0.15, 0.0]
    found = estimated(with_landmarks(shift))
    metres, radians = error(found)
    assert metres < NEAR_M and radians < NEAR_RAD
    right = memory.landmarks.targets.points
    kept = found.consistent_landmarks(tracker().config.landmarks.drop_chi2)
    moved = {tuple(point) for point in (right + shift.astype(np.float32))[::10]}
    assert not any(tuple(point) in moved for point in kept.targets.points)
    assert len(kept) > 0.8 * (len(found.landmarks) - len(moved))


def test_all_are_kept_where_there_is_no_image_residual() -> None:
    made = tracker()
    config = replace(made.config, ablation='sigma_t')
    bare = replace(made._memory, landmarks=Landmarks.none())
    found = estimate(frames()[SEEN], bare, made.gaussians, made.camera, config)
    assert found.registration.image is None and len(found.consistent_landmarks(1.0)) == 0
    assert found.is_trusted(config)
