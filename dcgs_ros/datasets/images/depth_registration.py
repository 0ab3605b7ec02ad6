# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Registering depth to the colour camera's image."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.errors import FrameError
from ...core.kernels.jit import strict_kernel
from ...core.kernels.lens import distortion_at

_MAX_FOOTPRINT_PX = 16  # a side; a larger footprint is too close to the colour camera to be real
# The disparity of neighbours on a slanted surface differs, which tears gaps between them; this
# closes the gaps. Below half a pixel it does not change an image under the identity.
_SLACK_PX = 0.25


def register_depth(
    depth_m: NDArray[np.float32],
    depth_camera: PinholeCamera,
    T_colorcam_depthcam: NDArray[np.float64],
    color_camera: PinholeCamera,
) -> NDArray[np.float32]:
    """Draw depth (h, w) in metres into the colour camera's image (H, W); 0 = no measurement.

    `T_colorcam_depthcam` (4, 4) maps points of the depth camera's frame to the colour camera's.
    Each depth pixel is drawn as the box around its projected corners, a quarter of a pixel larger;
    the nearest wins. The result is depth along the colour camera's axis; values that are not
    positive and finite count as no measurement. Raises `FrameError` for an image of another size.
    """
    if depth_m.shape != (depth_camera.height, depth_camera.width):
        raise FrameError(
            f'depth is {depth_m.shape[1]}x{depth_m.shape[0]} pixels, its camera has '
            f'{depth_camera.width}x{depth_camera.height}'
        )
    out = np.zeros((color_camera.height, color_camera.width), np.float32)
    _draw(
        np.ascontiguousarray(depth_m, np.float32),
        depth_camera.undistortion_map,
        _corners(depth_camera),
        np.ascontiguousarray(T_colorcam_depthcam, np.float64),
        color_camera.parameters,
        _field_of_view(color_camera),
        out,
    )
    return out


@lru_cache(maxsize=4)
def _corners(camera: PinholeCamera) -> NDArray[np.float32]:
    """Return the rays (h + 1, w + 1, 2), x/z and y/z, through the corners of the pixels."""
    u, v = np.meshgrid(np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5)
    rays = camera.undistort(np.stack([u, v], axis=-1).reshape(-1, 2))
    return rays.reshape(camera.height + 1, camera.width + 1, 2)


@lru_cache(maxsize=4)
def _field_of_view(camera: PinholeCamera) -> NDArray[np.float64]:
    """Return the smallest and largest x/z, smallest and largest y/z in the image, (4,).

    Far outside of it the distortion's polynomial may map back into the image.
    """
    u, v = np.arange(-1.0, camera.width + 1), np.arange(-1.0, camera.height + 1)
    border = [(x, y) for x in u for y in v[[0, -1]]] + [(x, y) for x in u[[0, -1]] for y in v]
    x, y = camera.undistort(np.array(border)).T
    return np.array([x.min(), x.max(), y.min(), y.max()], np.float64)


@strict_kernel
def _draw(depth_m, rays, corners, T, camera, seen, out):
    """Draw each pixel's footprint into `out` (H, W), metres; of overlapping ones the nearest.

    `depth_m` (h, w) in metres; `rays` (h, w, 2) and `corners` (h + 1, w + 1, 2) are x/z and y/z;
    `T` (4, 4) is T_colorcam_depthcam, `camera` the colour camera's `parameters`, `seen` (4,) its
    `_field_of_view`. `out` is zeros at first.
    """
    height, width = out.shape
    for row in range(depth_m.shape[0]):
        for column in range(depth_m.shape[1]):
            z = np.float64(depth_m[row, column])
            if not 0.0 < z < np.inf:
                continue
            x, y = z * rays[row, column, 0], z * rays[row, column, 1]
            depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            x_color = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            y_color = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            drawn = np.float32(depth)
            if not 0.0 < drawn < np.inf:
                continue
            x_color, y_color = x_color / depth, y_color / depth
            if not (seen[0] <= x_color <= seen[1] and seen[2] <= y_color <= seen[3]):
                continue
            left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
            in_front = True
            for corner in range(4):
                ray = corners[row + corner // 2, column + corner % 2]
                x, y = z * ray[0], z * ray[1]
                depth = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
                in_front = in_front and depth > 0.0
                x_color = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / depth
                y_color = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / depth
                radial, shift_x, shift_y = distortion_at(camera, x_color, y_color)
                u = camera[0] * (x_color * radial + shift_x) + camera[2]
                v = camera[1] * (y_color * radial + shift_y) + camera[3]
                left, right = min(left, u), max(right, u)
                top, bottom = min(top, v), max(bottom, v)
            size = max(right - left, bottom - top)
            if not (in_front and size <= _MAX_FOOTPRINT_PX):
                continue
            first = int(max(0.0, np.ceil(left - _SLACK_PX)))
            last = int(min(width - 1.0, np.ceil(right + _SLACK_PX) - 1.0))
            for v in range(
                int(max(0.0, np.ceil(top - _SLACK_PX))),
                int(min(height - 1.0, np.ceil(bottom + _SLACK_PX) - 1.0)) + 1,
            ):
                for u in range(first, last + 1):
                    if out[v, u] == 0.0 or drawn < out[v, u]:
                        out[v, u] = drawn
