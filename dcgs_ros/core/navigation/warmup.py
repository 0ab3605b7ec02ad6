# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Compiles the grid's kernels, or loads them, before the first view has to wait for it."""

from __future__ import annotations

import numpy as np

from ..camera import PinholeCamera
from ..config.navigation import GridConfig
from ..sensor import SensorNoise
from .occupancy import OccupancyMapper


def warm_up_grid(config: GridConfig) -> None:
    """Insert a small view."""
    camera = PinholeCamera(16, 16, 16.0, 16.0, 8.0, 8.0)
    OccupancyMapper(camera, SensorNoise(), config).insert(np.ones((16, 16), np.float32), np.eye(4))
