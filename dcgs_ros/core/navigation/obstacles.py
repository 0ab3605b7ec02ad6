# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The Gaussians that stand in the way, thinned to a point for each voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..config.navigation import GridConfig, ObstacleConfig


def obstacles(
    means: NDArray[np.float32],  # (3, N) metres, map
    opacity_logits: NDArray[np.float32],  # (N,)
    T_map_cam: NDArray[np.float64] | None,  # (4, 4) camera that the range is about; None: all
    T_map_base: NDArray[np.float64] | None,  # (4, 4) of the robot's own box; None: not known
    grid: GridConfig,
    config: ObstacleConfig,
) -> NDArray[np.float32]:
    """Return the opaque Gaussians (M, 3), metres, in the grid's height band and in range.

    Those in the robot's own box are left out. Of each voxel the first Gaussian stays.
    """
    least = np.log(config.opacity) - np.log1p(-config.opacity)
    band = (means[2] >= grid.min_height_m) & (means[2] <= grid.max_height_m)
    points = means[:, band & (opacity_logits >= least)].T
    if T_map_cam is not None:
        away = np.linalg.norm(points[:, :2] - T_map_cam[:2, 3], axis=1)
        points = points[away <= config.range_m]
    if T_map_base is not None and grid.box is not None:
        offsets = se3.transform(se3.inverse(T_map_base), points)
        inside = (offsets > grid.box[0]) & (offsets < grid.box[1])
        points = points[~inside.all(axis=1)]
    cells = np.floor(points / config.voxel_m).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return np.ascontiguousarray(points[np.sort(first)])
