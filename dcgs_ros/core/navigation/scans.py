# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What one depth image tells of free and occupied space, thinned to a point for each voxel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..config.navigation import GridConfig
from ..kernels.jit import kernel
from ..sensor import SensorNoise

_ACROSS = 160  # pixels that are looked at across the image
_MM = 1e-3  # unit of the points that are kept ...
_FAR_M = 30.0  # ... in 16 bits, which reach 32 m
_NEAR_M = 1.0  # that is looked at however rough depth is
_SUPPORT = 0.35  # share of a voxel's side that points must cover to be more than outliers
_NOISE = 0.5  # standard deviation of depth up to which it is used, in cells
_BITS = 20  # of a voxel's index along an axis


@dataclass(frozen=True)
class Scan:
    """The ends of rays from one camera, one for each voxel that they end in."""

    view: int  # its number, in the order of insertion
    T_map_cam: NDArray[np.float64]  # (4, 4)
    ends: NDArray[np.int16]  # (N, 3) millimetres, camera frame
    hits: NDArray[np.bool_]  # (N,) whether a surface is there; else the ray goes on

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        return self.ends.nbytes + self.hits.nbytes

    @property
    def points(self) -> NDArray[np.float32]:
        """(N, 3) the ends in the map, metres."""
        T = self.T_map_cam
        ends = self.ends.astype(np.float64) * _MM
        return (ends @ T[:3, :3].T + T[:3, 3]).astype(np.float32)

    def moved_to(self, T_map_cam: NDArray[np.float64]) -> Scan:
        """Return it from another pose (4, 4)."""
        return replace(self, T_map_cam=T_map_cam)


class Scanner:
    """Makes scans of the depth images of one camera without distortion."""

    def __init__(self, camera: PinholeCamera, sensor: SensorNoise, config: GridConfig) -> None:
        """Prepare the rays of every n-th pixel."""
        self._stride = max(1, round(camera.width / _ACROSS))
        self._camera, self._config = camera, config
        self._range_m = config.range_m or _range_m(sensor, _NOISE * config.resolution_m)
        self._box = config.box if config.box is not None else np.zeros((2, 3))

    def scan(
        self,
        view: int,
        depth_m: NDArray[np.float32],  # (H, W)
        T_map_cam: NDArray[np.float64],  # (4, 4)
        T_base_cam: NDArray[np.float64] | None,  # (4, 4); None: not known
    ) -> Scan:
        """Return a scan. Without the camera's place on the base the robot's box is not left out.

        A voxel with fewer points than a small part of a surface through it would give is left out.
        """
        c, config = self._camera, self._config
        box = self._box if T_base_cam is not None else np.zeros((2, 3))
        to_base = np.eye(4) if T_base_cam is None else T_base_cam
        intrinsics = np.array([c.fx, c.fy, c.cx, c.cy])
        points, keys = _ends(
            depth_m, intrinsics, self._stride, T_map_cam, to_base, box, self._range_m,
            config.resolution_m,
        )  # fmt: skip
        _, first, counts = np.unique(keys, return_index=True, return_counts=True)
        points, hits = points[first], keys[first] & 1 == 0
        spacing = np.maximum(points[:, 2], _MM) * self._stride / c.focal
        across = config.resolution_m / spacing  # points along a voxel's side
        keep = (counts >= np.square(_SUPPORT * across)) | ~hits
        ends = np.round(points[keep] / _MM).astype(np.int16)
        return Scan(view, T_map_cam.copy(), ends, hits[keep])


def _range_m(sensor: SensorNoise, sigma_m: float) -> float:
    """Return the distance up to which depth has no larger standard deviation, metres."""
    reach_m = math.inf
    if sensor.b_per_m > 0.0:
        reach_m = math.sqrt(max(sigma_m - sensor.a_m, 0.0) / sensor.b_per_m)
    return min(max(reach_m, _NEAR_M), sensor.depth_max_m, _FAR_M)


@kernel
def _ends(depth_m, intrinsics, stride, T_map_cam, T_base_cam, box, range_m, voxel_m):
    """Return the ends of rays (N, 3) float32, metres, camera frame, and their voxels (N,) int64.

    `depth_m` (H, W) metres, `intrinsics` (4,) fx fy cx cy, `box` (2, 3) in the base frame, of
    which nothing counts. Rays longer than `range_m` end there, and their voxel's number is odd.
    """
    height, width = depth_m.shape
    rows, columns = (height - 1) // stride + 1, (width - 1) // stride + 1
    points = np.empty((rows * columns, 3), np.float32)
    keys = np.empty(rows * columns, np.int64)
    half, n = 1 << (_BITS - 1), 0
    for v in range(0, height, stride):
        for u in range(0, width, stride):
            z = depth_m[v, u]
            if not 0.0 < z < np.inf:
                continue
            x = (u - intrinsics[2]) / intrinsics[0] * z
            y = (v - intrinsics[3]) / intrinsics[1] * z
            inside = True
            for k in range(3):
                b = T_base_cam[k, 0] * x + T_base_cam[k, 1] * y + T_base_cam[k, 2] * z
                b += T_base_cam[k, 3]
                inside &= box[0, k] < b < box[1, k]
            if inside:
                continue
            length = np.sqrt(x * x + y * y + z * z)
            beyond = length > range_m
            if beyond:
                share = range_m / length
                x, y, z = x * share, y * share, z * share
            key = 0
            for k in range(3):
                m = T_map_cam[k, 0] * x + T_map_cam[k, 1] * y + T_map_cam[k, 2] * z
                m += T_map_cam[k, 3]
                key = (key << _BITS) | (np.int64(np.floor(m / voxel_m)) + half)
            keys[n] = key << 1 | beyond
            points[n, 0], points[n, 1], points[n, 2] = x, y, z
            n += 1
    return points[:n], keys[:n]
