# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Publishes what a planner needs of the map: the occupancy grid, and obstacles as points."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from ...core import se3
from ...core.config.nodes import MapperNodeSettings, MapperSettings
from ...core.mapping.mapper import Mapper
from ...core.navigation.obstacles import obstacles
from ...core.navigation.occupancy import OccupancyMapper
from ...core.navigation.warmup import warm_up_grid
from ..messages.clouds import point_rows, write_cloud
from ..messages.grids import write_grid
from ..messages.images import header
from ..tracking.extrinsics import given_extrinsics, known_extrinsics
from ..transforms import make_transforms
from ..transport import RELIABLE, latched

_VIEWS = 4  # of a map that was loaded, taken at a time: a view of those takes 10 ms


@dataclass(frozen=True)
class Seen:
    """Where and when the map is seen from."""

    world: str  # frame of the map
    stamp_ns: int
    camera_frame: str
    T_map_cam: NDArray[np.float64] | None  # (4, 4) latest; None: not known


class Navigation:
    """The grid of the map of now, which follows the mapper's views; one thread's."""

    def __init__(self, node: Node, settings: MapperSettings) -> None:
        """Advertise the topics; raises `ConfigError` where `base_to_camera` is unusable.

        The grid has the profile of nav2's maps: reliable, and late subscribers get the last one.
        """
        self._settings = settings
        self._mounting = _Mounting(node, settings.node, wanted=settings.grid.box is not None)
        self._grids = node.create_publisher(OccupancyGrid, 'grid', latched(1))
        self._points = node.create_publisher(PointCloud2, 'obstacles', RELIABLE)
        self._mapper: Mapper | None = None  # whose map the grid is of
        self._grid: OccupancyMapper | None = None
        self._published: tuple[object, ...] = ()
        self._grid_s = self._points_s = time.monotonic()

    def warm_up(self) -> None:
        """Load the kernels."""
        warm_up_grid(self._settings.grid)

    def follow(self, mapper: Mapper | None, camera_frame: str) -> bool:
        """Take the views that are new; return whether more is to be done."""
        if mapper is not self._mapper:
            self._mapper, self._grid = mapper, None
        if self._settings.node.grid_rate_hz <= 0 or mapper is None:
            return False
        if self._grid is None:
            self._grid = OccupancyMapper(mapper.camera, mapper.config.sensor, self._settings.grid)
        grid, views = self._grid, mapper.views
        T_base_cam = self._mounting.find(camera_frame)
        for view in views[grid.views : grid.views + _VIEWS]:
            grid.insert(view.depth_m, view.T_tracked, T_base_cam)
        return grid.work() or grid.views < len(views)

    def correct(self) -> None:
        """Move the views to where the mapper has them by now."""
        if self._grid is not None and self._mapper is not None and self._grid.views:
            views = self._mapper.views[: self._grid.views]
            self._grid.move(np.array([view.T_tracked for view in views]))

    def publish_when_due(self, seen: Seen) -> None:
        """Publish the grid where it has changed, and obstacles if subscribed to."""
        settings, now = self._settings.node, time.monotonic()
        if self._grid is not None and now >= self._grid_s:
            state = (self._grid, self._grid.revision, seen.world)
            if state != self._published:
                self._grid_s = now + 1.0 / settings.grid_rate_hz
                in_map = header(seen.stamp_ns, seen.world)
                self._grids.publish(write_grid(self._grid.map, in_map))
                self._published = state
        rate_hz = settings.obstacles_rate_hz
        if rate_hz > 0 and now >= self._points_s and self._points.get_subscription_count():
            self._points_s = now + 1.0 / rate_hz
            self._publish_obstacles(seen)

    def _publish_obstacles(self, seen: Seen) -> None:
        if self._mapper is None:
            return
        splats, T_map_cam = self._mapper.table.splats, seen.T_map_cam
        T_base_cam, T_map_base = self._mounting.find(seen.camera_frame), None
        if T_map_cam is not None and T_base_cam is not None:
            T_map_base = T_map_cam @ se3.inverse(T_base_cam)
        points = obstacles(
            splats.means, splats.opacity_logits, T_map_cam, T_map_base, self._settings.grid,
            self._settings.obstacles,
        )  # fmt: skip
        rows = point_rows(points)
        self._points.publish(write_cloud(rows, header(seen.stamp_ns, seen.world)))


class _Mounting:
    """Where the camera is on the base, if somebody wants to know."""

    def __init__(self, node: Node, settings: MapperNodeSettings, wanted: bool) -> None:
        given_extrinsics(settings)  # raises now rather than later
        self._settings = settings
        self._found: NDArray[np.float64] | None = None
        self._transforms = make_transforms(node) if wanted else None

    def find(self, camera_frame: str) -> NDArray[np.float64] | None:
        """Return T_base_cam (4, 4); None where it is not known, or nobody wants to know."""
        if self._found is None and self._transforms is not None and camera_frame:
            self._found = known_extrinsics(self._settings, self._transforms, camera_frame)
        return self._found
