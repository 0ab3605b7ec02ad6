# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What cameras of any lens see of one plane with a smooth texture."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core.lens_camera import Camera

_NORMAL, _OFFSET_M = np.array([0.4, -0.2, 1.0]), 2.0
_ITERATED_PX = 1e-3


@cache
def rays_of(camera: Camera) -> NDArray[np.float64]:
    """Return x/z, y/z (H, W, 2), by iteration."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    off = np.ones(1)
    while np.abs(off).max() > _ITERATED_PX:
        off = pixels - camera.project(np.column_stack([rays, np.ones(len(rays))]))
        rays += off / (camera.fx, camera.fy)
    return rays.reshape(camera.height, camera.width, 2)


def plane_m(camera: Camera) -> NDArray[np.float32]:
    """Return depth (H, W), metres."""
    return (_OFFSET_M / (rays_of(camera) @ _NORMAL[:2] + _NORMAL[2])).astype(np.float32)


def texture(camera: Camera) -> NDArray[np.uint8]:
    """Return colour (H, W, 3), waves of the ray's direction."""
    x, y = np.moveaxis(rays_of(camera), -1, 0)
    waves = [np.sin(6 * x), np.sin(6 * y), np.cos(4 * x + 4 * y)]
    return np.rint(128 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)
