# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Exact depth images of boxes on a floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.sensor import SensorNoise

CAMERA = PinholeCamera(160, 120, 110.0, 110.0, 79.5, 59.5)
EXACT = SensorNoise.floor()
WALL = ((2.0, -3.0, 0.0), (2.2, 3.0, 2.5))
Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # least, greatest corner


def camera_at(x: float, y: float, z: float, yaw: float = 0.0) -> NDArray[np.float64]:
    """Return T_map_cam (4, 4) of a level camera, metres; at yaw 0 it looks along x."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64)
    T = se3.exp(np.array([0, 0, 0, 0, 0, yaw])) @ T
    T[:3, 3] = x, y, z
    return T


def depth_of(
    T_map_cam: NDArray[np.float64], *boxes: Box, floor: bool = True
) -> NDArray[np.float32]:
    """Return depth (H, W), metres, of boxes, and of a floor at z = 0; 0 where nothing is."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1
    )
    rays, start = rays @ T_map_cam[:3, :3].T + 1e-12, T_map_cam[:3, 3]
    ground = np.where(rays[..., 2] < 0, -start[2] / rays[..., 2], np.inf)
    nearest = ground if floor else np.full(u.shape, np.inf)
    for low, high in boxes:
        sides = (np.array([low, high]) - start)[:, None, None] / rays
        enters, leaves = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
        hit = (enters < leaves) & (enters > 0)
        nearest = np.where(hit, np.minimum(nearest, enters), nearest)
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)
