# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A pose rests on the landmarks that stand still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dcgs_ros.core import se3
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.cloud import FrameCloud
from dcgs_ros.core.tracking.consensus import Corners, standing
from dcgs_ros.core.tracking.estimator import estimate
from dcgs_ros.core.tracking.factors import PointFactors, PosePrior, Targets
from dcgs_ros.core.tracking.keyframes import candidates
from dcgs_ros.core.tracking.registration import start_from_landmarks

from .tracked_room import SEEN, SOURCE, frames, tracker

COUNT, SIGMA_M = 240, 0.002
NEAR_M = 1e-3
SHIFT_PX = 12  # by which a part of the image moves
BLOCK = slice(120, 400), slice(60, 260)


def landmarks(moving: int, step_m: float, seed: int) -> tuple[PosePrior, PointFactors]:
    """Corners seen from the origin at two depths; the first, which are near, went to the side."""
    rng = np.random.default_rng(seed)
    depths = np.where(np.arange(COUNT) < moving, 0.8, rng.uniform(1.5, 2.8, COUNT))
    rays = np.column_stack([rng.uniform((-0.6, -0.4), (0.6, 0.4), (COUNT, 2)), np.ones(COUNT)])
    world = rays * depths[:, None]
    seen = world + rng.normal(0.0, SIGMA_M, world.shape)
    seen[:moving, 0] += step_m
    perp = np.full(COUNT, 1e-12, np.float32)
    axes = np.tile(np.array([0, 0, 1], np.float32), (COUNT, 1))
    hosts = np.zeros(COUNT, np.int32)
    targets = Targets(world.astype(np.float32), axes, perp, perp, hosts)
    covariances = np.tile(np.array([1, 0, 0, 1, 0, 1], np.float32) * SIGMA_M**2, (COUNT, 1))
    image = PointFactors(seen.astype(np.float32), covariances.astype(np.float32), targets, huber=2)
    return PosePrior(np.eye(4), 0.01, 0.01), image


def test_corners_that_move_are_told_and_do_not_move_the_pose() -> None:
    """A third goes aside by 3 cm: least squares by Huber follows, most corners do not."""
    moving = COUNT // 3
    prior, image = landmarks(moving, 0.03, seed=1)
    start = start_from_landmarks(prior, image)
    T, stands = standing(start, prior, image)
    np.testing.assert_array_equal(stands[:moving], False)
    assert stands[moving:].mean() > 0.98
    assert np.linalg.norm(T[:3, 3]) < NEAR_M < np.linalg.norm(start[:3, 3])


def test_where_all_stand_still_nothing_changes() -> None:
    """Then the pose that suits all remains, to the bit."""
    prior, image = landmarks(0, 0.0, seed=2)
    start = start_from_landmarks(prior, image)
    T, stands = standing(start, prior, image)
    assert T is start and stands.all()


def test_depth_goes_with_its_nearest_corner() -> None:
    """Beside a corner that moves points move, but not far away from it."""
    points = np.array([[0, 0, 1], [0.1, 0, 1], [0.6, 0, 1], [0, 0, 2]], np.float32)
    cloud = FrameCloud(points, -points, np.zeros(4, np.float32), 4)
    corners = Corners(np.array([[0, 0, 1], [0.5, 0, 1]], np.float32), np.array([True, False]))
    np.testing.assert_array_equal(corners.standing(cloud).points, points[2:])
    assert Corners.none().standing(cloud) is cloud


def with_moving_block() -> RgbdFrame:
    """Return the next frame of the room with a block of its image shifted."""
    frame = frames()[SEEN]
    color = frame.color.copy()
    color[BLOCK] = np.roll(frame.color, SHIFT_PX, axis=1)[BLOCK]
    return replace(frame, color=color)


def test_a_block_that_moves_is_left_out_of_the_estimate_and_of_the_map() -> None:
    """The pose stays, and neither depth factors nor candidates for the map are in the block."""
    made, config = tracker(), replace(Config(), sensor=SOURCE.sensor)
    truth = SOURCE.pose(frames()[SEEN].stamp_ns)
    first = SOURCE.pose(frames()[0].stamp_ns)
    found = estimate(
        with_moving_block(), made._memory, made.gaussians, SOURCE.camera, config
    ).registered
    apart = se3.log(se3.inverse(se3.inverse(first) @ truth) @ found.T_world_cam)
    assert np.linalg.norm(apart[:3]) < 0.01
    pixels = SOURCE.camera.project(found.corners.points[found.corners.moving].astype(np.float64))
    assert len(pixels) >= 10
    columns = BLOCK[1]
    inside = (pixels[:, 0] > columns.start - 20) & (pixels[:, 0] < columns.stop + 20)
    assert inside.mean() > 0.8
    still = replace(found, corners=Corners.none())
    counts = [len(candidates(one, None, SOURCE.camera, config)) for one in (found, still)]
    assert counts[0] < 0.95 * counts[1]
