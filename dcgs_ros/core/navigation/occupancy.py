# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""An occupancy grid of the floor from depth images at known poses, for planners.

Evidence is kept in voxels, so that a ray that passes over a low box does not clear it, and a cell
is what its column tells. Each view is kept as a thin scan: where poses are corrected, the grid is
built again from these, in the order in which they were taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..config.navigation import GridConfig
from ..sensor import SensorNoise
from .scans import Scan, Scanner
from .voxels import UNKNOWN, UNSEEN, add_rays, project

_LAYER_M = 0.1  # height of the voxels
_LOW_M = 0.7  # height of the column that must be seen empty: the top of a desk may be hidden
_BLOCK = 64  # cells by which the grid grows
_PLACE_M, _HEADINGS = 0.25, 24  # views from one place: position, directions of a full turn
_SIGMAS = 2.0  # of depth before the end of a ray that it does not clear
_MOVED = 2e-3  # largest element of a motion, metres or rad, that leaves the grid as it is


@dataclass(frozen=True)
class OccupancyMap:
    """Cells as nav_msgs/OccupancyGrid has them: 0 free, 100 occupied, -1 unknown."""

    cells: NDArray[np.int8]  # (H, W), rows along y
    origin_m: tuple[float, float]  # x y of the first cell's corner in the map
    resolution_m: float


class _Columns:
    """Evidence in columns of voxels over a rectangle that grows, and the cells it makes."""

    def __init__(self, config: GridConfig, sensor: SensorNoise) -> None:
        self._config, self._sensor = config, sensor
        band = config.max_height_m - config.min_height_m
        self._layers = max(1, math.ceil(band / _LAYER_M - 1e-9))
        self._layer_m = band / self._layers
        self._low = min(self._layers, max(1, round(_LOW_M / self._layer_m)))
        self.corner = np.zeros(2, np.int64)  # x y of the first cell, in cells from the origin
        self._evidence = np.empty((0, 0, self._layers), np.int8)
        self.cells = np.empty((0, 0), np.int8)

    def add(self, scan: Scan) -> NDArray[np.int64]:
        """Add a scan; return the range of cells (4,) x0 x1 y0 y1 that changed; empty: x0 = x1."""
        config = self._config
        ends, camera = scan.points, scan.T_map_cam[:3, 3]
        lengths = np.maximum(np.linalg.norm(ends - camera, axis=1), 1e-3)
        clear = 1.0 - np.where(scan.hits, _SIGMAS * self._sensor.sigma(lengths), 0.0) / lengths
        self._reach(np.vstack([ends[:, :2], camera[None, :2]]))
        bounds = add_rays(
            self._evidence, self.corner, camera, ends, scan.hits, clear, config.min_height_m,
            self._layer_m, config.resolution_m,
        )  # fmt: skip
        changed: NDArray[np.int64] = project(self._evidence, self.cells, bounds, self._low)
        return changed

    def _reach(self, points: NDArray[np.float64]) -> None:
        """Grow over points (N, 2), metres, as far as the grid may."""
        cell_m = self._config.resolution_m
        most = math.ceil(0.5 * self._config.extent_m / cell_m)
        wanted = np.stack([points.min(axis=0), points.max(axis=0)]) / cell_m
        if (wanted[1] < -most).any() or (wanted[0] > most).any():
            return  # elsewhere, such as in a sub-map that is not joined yet
        low = np.floor(wanted[0] / _BLOCK).astype(np.int64) * _BLOCK
        high = (np.floor(wanted[1] / _BLOCK).astype(np.int64) + 1) * _BLOCK
        before = np.array(self.cells.shape[::-1])
        if before.all():
            low, high = np.minimum(low, self.corner), np.maximum(high, self.corner + before)
        low, high = np.maximum(low, -most), np.minimum(high, most)
        size = high - low
        if (size == before).all():
            return
        evidence = np.full((size[1], size[0], self._layers), UNSEEN, np.int8)
        cells = np.full((size[1], size[0]), UNKNOWN, np.int8)
        if before.all():
            x, y = self.corner - low
            part = slice(y, y + before[1]), slice(x, x + before[0])
            evidence[part], cells[part] = self._evidence, self.cells
        self.corner, self._evidence, self.cells = low, evidence, cells


class OccupancyMapper:
    """The grid of one map.

    `insert` each view, `move` them when poses are corrected, then `work` until it returns False.
    """

    def __init__(self, camera: PinholeCamera, sensor: SensorNoise, config: GridConfig) -> None:
        """Start with nothing seen; `camera` is that of depth images without distortion."""
        self._config, self._sensor = config, sensor
        self._scanner = Scanner(camera, sensor, config)
        self._columns = _Columns(config, sensor)
        self._again: _Columns | None = None  # while the grid is built again ...
        self._done = 0  # ... scans that are in it
        self._scans: list[Scan] = []
        self._bytes = 0
        self.views = 0  # inserted so far
        self.revision = 0  # rises where cells change

    def insert(
        self,
        depth_m: NDArray[np.float32],  # (H, W)
        T_map_cam: NDArray[np.float64],  # (4, 4)
        T_base_cam: NDArray[np.float64] | None = None,  # (4, 4), for `self_box`
    ) -> None:
        """Take a view. While the grid is built again, it enters with the others."""
        scan = self._scanner.scan(self.views, depth_m, T_map_cam, T_base_cam)
        self.views += 1
        self._scans.append(scan)
        self._bytes += scan.bytes
        if self._again is None:
            changed = self._columns.add(scan)
            self.revision += bool(changed[0] < changed[1])
            if self._bytes > 1e6 * self._config.memory_mb:
                self._thin()

    def move(self, T_map_cam: NDArray[np.float64]) -> bool:
        """Take the poses (K, 4, 4) of all views so far; return whether `work` is to be done."""
        moved = [scan.moved_to(T_map_cam[scan.view]) for scan in self._scans]
        apart = max(
            (
                float(np.abs(new.T_map_cam - old.T_map_cam).max())
                for new, old in zip(moved, self._scans, strict=True)
            ),
            default=0.0,
        )
        if apart > _MOVED:
            self._scans = moved
            self._again, self._done = _Columns(self._config, self._sensor), 0
        return self._again is not None

    def work(self, scans: int = 20) -> bool:
        """Build the grid again, by so many scans; return whether that goes on.

        Until it is complete, `map` is what it was before.
        """
        again = self._again
        if again is None:
            return False
        for scan in self._scans[self._done : self._done + scans]:
            again.add(scan)
        self._done += scans
        if self._done < len(self._scans):
            return True
        self._columns, self._again = again, None
        self.revision += 1
        self._thin()
        return False

    @property
    def map(self) -> OccupancyMap:
        """The grid as it is now; it is written on."""
        x, y = (self._columns.corner * self._config.resolution_m).tolist()
        return OccupancyMap(self._columns.cells, (x, y), self._config.resolution_m)

    @property
    def bytes(self) -> int:
        """Memory that the scans take."""
        return self._bytes

    def _thin(self) -> None:
        """Keep the newest scan of each place and direction; if that is too much, every second."""
        limit = 1e6 * self._config.memory_mb
        if self._bytes <= limit:
            return
        newest = {_place(scan): scan for scan in self._scans}
        kept = sorted(newest.values(), key=lambda scan: scan.view)
        if sum(scan.bytes for scan in kept) > 0.5 * limit:
            kept = kept[-1::-2][::-1]
        self._scans, self._bytes = kept, sum(scan.bytes for scan in kept)


def _place(scan: Scan) -> tuple[int, int, int]:
    """Return where a scan was taken, and in which direction, both coarsely."""
    T = scan.T_map_cam
    heading = math.atan2(T[1, 2], T[0, 2]) / (2 * math.pi) * _HEADINGS
    x, y = np.floor(T[:2, 3] / _PLACE_M).astype(int).tolist()
    return x, y, round(heading) % _HEADINGS
