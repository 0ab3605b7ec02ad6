# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What came by itself enters the map late, and what has gone leaves it."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.tracking import newcomers
from dcgs_ros.core.tracking.estimator import RegisteredFrame
from dcgs_ros.core.tracking.gaussian_map import GaussianMap
from dcgs_ros.core.tracking.newcomers import Newcomers
from dcgs_ros.core.tracking.warmup import EVERY_FRAME

from .tracked_room import SEEN, frames, tracker

CAMERA = PinholeCamera(160, 120, 131.0, 131.0, 79.5, 59.5)
SENSOR = SensorNoise.structured_light()
WALL_M, BOX_M = 2.0, 1.0


def seen(time_s: float, depth_m: NDArray[np.float32], x_m: float = 0.0) -> RegisteredFrame:
    """Return a tracked frame from (x, 0, 0)."""
    stamp_ns, T = round(1e9 * time_s), np.eye(4)
    T[0, 3] = x_m
    color = np.zeros((*depth_m.shape, 3), np.uint8)
    frame = RgbdFrame(stamp_ns, stamp_ns, color, depth_m)
    return RegisteredFrame(frame, T, np.eye(4), color[..., 0], np.zeros(6), np.zeros(6))


def wall() -> NDArray[np.float32]:
    return np.full((120, 160), WALL_M, np.float32)


def with_box() -> NDArray[np.float32]:
    depth_m = wall()
    depth_m[30:90, 40:120] = BOX_M
    return depth_m


def on_the_box() -> NDArray[np.float32]:
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 6), np.linspace(-0.15, 0.15, 5))
    return np.column_stack([x.ravel(), y.ravel(), np.full(30, BOX_M)]).astype(np.float32)


def no_depth_before_the_box() -> NDArray[np.float32]:
    depth_m = wall()
    depth_m[20:100, 30:130] = 0.0
    return depth_m


def watching(*sights: tuple[float, NDArray[np.float32]]) -> Newcomers:
    made, empty = Newcomers(CAMERA), GaussianMap(0.06)
    for time_s, depth_m in sights:
        made.observe(seen(time_s, depth_m), empty, SENSOR)
    return made


def test_a_box_is_new_until_it_has_stood_for_a_while() -> None:
    """It is where the wall was seen; after a while an older image shows it."""
    made = watching((0.0, wall()), (0.3, wall()), (0.6, with_box()))
    assert made.among(on_the_box(), SENSOR).all()
    assert not made.among(
        on_the_box() + np.array([0, 0, WALL_M - BOX_M], np.float32), SENSOR
    ).any()
    made.observe(seen(2.0, with_box()), GaussianMap(0.06), SENSOR)
    assert made.among(on_the_box(), SENSOR).all()
    made.observe(seen(2.3, with_box()), GaussianMap(0.06), SENSOR)
    assert not made.among(on_the_box(), SENSOR).any()


def test_before_a_wall_without_depth_the_nearest_point_tells() -> None:
    """Half of the wall behind the box had no depth: the box is new as a whole."""
    holes = wall()
    holes[:, 80:] = 0.0
    assert (
        watching((0.0, holes), (0.3, holes), (2.0, with_box())).among(on_the_box(), SENSOR).all()
    )
    assert not watching((0.0, wall())).among(on_the_box(), SENSOR).any()


def test_images_move_with_a_correction() -> None:
    """What was seen empty is so in the corrected world."""
    made, motion = watching((0.0, wall()), (0.3, wall())), np.eye(4)
    motion[0, 3] = 50.0
    made.move(motion)
    assert not made.among(on_the_box(), SENSOR).any()
    assert made.among(on_the_box() + np.array([50, 0, 0], np.float32), SENSOR).all()


def mapped(host: int = 0) -> GaussianMap:
    gaussians, points = GaussianMap(0.06), on_the_box()
    normals = np.tile(np.array([0, 0, -1], np.float32), (len(points), 1))
    gaussians.add(points, normals, np.zeros(len(points), np.float32), np.zeros(3), host)
    return gaussians


@pytest.mark.parametrize(
    ('sights', 'left'),
    [
        ([wall()], 30),
        ([wall(), wall()], 30),
        ([wall()] * 3, 0),
        ([wall(), wall(), with_box(), wall()], 30),
        ([np.full((120, 160), 0.5, np.float32)] * 3, 30),
        ([no_depth_before_the_box()] * 3, 30),
    ],
)
def test_what_three_images_look_through_is_gone(
    sights: list[NDArray[np.float32]], left: int
) -> None:
    """Not what two do, nor what is seen in between, hidden, or before what has no depth."""
    gaussians = mapped()
    for depth_m in sights:
        gaussians.notice(np.eye(4), depth_m, CAMERA, SENSOR)
    removed = gaussians.remove_gone(0)
    assert len(gaussians) == left == 30 - len(removed)


def test_edges_and_older_parts_of_the_map_stay() -> None:
    """A pose a little off looks past edges; a map that is far off is not emptied."""
    grazed = with_box()
    for gaussians, first in ((mapped(), 1), (mapped(), 0)):
        for _ in range(3):
            gaussians.notice(np.eye(4), wall() if first else grazed, CAMERA, SENSOR)
        assert not len(gaussians.remove_gone(first))
    gaussians, edge = mapped(), wall()
    edge[:, :-1:2] = 0.0  # what is measured is beside the box's edge, in every second column
    edge[:, 42:118:4] = BOX_M
    for _ in range(3):
        gaussians.notice(np.eye(4), edge, CAMERA, SENSOR)
    assert not len(gaussians.remove_gone(0))


def test_the_tracker_removes_what_it_sees_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaussians in mid-air are gone after three images, but for holes in those."""
    monkeypatch.setattr(newcomers, '_EVERY_S', 0.0)
    made = deepcopy(tracker())
    before = made.T_world_cam[:3, :3] @ (0.25 * on_the_box()).T + made.T_world_cam[:3, 3:]
    points = (before.T + 0.25 * made.T_world_cam[:3, 2]).astype(np.float32)
    normals = np.tile(np.array([0, 0, -1], np.float32), (len(points), 1))
    ids = made.gaussians.add(points, normals, normals[:, 0], made.T_world_cam[:3, 3], 0)
    for frame in frames()[SEEN : SEEN + 3]:
        made.track(frame)
    assert made.gaussians.alive(ids).mean() < 0.4


def test_the_tracker_maps_no_newcomers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither Gaussians nor landmarks."""
    spawned = []
    for none in (False, True):
        made = deepcopy(tracker())
        made.reconfigure(override(made.config, EVERY_FRAME))
        if none:
            monkeypatch.setattr(
                Newcomers, 'among', lambda self, points, sensor: np.ones(len(points), np.bool_)
            )
        result = made.track(frames()[SEEN])
        spawned.append(len(result.keyframes[-1].ids))
    assert spawned[0] > 0 == spawned[1]
