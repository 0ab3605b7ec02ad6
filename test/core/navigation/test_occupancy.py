# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tests of the occupancy grid, on depth images without noise."""

from __future__ import annotations

import numpy as np
import pytest
from boxes_seen import (  # type: ignore[import-not-found]
    CAMERA,
    EXACT,
    WALL,
    Box,
    camera_at,
    depth_of,
)
from numpy.typing import NDArray

from dcgs_ros.core.config.navigation import GridConfig
from dcgs_ros.core.config.schema import ConfigError
from dcgs_ros.core.navigation.occupancy import OccupancyMap, OccupancyMapper
from dcgs_ros.core.navigation.voxels import FREE, OCCUPIED, UNKNOWN
from dcgs_ros.core.sensor import SensorNoise

HERE = camera_at(0.0, 0.0, 0.6)
CLUTTER: Box = ((1.2, -0.2, 0.0), (1.5, 0.2, 0.4))
CLEARED = 6  # views that see through what was there for long


def mapper(config: GridConfig | None = None) -> OccupancyMapper:
    """Return an empty grid."""
    return OccupancyMapper(CAMERA, EXACT, config or GridConfig())


def value(grid: OccupancyMap, x: float, y: float) -> int:
    """Return the cell at a place, metres; unknown outside the grid."""
    column, row = np.floor((np.array([x, y]) - grid.origin_m) / grid.resolution_m).astype(int)
    rows, columns = grid.cells.shape
    return int(grid.cells[row, column]) if 0 <= row < rows and 0 <= column < columns else UNKNOWN


def placed(grid: OccupancyMap) -> dict[tuple[int, int], int]:
    """Return the known cells by their place."""
    shift = np.round(np.array(grid.origin_m) / grid.resolution_m).astype(int)
    rows, columns = np.nonzero(grid.cells != UNKNOWN)
    return {
        (int(x), int(y)): int(v)
        for x, y, v in zip(
            columns + shift[0], rows + shift[1], grid.cells[rows, columns], strict=True
        )
    }


def test_wall_is_occupied_the_way_to_it_free_and_what_is_behind_unknown() -> None:
    """What nobody saw is not said to be free."""
    grid = mapper()
    grid.insert(depth_of(HERE, WALL), HERE)
    found = grid.map
    across = np.arange(-0.8, 0.8, 0.05)
    assert {value(found, 2.02, y) for y in across} == {OCCUPIED}
    assert {value(found, x, 0.01) for x in np.arange(1.2, 1.9, 0.05)} == {FREE}
    assert {value(found, x, 0.0) for x in np.arange(2.3, 3.0, 0.05)} == {UNKNOWN}
    assert value(found, 1.5, 1.6) == UNKNOWN  # beside the field of view


def test_column_of_which_the_lower_part_is_hidden_is_unknown() -> None:
    """Behind a low box the camera sees over it, and does not know what stands there."""
    grid = mapper()
    grid.insert(depth_of(HERE, WALL, CLUTTER), HERE)
    assert value(grid.map, 1.22, 0.01) == OCCUPIED
    assert value(grid.map, 1.75, 0.01) == UNKNOWN
    assert value(grid.map, 1.75, 0.6) == FREE


def test_heights_outside_the_band_are_no_obstacles() -> None:
    """A sill lower than it and a lamp above it do not stand in the way."""
    sill: Box = ((1.4, -0.3, 0.0), (1.5, 0.3, 0.08))
    lamp: Box = ((1.4, -0.3, 1.05), (1.5, 0.3, 1.1))
    grid = mapper(GridConfig(max_height_m=1.0))
    for height in (0.6, 1.0):
        camera = camera_at(0.0, 0.0, height)
        grid.insert(depth_of(camera, WALL, sill, lamp), camera)
    assert value(grid.map, 1.45, 0.0) == FREE
    lower = mapper(GridConfig(min_height_m=0.02))
    lower.insert(depth_of(HERE, WALL, sill), HERE)
    assert value(lower.map, 1.42, 0.0) == OCCUPIED


def test_what_is_seen_through_is_cleared_however_long_it_stood() -> None:
    """No ghost is left of a thing that was carried away."""
    grid = mapper()
    for _ in range(30):
        grid.insert(depth_of(HERE, WALL, CLUTTER), HERE)
    before = placed(grid.map)
    for _ in range(CLEARED):
        grid.insert(depth_of(HERE, WALL), HERE)
    empty = mapper()
    empty.insert(depth_of(HERE, WALL), HERE)
    assert value(empty.map, 1.22, 0.01) == FREE
    assert before[(24, 0)] == OCCUPIED
    assert placed(grid.map) == placed(empty.map)


def test_view_over_a_low_box_does_not_clear_it() -> None:
    """A ray tells of the heights only that it passes."""
    grid = mapper()
    grid.insert(depth_of(HERE, WALL, CLUTTER), HERE)
    above = camera_at(0.0, 0.0, 1.2)
    depth_m = depth_of(above, WALL, CLUTTER)
    depth_m[CAMERA.height // 2 :] = 0.0
    for _ in range(20):
        grid.insert(depth_m, above)
    assert value(grid.map, 1.22, 0.01) == OCCUPIED


def test_corrected_poses_give_the_grid_that_they_would_have_given_at_once() -> None:
    """Built again in pieces, it is the same to the last cell."""
    turned = [camera_at(0.0, 0.05 * k, 0.6, yaw=0.05 * k) for k in range(6)]
    right = [camera_at(0.13, 0.06 * k, 0.6, yaw=0.02 * k) for k in range(6)]
    moved, straight = mapper(), mapper()
    for wrong, T in zip(turned, right, strict=True):
        moved.insert(depth_of(T, WALL, CLUTTER), wrong)
        straight.insert(depth_of(T, WALL, CLUTTER), T)
    assert not moved.move(np.array(turned))
    assert moved.move(np.array(right))
    before = moved.map.cells.copy()
    assert moved.work(scans=4)
    np.testing.assert_array_equal(moved.map.cells, before)  # whole or not at all
    assert not moved.work(scans=4)
    # The scans are thinned on voxels of the map as it was, so that some cells differ.
    found, wanted = placed(moved.map), placed(straight.map)
    same = sum(found.get(cell) == v for cell, v in wanted.items())
    assert same > 0.98 * len(wanted)
    again = mapper()
    for wrong, T in zip(turned, right, strict=True):
        again.insert(depth_of(T, WALL, CLUTTER), wrong)
    again.move(np.array(right))
    while again.work(scans=1):
        pass
    assert placed(again.map) == found


def test_view_that_comes_while_the_grid_is_built_again_is_in_it() -> None:
    """Nothing is lost between two poses."""
    grid = mapper()
    grid.insert(depth_of(HERE, WALL), HERE)
    shifted = camera_at(0.3, 0.0, 0.6)
    assert grid.move(shifted[None])
    for _ in range(2):
        grid.insert(depth_of(shifted, WALL, CLUTTER), shifted)
    assert value(grid.map, 1.22, 0.01) == FREE
    while grid.work():
        pass
    assert value(grid.map, 1.22, 0.01) == OCCUPIED


def test_rays_longer_than_the_range_clear_up_to_it() -> None:
    """Far depth is too rough for a surface, not for what is before it."""
    grid = mapper(GridConfig(range_m=1.5))
    grid.insert(depth_of(HERE, WALL), HERE)
    assert value(grid.map, 1.35, 0.01) == FREE
    assert value(grid.map, 2.02, 0.01) == UNKNOWN
    noisy = SensorNoise(a_m=0.001, b_per_m=0.02)  # half a cell at 1.1 m
    grid = OccupancyMapper(CAMERA, noisy, GridConfig())
    grid.insert(depth_of(HERE, WALL), HERE)
    assert value(grid.map, 1.0, 0.01) == FREE
    assert value(grid.map, 2.02, 0.01) == UNKNOWN


def test_ray_clears_up_to_where_its_end_may_be() -> None:
    """Depth that is 8 cm too long, where its standard deviation is 5, does not clear the wall."""
    grid = OccupancyMapper(CAMERA, SensorNoise(a_m=0.05, b_per_m=0.0), GridConfig(range_m=5.0))
    grid.insert(depth_of(HERE, WALL), HERE)
    farther: Box = ((2.08, -3.0, 0.0), (2.3, 3.0, 2.5))
    for _ in range(10):
        grid.insert(depth_of(HERE, farther), HERE)
    assert value(grid.map, 2.02, 0.01) == OCCUPIED
    assert value(grid.map, 1.9, 0.01) == FREE


@pytest.mark.parametrize(
    'sensor', [SensorNoise(a_m=0.1, b_per_m=0.0), SensorNoise(depth_max_m=1e3)]
)
def test_range_of_any_sensor_is_usable(sensor: SensorNoise) -> None:
    """One that is rough at once, and one without an end."""
    grid = OccupancyMapper(CAMERA, sensor, GridConfig(resolution_m=0.2, max_height_m=0.7))
    near: Box = ((0.8, -3.0, 0.0), (1.0, 3.0, 2.5))
    grid.insert(depth_of(HERE, near), HERE)
    assert value(grid.map, 0.85, 0.1) == OCCUPIED
    assert (grid.map.cells[:, round(-grid.map.origin_m[0] / 0.2) + 6 :] == UNKNOWN).all()


def test_the_robot_itself_is_no_obstacle() -> None:
    """What is within its box, which moves with the base, is not used."""
    T_base_cam = camera_at(0.1, 0.0, 0.6)
    arm: Box = ((0.5, -0.1, 0.5), (0.6, 0.1, 0.7))
    config = GridConfig(self_box='0.3 -0.2 0.3, 0.7 0.2 0.8')
    for place in (0.0, 0.25):
        T = camera_at(0.1 + place, 0.0, 0.6)
        carried: Box = ((arm[0][0] + place, *arm[0][1:]), (arm[1][0] + place, *arm[1][1:]))
        depth_m = depth_of(T, WALL, carried)
        seen, ignored = mapper(), mapper(config)
        seen.insert(depth_m, T, T_base_cam)
        ignored.insert(depth_m, T, T_base_cam)
        assert value(seen.map, 0.52 + place, 0.01) == OCCUPIED
        assert OCCUPIED not in {value(ignored.map, x, 0.01) for x in np.arange(0.4, 1.0, 0.05)}
        assert value(ignored.map, 2.02, 0.7) == OCCUPIED


def test_memory_is_bounded_and_each_place_keeps_its_newest_view() -> None:
    """A robot that stands still all day does not fill its memory, nor forget where it was."""
    config = GridConfig(memory_mb=1.0)
    grid, elsewhere = mapper(config), camera_at(0.0, 0.5, 0.6, yaw=0.8)
    grid.insert(depth_of(elsewhere, WALL, CLUTTER), elsewhere)
    depth_m = depth_of(HERE, WALL)
    for _ in range(80):
        grid.insert(depth_m, HERE)
        assert grid.bytes <= 1e6
    poses = np.array([elsewhere, *[HERE] * 80])
    poses[:, 2, 3] += 0.01
    assert grid.move(poses)
    while grid.work():
        pass
    fresh = mapper(config)
    fresh.insert(depth_of(elsewhere, WALL, CLUTTER), poses[0])
    fresh.insert(depth_m, poses[1])
    found, wanted = placed(grid.map), placed(fresh.map)
    assert sum(found.get(cell) == v for cell, v in wanted.items()) > 0.95 * len(wanted)


def test_places_beyond_the_extent_are_left_out() -> None:
    """A sub-map that is not joined yet is a kilometre away."""
    grid = mapper(GridConfig(extent_m=5.0))
    grid.insert(depth_of(HERE, WALL), HERE)
    size = grid.map.cells.shape
    away = camera_at(1000.0, 0.0, 0.6)
    grid.insert(depth_of(HERE, WALL), away)
    assert grid.map.cells.shape == size
    edge = camera_at(1.5, 0.0, 0.6)
    grid.insert(depth_of(HERE, WALL), edge)
    rows, columns = grid.map.cells.shape
    assert max(rows, columns) <= 100
    assert value(grid.map, 2.4, 0.01) == FREE


def test_images_without_depth_or_with_wrong_numbers_tell_nothing() -> None:
    """NaN, infinite and negative depths are no surface."""
    grid = mapper()
    depth_m: NDArray[np.float32] = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    grid.insert(depth_m, HERE)
    for bad in (np.nan, np.inf, -1.0):
        grid.insert(np.full_like(depth_m, bad), HERE)
    assert not placed(grid.map)
    assert grid.revision == 0


def test_isolated_pixels_are_no_obstacle() -> None:
    """A wrong match before a wall is one point where a surface would give a dozen."""
    grid = mapper()
    depth_m = depth_of(HERE, WALL)
    depth_m[::12, ::12] = 0.7
    grid.insert(depth_m, HERE)
    found = grid.map.cells[:, : round((0.9 - grid.map.origin_m[0]) / 0.05)]
    assert not (found == OCCUPIED).any()


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'min_height_m': 1.0, 'max_height_m': 1.0}, 'max_height_m is 1, not above'),
        ({'self_box': '0 0 0 1 1'}, 'six numbers'),
        ({'self_box': '0 0 0 1 1 -1'}, 'six numbers'),
        ({'self_box': 'a box'}, 'six numbers'),
        ({'resolution_m': 0.0}, 'resolution_m is 0'),
    ],
)
def test_unusable_settings_are_refused(changes: dict[str, object], words: str) -> None:
    """The error names the setting and what it should be."""
    with pytest.raises(ConfigError, match=words):
        GridConfig(**changes)  # type: ignore[arg-type]
