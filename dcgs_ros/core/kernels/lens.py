# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Brown-Conrady distortion as OpenCV defines it.

`camera` is `PinholeCamera.parameters`, (12,) float64: fx fy cx cy in pixels, then
k1 k2 p1 p2 k3 k4 k5 k6.
"""

from __future__ import annotations

import numpy as np

from .jit import inlined, kernel

_STEPS = 30  # each at least halves the error; the corner of a wide-angle image needs about 20


def _distortion_at(camera, x, y):
    """Return the radial factor and the tangential shift: x_d = x radial + shift_x.

    `camera` (12,); x and y are undistorted normalised coordinates x/z, y/z.
    """
    p1, p2 = camera[6], camera[7]
    r2 = x * x + y * y
    radial = (1.0 + r2 * (camera[4] + r2 * (camera[5] + r2 * camera[8]))) / (
        1.0 + r2 * (camera[9] + r2 * (camera[10] + r2 * camera[11]))
    )
    shift_x = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    shift_y = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return radial, shift_x, shift_y


distortion_at = inlined(_distortion_at)


def inversion_errors(camera, pixels):
    """Return how far (N,) pixels (N, 2) are off once they are undistorted and distorted again.

    `camera` (12,). Without a kernel, whose loading would take longer than this.
    """
    targets = ((pixels - camera[2:4]) / camera[:2]).T
    x, y = targets
    with np.errstate(all='ignore'):  # what cannot be inverted may go anywhere
        for _ in range(_STEPS):
            radial, shift_x, shift_y = _distortion_at(camera, x, y)
            x, y = (targets[0] - shift_x) / radial, (targets[1] - shift_y) / radial
        radial, shift_x, shift_y = _distortion_at(camera, x, y)
        off = np.stack([x * radial + shift_x, y * radial + shift_y]) - targets
        errors = np.hypot(*(off.T * camera[:2]).T)
    return np.where(np.isfinite(errors), errors, np.inf)


@kernel
def project(camera, points):
    """Return distorted pixels (N, 2) float32 of points (N, 3) with z > 0 in the camera frame.

    `camera` (12,); points may be in metres or normalised.
    """
    pixels = np.empty((points.shape[0], 2), np.float32)
    for i in range(points.shape[0]):
        x, y = points[i, 0] / points[i, 2], points[i, 1] / points[i, 2]
        radial, shift_x, shift_y = distortion_at(camera, x, y)
        pixels[i, 0] = camera[0] * (x * radial + shift_x) + camera[2]
        pixels[i, 1] = camera[1] * (y * radial + shift_y) + camera[3]
    return pixels


@kernel
def undistort(camera, pixels):
    """Return undistorted x/z, y/z (N, 2) float32 of distorted pixels (N, 2).

    `camera` (12,). Solved by fixed-point iteration.
    """
    rays = np.empty((pixels.shape[0], 2), np.float32)
    for i in range(pixels.shape[0]):
        target_x = (pixels[i, 0] - camera[2]) / camera[0]
        target_y = (pixels[i, 1] - camera[3]) / camera[1]
        x, y = target_x, target_y
        for _ in range(_STEPS):
            radial, shift_x, shift_y = distortion_at(camera, x, y)
            next_x, next_y = (target_x - shift_x) / radial, (target_y - shift_y) / radial
            change = abs(next_x - x) + abs(next_y - y)
            x, y = next_x, next_y
            if change < 1e-9:
                break
        rays[i, 0], rays[i, 1] = x, y
    return rays
