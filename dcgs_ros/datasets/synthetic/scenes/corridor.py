# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A corridor of 32 m with bare walls and some doors."""

from __future__ import annotations

import numpy as np

from ..motion.route import GAITS, Route
from .builder import SceneBuilder
from .scenario import Scenario

_LENGTH_M, _HALF_WIDTH_M = 32.0, 1.0
_ASIDE_M = 0.3  # of the route from the middle: on the right, there and back


def corridor(rng: np.random.Generator, motion: str) -> Scenario:
    """Build it along x; the camera goes 30 m, turns round at the end, comes back."""
    build = SceneBuilder()
    middle = _LENGTH_M / 2 - 1
    half = (_LENGTH_M / 2, _HALF_WIDTH_M, 1.3)
    build.box((middle, 0, 1.3), half, 'plaster', 0.4, (0.95, 0.94, 0.9))
    build.box((middle, 0, 0.002), (*half[:2], 0.002), 'plaster', 0.3, (0.55, 0.58, 0.6))
    for side in (-1, 1):
        build.box((middle, side * 0.995, 0.05), (_LENGTH_M / 2, 0.005, 0.05), None, 1, (0.3,) * 3)
        for x in np.arange(2.0, 30.0, 5.0) + rng.uniform(-1.2, 1.2, 6):
            add_door(build, float(x), side * _HALF_WIDTH_M, -side)
    for x in np.arange(0.5, 31.0, 3.0):
        build.box((float(x), 0.0, 2.58), (0.3, 0.08, 0.015), None, 1, (1.3, 1.3, 1.25))
    for x in (-0.995, _LENGTH_M - 1.005):
        build.box((x, 0.0, 1.0), (0.005, 0.5, 1.0), 'wood', 0.5, (0.8, 0.75, 0.7))
    for x, side in ((8.3, 1), (21.0, -1)):  # a notice board on either wall
        y = side * (_HALF_WIDTH_M - 0.01)
        build.box((x + rng.uniform(-1, 1), y, 1.45), (0.4, 0.01, 0.3), 'print', 0.8)
    far = _LENGTH_M - 2
    y = _ASIDE_M
    corners = ((1, -y), (far, -y), (far, y), (0, y), (0, -y))
    scene = build.build((middle, 0.0, 2.4), 0.8)
    return Scenario(scene, Route(corners, GAITS[motion]), pattern=60.0)


def add_door(build: SceneBuilder, x: float, wall_y: float, inwards: int) -> None:
    """Add a closed door with its frame to a wall along x; `inwards` is the side of the room."""
    y = wall_y + 0.008 * inwards
    build.box((x, y, 1.0), (0.45, 0.008, 1.0), 'wood', 0.5, (0.85, 0.8, 0.72))
    build.box((x + 0.36, y + 0.03 * inwards, 1.02), (0.06, 0.02, 0.012), None, 1, (0.6,) * 3)
    frame = wall_y + 0.02 * inwards
    for side in (-1, 1):
        build.box((x + side * 0.49, frame, 1.02), (0.04, 0.02, 1.02), None, 1, (0.5, 0.52, 0.55))
    build.box((x, frame, 2.08), (0.53, 0.02, 0.04), None, 1, (0.5, 0.52, 0.55))
