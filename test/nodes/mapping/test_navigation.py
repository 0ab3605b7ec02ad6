# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The grid and the obstacles as nav2 gets them, over DDS."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from boxes_seen import (  # type: ignore[import-not-found]
    CAMERA,
    EXACT,
    WALL,
    camera_at,
    depth_of,
)
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from nav_msgs.msg import OccupancyGrid
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from dcgs_ros.core.config.navigation import GridConfig
from dcgs_ros.core.config.nodes import MapperNodeSettings, MapperSettings
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction, Keyframe
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.navigation.voxels import FREE, OCCUPIED, UNKNOWN
from dcgs_ros.nodes.mapping.navigation import Navigation, Seen
from dcgs_ros.nodes.messages.clouds import POINT, read_cloud
from dcgs_ros.nodes.transport import RELIABLE, latched

HANGS_S = 60.0
SECOND = 1_000_000_000
HERE = camera_at(0.0, 0.0, 0.6)
NODE = MapperNodeSettings(grid_rate_hz=30.0, obstacles_rate_hz=30.0)


class Planner:
    """A mapper's navigation outputs, and who listens to them."""

    def __init__(self, settings: MapperSettings | None = None) -> None:
        self.node, self.ear = Node('brain'), Node('planner')
        self.navigation = Navigation(self.node, settings or MapperSettings(node=NODE))
        self.mapper = Mapper(CAMERA, Config(sensor=EXACT, threads=1))
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.ear)
        self.grids: list[OccupancyGrid] = []
        self.clouds: list[PointCloud2] = []

    def listen(self) -> None:
        """Subscribe as nav2's static layer does, and to obstacles."""
        self.ear.create_subscription(OccupancyGrid, 'grid', self.grids.append, latched(1))
        self.ear.create_subscription(PointCloud2, 'obstacles', self.clouds.append, RELIABLE)

    def insert(self, T: NDArray[np.float64], depth_m: NDArray[np.float32]) -> None:
        """Give the mapper a keyframe."""
        stamp = SECOND * (len(self.mapper.views) + 1)
        color = np.full((*depth_m.shape, 3), 128, np.uint8)
        none = np.empty((0, 3), np.float32)
        frame = RgbdFrame(stamp, stamp, color, depth_m)
        self.mapper.insert(Keyframe(frame, T, np.eye(4), np.empty(0, np.int64), none, none))

    def until(self, condition: Callable[[], Any], seen: Seen) -> None:
        """Work as the mapper's thread does until something has come."""
        end = time.monotonic() + HANGS_S
        while not condition():
            assert time.monotonic() < end
            self.navigation.follow(self.mapper, seen.camera_frame)
            self.navigation.publish_when_due(seen)
            self.executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        self.node.destroy_node()
        self.ear.destroy_node()


@pytest.fixture
def planner(ros: None) -> Iterator[Planner]:
    """Return outputs with nothing in the map."""
    made = Planner()
    yield made
    made.close()


def value(grid: OccupancyGrid, x: float, y: float) -> int:
    """Return the cell at a place, metres."""
    info = grid.info
    assert info.origin.orientation.w == 1.0
    column = int((x - info.origin.position.x) / info.resolution)
    row = int((y - info.origin.position.y) / info.resolution)
    return int(grid.data[row * info.width + column])


def test_late_planner_gets_the_grid_with_stamp_and_frame(planner: Planner) -> None:
    """As nav2 wants its map: reliable, transient local, row by row from its origin."""
    planner.insert(HERE, depth_of(HERE, WALL))
    seen = Seen('map', 7 * SECOND, 'optical', None)
    planner.navigation.follow(planner.mapper, 'optical')
    planner.navigation.publish_when_due(seen)
    planner.listen()
    planner.until(lambda: planner.grids, seen)
    grid = planner.grids[0]
    assert (grid.header.frame_id, grid.header.stamp.sec) == ('map', 7)
    assert grid.info.resolution == pytest.approx(0.05)
    assert value(grid, 1.5, 0.01) == FREE
    assert value(grid, 2.02, 0.6) == OCCUPIED
    assert value(grid, 2.4, 0.0) == UNKNOWN
    assert value(grid, 1.5, -1.8) == UNKNOWN  # rows are along y


def test_grid_follows_corrected_keyframes_and_is_not_sent_again_without_a_change(
    planner: Planner,
) -> None:
    """What was at 2 m is at 2.32 once the keyframe has moved."""
    planner.listen()
    planner.insert(HERE, depth_of(HERE, WALL))
    seen = Seen('map', SECOND, 'optical', None)
    planner.until(lambda: planner.grids, seen)
    for _ in range(20):
        planner.navigation.publish_when_due(seen)
        planner.executor.spin_once(timeout_sec=0.01)
    assert len(planner.grids) == 1
    moved = camera_at(0.32, 0.0, 0.6)
    stamps, sure = np.array([SECOND]), np.zeros((1, 6, 6))
    planner.mapper.correct(Correction(1, stamps, moved[None], sure, np.zeros(1, np.int32)))
    planner.navigation.correct()
    planner.until(lambda: len(planner.grids) > 1, seen)
    grid = planner.grids[-1]
    assert value(grid, 2.02, 0.6) == FREE
    assert value(grid, 2.32, 0.6) == OCCUPIED


def test_other_map_begins_a_new_grid(planner: Planner) -> None:
    """After a reset nothing of the old one is left."""
    planner.listen()
    planner.insert(HERE, depth_of(HERE, WALL))
    seen = Seen('map', SECOND, 'optical', None)
    planner.until(lambda: planner.grids, seen)
    planner.mapper = Mapper(CAMERA, Config(sensor=EXACT, threads=1))
    planner.insert(HERE, depth_of(HERE))
    planner.until(lambda: len(planner.grids) > 1, seen)
    assert OCCUPIED not in planner.grids[-1].data


def test_obstacles_are_opaque_in_the_band_in_range_and_not_the_robot(ros: None) -> None:
    """Each rule leaves its own Gaussians out."""
    base = replace(NODE, base_to_camera='0 0 0.6 0.5 -0.5 0.5 -0.5')
    grid = GridConfig(self_box='-0.5 -0.5 0 0.5 0.5 1')
    planner = Planner(MapperSettings(node=base, grid=grid))
    try:
        planner.listen()
        planner.insert(HERE, depth_of(HERE, WALL))
        splats = planner.mapper.table.splats
        splats.means[:] = np.array([[1.0], [0.0], [-5.0]])  # under the floor
        splats.opacity_logits[:] = 3.0
        places = [(1, 0, 0.5), (1.01, 0, 0.51), (1, 1, 1.6), (9, 0, 0.5), (0.2, 0, 0.5), (1, 2, 1)]
        splats.means[:, : len(places)] = np.array(places).T
        splats.opacity_logits[5] = -3.0
        seen = Seen('map', SECOND, 'optical', HERE)
        planner.until(lambda: planner.clouds, seen)
        cloud = planner.clouds[0]
        assert cloud.header.frame_id == 'map'
        rows = read_cloud(cloud, POINT)
        np.testing.assert_allclose([list(row) for row in rows], [(1, 0, 0.5)], atol=1e-6)
    finally:
        planner.close()


def test_rate_of_zero_makes_no_grid_and_obstacles_all_the_same(ros: None) -> None:
    """It then costs nothing."""
    planner = Planner(MapperSettings(node=replace(NODE, grid_rate_hz=0.0)))
    try:
        planner.insert(HERE, depth_of(HERE, WALL))
        assert not planner.navigation.follow(planner.mapper, 'optical')
        assert planner.navigation._grid is None
        planner.listen()
        planner.until(lambda: planner.clouds, Seen('map', SECOND, 'optical', None))
    finally:
        planner.close()


def test_map_with_compressed_and_retired_views_is_taken_a_few_at_a_time(planner: Planner) -> None:
    """As of a file: the mapper's thread is not held up."""
    for k in range(6):
        T = camera_at(0.01 * k, 0.0, 0.6)
        planner.insert(T, depth_of(T, WALL))
    for view in planner.mapper.views:
        view.compress()
    planner.mapper.views[0].retire()
    assert planner.navigation.follow(planner.mapper, 'optical')
    assert not planner.navigation.follow(planner.mapper, 'optical')
    assert planner.navigation._grid is not None
    assert planner.navigation._grid.views == 6
    assert OCCUPIED in planner.navigation._grid.map.cells
