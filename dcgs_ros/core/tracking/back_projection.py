# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Where corners of the colour image are in space, by the depth image of another instant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..kernels.jit import kernel
from ..sensor import SensorNoise

NEAREST_M = 0.05  # nearer points have no meaningful projection
_FLAT_SLOPE = 0.03  # largest depth range of 3x3 pixels on one surface, share of depth ...
_FLAT_NOISE = 8.0  # ... plus this many sigma_z
_MIN_NEIGHBOURS = 6  # with depth, of the 3x3 pixels


def back_projected(
    pixels: NDArray[np.float32],  # (L, 2)
    expected_m: NDArray[np.floating],  # (L,) expected depth
    depth_m: NDArray[np.float32],  # (H, W)
    T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
    twist: NDArray[np.float64],  # (6,) per second
    camera: PinholeCamera,
    sensor: SensorNoise,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return depths (L,) and rays (L, 3), z = 1, of corners at colour's instant; 0: no depth.

    Colour's instant is that of its middle row. With a rolling shutter, a row that is exposed dt
    later sees a point from exp(dt twist), which moves its ray.

    The depth image was taken at another instant: a corner's depth is looked up where the camera's
    motion puts its point at that instant, and the motion along the axis is added.
    """
    rays = np.empty((len(pixels), 3), np.float32)
    then = np.empty((len(pixels), 3))
    motion = 1e-3 * sensor.color_readout_ms * twist
    _place(
        camera.undistort(pixels), (pixels[:, 1] + 0.5) / camera.height - 0.5, expected_m, motion,
        se3.inverse(T_cam_cam_at_depth), rays, then,
    )  # fmt: skip
    found = depth_at(depth_m, camera.project(then), sensor.a_m, sensor.b_per_m)
    depth = np.where(found > 0, found + expected_m - then[:, 2], 0.0)
    return depth.astype(np.float32), rays


def in_range(z: NDArray[np.float32], sensor: SensorNoise) -> NDArray[np.bool_]:
    """Return which depths (L,), metres, are where the sensor measures."""
    return (z > sensor.depth_min_m) & (z < sensor.depth_max_m)


@kernel
def _place(normalised, late, expected, motion, T, rays, then):
    """Write `rays` (L, 3), z = 1, and where their points are at depth's instant, `then` (L, 3).

    `normalised` (L, 2) x/z, y/z as the pixels see them, `late` (L,) shares of the readout after
    the middle row, `expected` (L,) metres, `motion` (6,) during the readout, `T` (4, 4) from the
    camera at colour's instant to that at depth's. `then` is NaN behind that camera.
    """
    for i in range(normalised.shape[0]):
        x, y, z = normalised[i, 0], normalised[i, 1], max(expected[i], NEAREST_M)
        p = x * z + late[i] * (motion[0] + motion[4] * z - motion[5] * y * z)
        q = y * z + late[i] * (motion[1] + motion[5] * x * z - motion[3] * z)
        r = z + late[i] * (motion[2] + motion[3] * y * z - motion[4] * x * z)
        rays[i, 0], rays[i, 1], rays[i, 2] = p / r, q / r, 1.0
        z = expected[i]
        for k in range(3):
            then[i, k] = z * (T[k, 0] * rays[i, 0] + T[k, 1] * rays[i, 1] + T[k, 2]) + T[k, 3]
        if not then[i, 2] > NEAREST_M:
            then[i] = np.nan


@kernel
def depth_at(depth, pixels, noise_a, noise_b):
    """Return (L,) float32, metres: the mean of the valid 3x3 depths at each pixel; 0 at an edge.

    `depth` (H, W) metres, `pixels` (L, 2) as x, y; `noise_a` in metres, `noise_b` in 1/metre.
    """
    height, width = depth.shape
    out = np.zeros(pixels.shape[0], np.float32)
    for i in range(pixels.shape[0]):
        u, v = pixels[i, 0], pixels[i, 1]
        if not (u >= 1.0 and v >= 1.0 and u < width - 2.0 and v < height - 2.0):
            continue
        x, y = int(u + 0.5), int(v + 0.5)
        nearest, farthest, total, n = np.inf, 0.0, 0.0, 0
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                z = depth[y + dy, x + dx]
                if 0.0 < z < np.inf:
                    total += z
                    n += 1
                    nearest, farthest = min(nearest, z), max(farthest, z)
        if n < _MIN_NEIGHBOURS:
            continue
        z = total / n
        if farthest - nearest <= _FLAT_SLOPE * z + _FLAT_NOISE * (noise_a + noise_b * z * z):
            out[i] = z
    return out
