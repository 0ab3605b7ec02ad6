# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The robot's own parts in the image: nothing there is used by anything."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from tracked_room import SOURCE, frames  # type: ignore[import-not-found]

from dcgs_ros.core.backend.features import Features, extract
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import ConfigError, override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import FrameError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.mapping.rectification import Rectifier
from dcgs_ros.core.self_mask import covered, seen_beside, without_robot
from dcgs_ros.core.tracking.tracker import Tracker

MASK = '[[0.3, 0.25], [0.7, 0.25], [0.7, 1], [0.3, 1]]'
CONFIG = override(Config(sensor=SOURCE.sensor), {'self_mask': MASK})
PART = (slice(120, 480), slice(192, 448))
NEAR_M = 0.4


def mask() -> NDArray[np.bool_]:
    """Return the mask of the synthetic camera."""
    found = covered(MASK, SOURCE.camera.width, SOURCE.camera.height)
    assert found is not None
    return found


@cache
def with_part() -> tuple[RgbdFrame, ...]:
    """Return frames in which a textured plate is fixed before the camera."""
    squares = np.random.default_rng(0).integers(0, 256, (23, 16), np.uint8)
    texture = squares.repeat(16, 0).repeat(16, 1)[:360, :256, None]
    shown = []
    for frame in frames():
        color, depth_m = frame.color.copy(), frame.depth_m.copy()
        color[PART], depth_m[PART] = texture, NEAR_M
        shown.append(replace(frame, color=color, depth_m=depth_m))
    return tuple(shown)


@cache
def tracked() -> Tracker:
    """Return a tracker that has seen them."""
    made = Tracker(SOURCE.camera, CONFIG)
    for frame in with_part():
        made.track(frame)
    return made


def test_mask_covers_the_polygon_and_a_margin() -> None:
    """The margin is for windows of corners beside it; several polygons add up."""
    found = mask()
    inside = np.zeros_like(found)
    inside[PART] = True
    assert found[inside].all()
    assert found[110, 300] == found[112, 300] or found[113, 300]
    assert not found[:110].any() and not found[:, :180].any()
    two = covered('[[[0, 0], [0.1, 0], [0, 0.1]], [[1, 1], [0.9, 1], [1, 0.9]]]', 640, 480)
    assert two is not None
    assert two[5, 5] and two[470, 635] and not two[240, 320]
    assert covered('', 640, 480) is None


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('[[0.1, 0.2], [0.3, 0.4]]', 'not the corners of a polygon'),
        ('[[10, 20], [30, 40], [50, 60]]', 'shares of width and height'),
        ('[[0.1, 0.2, 0.3]]', 'not the corners'),
        ('[[0.1, 0.2], [0.3]]', 'not the corners'),
        ('[]', 'not the corners'),
        ('mask.png', 'not the corners'),
        ('{"a": 1}', 'not the corners'),
        ('[[0.1, "b"], [0.3, 0.4], [0.2, 0.2]]', 'not the corners'),
        ('[[0.1, NaN], [0.3, 0.4], [0.2, 0.2]]', 'shares of width'),
    ],
)
def test_anything_but_polygons_is_refused_with_an_example(text: str, words: str) -> None:
    """Pixels, a file's name and half a polygon, each with what is wanted."""
    with pytest.raises(ConfigError, match=f'self_mask .*{words}'):
        override(Config(), {'self_mask': text})


def test_tracker_believes_no_depth_there() -> None:
    """So nothing is registered, spawned or handed to mapper and grid there."""
    depth_m = tracked().corrected(with_part()[0]).depth_m
    assert not depth_m[mask()].any()
    np.testing.assert_array_equal(depth_m[~mask()], with_part()[0].depth_m[~mask()])
    seen = tracked().gaussians
    distances = np.linalg.norm(seen.means - seen.viewpoints, axis=1)
    assert distances.min() > 1.5 * NEAR_M


def test_landmarks_are_neither_detected_there_nor_followed_to_there() -> None:
    """A corner that comes behind the plate is dropped, whatever KLT makes of it."""
    assert len(tracked().landmarks) > 50
    assert seen_beside(tracked().landmarks.pixels, mask()).all()
    free = Tracker(SOURCE.camera, Config(sensor=SOURCE.sensor))
    for frame in frames()[:2]:
        free.track(frame)
    assert not seen_beside(free.landmarks.pixels, mask()).all()
    free.reconfigure(CONFIG)
    free.track(with_part()[2])
    assert seen_beside(free.landmarks.pixels, mask()).all()


def test_places_are_not_recognised_by_it() -> None:
    """The robot looks the same everywhere."""
    frame, camera, sensor = with_part()[0], SOURCE.camera, SOURCE.sensor

    def pixels(features: Features) -> NDArray[np.float32]:
        return camera.project(np.column_stack([features.rays, np.ones(len(features))]))

    assert not seen_beside(pixels(extract(frame, camera, sensor)), mask()).all()
    found = extract(frame, camera, sensor, self_mask=MASK)
    assert len(found) > 50
    assert seen_beside(pixels(found), mask()).all()


def test_mapper_compares_no_pixel_there() -> None:
    """Its colour is not that of the map; through a lens the polygon is bent with the image."""
    mapper = Mapper(SOURCE.camera, CONFIG, workers=Workers(1))
    np.testing.assert_array_equal(mapper._rectify.valid, ~mask())
    camera = PinholeCamera(160, 120, 140.0, 140.0, 79.5, 59.5, (-0.2, 0.05, 0.0, 0.0))
    left = covered('[[0, 0], [0.25, 0], [0.25, 1], [0, 1]]', 160, 120)
    valid, whole = Rectifier(camera, left).valid, Rectifier(camera).valid
    edge = [int(np.flatnonzero(valid[row])[0]) for row in (1, 60)]
    assert edge[0] != edge[1]
    assert not (valid & ~whole).any()


def test_frame_of_which_nothing_is_left_is_refused() -> None:
    """As one without depth is."""
    with pytest.raises(FrameError, match='depth is zero everywhere'):
        without_robot(frames()[0], '[[0, 0], [1, 0], [1, 1], [0, 1]]')


def test_pose_does_not_go_along_with_a_part_in_view() -> None:
    """The plate moves with the camera, which the room does not."""
    true = SOURCE.groundtruth
    assert true is not None
    wanted = np.linalg.inv(true.T_world_cam[0]) @ true.T_world_cam[-1]
    assert np.linalg.norm(tracked().T_world_cam[:3, 3] - wanted[:3, 3]) < 0.005
