# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A depth image as points a_i with normals n_i and covariances D_i (paper, depth residual)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..config.stages import CloudConfig
from ..kernels.jit import kernel, parallel_kernel
from ..kernels.small_matrix import eigenvalues_symmetric, smallest_eigenvector
from ..sensor import SensorNoise

_MIN_SCATTER = 5  # fewest neighbours of which a scatter is computed
_SLOPE = 4.0  # largest depth change over the window within one surface, in window widths
_ROUGH_SIGMAS = 8.0  # ... plus this many sigma_z of noise
_SAMPLE, _FIT = 1, 2  # status of a cell with a depth / with a depth and a normal; 0: without


@dataclass(frozen=True)
class FrameCloud:
    """Sampled points of one depth image, in the camera frame at the depth's instant."""

    points: NDArray[np.float32]  # (N, 3) metres
    normals: NDArray[np.float32]  # (N, 3) unit, towards the camera
    flatness: NDArray[np.float32]  # (N,) lambda3 / lambda2 of the scatter Q_i
    samples: int  # cells with usable depth, normal or not

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    def __getitem__(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> FrameCloud:
        """Return the points of a mask or of indices; `samples` stays that of the whole image."""
        return FrameCloud(self.points[keep], self.normals[keep], self.flatness[keep], self.samples)

    def moved(self, T: NDArray[np.float64]) -> FrameCloud:
        """Return the cloud transformed by T (4, 4): to the colour's instant, for example."""
        R = T[:3, :3].astype(np.float32)
        points = self.points @ R.T + T[:3, 3].astype(np.float32)
        normals = np.ascontiguousarray(self.normals @ R.T)
        return FrameCloud(points, normals, self.flatness, self.samples)


def sample_cloud(
    depth_m: NDArray[np.float32],  # (H, W)
    rays: NDArray[np.float32],  # (H, W, 2) undistorted x/z, y/z
    config: CloudConfig,
    sensor: SensorNoise,
    stride_px: int,
    seed: int,
    twist: NDArray[np.float64],  # (6,) per second, of the camera, in its frame
) -> FrameCloud:
    """Return one point of each stride x stride cell, at a pixel that `seed` varies.

    Points are where they are at the instant of the middle row: with a rolling shutter, a row
    that is exposed dt later sees a point from exp(dt twist).

    n_i is the eigenvector of the smallest eigenvalue of Q_i, the scatter of the neighbours on the
    same surface. Cells at depth edges, with too few neighbours, or seen at a grazing angle give no
    point.
    """
    height, width = depth_m.shape
    cells = (height // stride_px) * (width // stride_px)
    points = np.empty((cells, 3), np.float32)
    normals = np.empty((cells, 3), np.float32)
    flatness = np.empty(cells, np.float32)
    status = np.zeros(cells, np.uint8)
    _sample(
        depth_m, rays, stride_px, config.dilation_px, config.half_window, config.min_neighbours,
        config.min_view_cosine, sensor.a_m, sensor.b_per_m, sensor.depth_min_m,
        sensor.depth_max_m, seed, 1e-3 * sensor.depth_readout_ms * twist, points, normals,
        flatness, status,
    )  # fmt: skip
    keep = np.flatnonzero(status == _FIT)
    return FrameCloud(points[keep], normals[keep], flatness[keep], int(np.count_nonzero(status)))


def measurement_covariances(
    points: NDArray[np.float32],  # (N, 3) metres, camera
    normals: NDArray[np.float32],  # (N, 3) unit, camera
    sensor: SensorNoise,
    footprint: float,
    radius_m: float,
) -> NDArray[np.float32]:
    """Return D_i = S(v_i, |a_i|; p_d) + r^2 (I - n_i n_i^T), square metres, camera frame.

    It is (N, 6): xx xy xz yy yz zz. `footprint` is p_d / f; r = `radius_m`, with 0 it is S alone.
    """
    out = np.empty((len(points), 6), np.float32)
    _covariances(points, normals, sensor.a_m, sensor.b_per_m, footprint, radius_m**2, out)
    return out


@parallel_kernel
def _sample(
    depth, rays, stride, dilation, half, min_share, min_cosine, noise_a, noise_b, z_min, z_max,
    seed, motion, points, normals, flatness, status,
):  # fmt: skip
    """Write a point, its normal and its flatness for each cell of a depth image.

    `depth` (H, W) metres, `rays` (H, W, 2) undistorted x/z and y/z; `stride` and `dilation` in
    pixels, noise and depth range in metres; `motion` (6,) the camera's between the instants of
    the first row and of the last one. Writes, for C = (H // stride) (W // stride) cells,
    `points` (C, 3) metres, `normals` (C, 3) unit, `flatness` (C,) float32 and `status` (C,) uint8;
    the first three only where `status` is _FIT. `status` starts as zeros.
    """
    height, width = depth.shape
    cells_y, cells_x = height // stride, width // stride
    # Every second neighbour, as on a chessboard: the same extent at half the cost.
    needed = max(_MIN_SCATTER, min_share * ((2 * half + 1) ** 2 // 2 + 1))
    for cell_y in prange(cells_y):
        for cell_x in range(cells_x):
            i = cell_y * cells_x + cell_x
            jitter = (i * 1103515245 + 12345 + seed * 7919) & 0x7FFFFFFF
            y = cell_y * stride + (jitter >> 8) % stride
            x = cell_x * stride + (jitter >> 16) % stride
            z = depth[y, x]
            if not (z >= z_min and z <= z_max):
                continue
            status[i] = _SAMPLE
            ax, ay = rays[y, x, 0] * z, rays[y, x, 1] * z
            pixel = rays[y, min(x + 1, width - 1), 0] - rays[y, max(x - 1, 0), 0]
            surface = _SLOPE * dilation * half * 0.5 * pixel * z
            surface += _ROUGH_SIGMAS * (noise_a + noise_b * z * z)
            n = 0
            sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
            for v in range(-half, half + 1):
                py = y + v * dilation
                if py < 0 or py >= height:
                    continue
                for u in range(-half + (half + v) % 2, half + 1, 2):
                    px = x + u * dilation
                    if px < 0 or px >= width:
                        continue
                    q = depth[py, px]
                    dz = q - z
                    if not (q > 0.0 and abs(dz) <= surface):
                        continue
                    dx = rays[py, px, 0] * q - ax
                    dy = rays[py, px, 1] * q - ay
                    n += 1
                    sx += dx
                    sy += dy
                    sz += dz
                    xx += dx * dx
                    xy += dx * dy
                    xz += dx * dz
                    yy += dy * dy
                    yz += dy * dz
                    zz += dz * dz
            if n < needed:
                continue
            m = 1.0 / n
            sx, sy, sz = sx * m, sy * m, sz * m
            xx, xy, xz = xx * m - sx * sx, xy * m - sx * sy, xz * m - sx * sz
            yy, yz, zz = yy * m - sy * sy, yz * m - sy * sz, zz * m - sz * sz
            _, middle, smallest = eigenvalues_symmetric(xx, xy, xz, yy, yz, zz)
            nx, ny, nz = smallest_eigenvector(xx, xy, xz, yy, yz, zz, smallest)
            cosine = (nx * ax + ny * ay + nz * z) / math.sqrt(ax * ax + ay * ay + z * z)
            if not abs(cosine) >= min_cosine:
                continue
            sign = -1.0 if cosine > 0.0 else 1.0
            nx, ny, nz = sign * nx, sign * ny, sign * nz
            late = (y + 0.5) / height - 0.5  # of the readout, after the middle row
            tx, ty, tz = motion[3], motion[4], motion[5]
            mx = motion[0] + ty * z - tz * ay
            my = motion[1] + tz * ax - tx * z
            mz = motion[2] + tx * ay - ty * ax
            points[i, 0], points[i, 1], points[i, 2] = (
                ax + late * mx,
                ay + late * my,
                z + late * mz,
            )
            # Rows are shifted against each other too, which tilts the surface.
            span = rays[height - 1, x, 1] - rays[0, x, 1]
            shear = (nx * mx + ny * my + nz * mz) / (span * z)
            fx = nx + late * (ty * nz - tz * ny)
            fy = ny + late * (tz * nx - tx * nz) - shear
            fz = nz + late * (tx * ny - ty * nx) + shear * ay / z
            s = 1.0 / math.sqrt(fx * fx + fy * fy + fz * fz)
            normals[i, 0], normals[i, 1], normals[i, 2] = s * fx, s * fy, s * fz
            flatness[i] = max(smallest, 0.0) / max(middle, 1e-12)
            status[i] = _FIT


@kernel
def _covariances(points, normals, noise_a, noise_b, footprint, radius2, out):
    """Write D_i into `out` (N, 6) float32, xx xy xz yy yz zz, square metres.

    `points` (N, 3) metres, `normals` (N, 3) unit, both in the camera frame; `noise_a` in metres,
    `noise_b` in 1/metre, `footprint` p_d / f, `radius2` in square metres.
    """
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        range2 = x * x + y * y + z * z
        perpendicular = footprint * footprint * range2
        along = ((noise_a + noise_b * range2) ** 2 - perpendicular) / range2
        iso = perpendicular + radius2
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        out[i, 0] = iso + along * x * x - radius2 * nx * nx
        out[i, 1] = along * x * y - radius2 * nx * ny
        out[i, 2] = along * x * z - radius2 * nx * nz
        out[i, 3] = iso + along * y * y - radius2 * ny * ny
        out[i, 4] = along * y * z - radius2 * ny * nz
        out[i, 5] = iso + along * z * z - radius2 * nz * nz
