# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A depth image as points, thinned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..sensor import SensorNoise

_ACROSS = 160  # points across the image, at most: at 4 m they are 3 cm apart


def depth_points(
    depth_m: NDArray[np.float32],  # (H, W)
    camera: PinholeCamera,
    sensor: SensorNoise,
    T_cam_cam_at_depth: NDArray[np.float64],  # (4, 4)
) -> NDArray[np.float32]:
    """Return points (N, 3), metres, of every n-th pixel, in the camera at the instant of colour.

    Only depth within the sensor's range counts.
    """
    step = max(1, -(-camera.width // _ACROSS))
    z, rays = depth_m[::step, ::step], camera.undistortion_map[::step, ::step]
    valid = (z >= sensor.depth_min_m) & (z <= sensor.depth_max_m)
    points = np.column_stack([rays[valid], np.ones(np.count_nonzero(valid))]) * z[valid][:, None]
    return se3.transform(T_cam_cam_at_depth, points).astype(np.float32)
