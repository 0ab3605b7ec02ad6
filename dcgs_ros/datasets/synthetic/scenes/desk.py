# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A dim study: a cluttered desk, a tiled floor at its foot, a bare wall behind a board."""

from __future__ import annotations

import numpy as np

from ..motion.hand_held import Motion, Sway, Turn
from ..motion.path import PITCH, ROLL, YAW, X, Y, Z
from .builder import SceneBuilder, add_desk, add_monitor
from .scenario import Scenario

_TILE_REPEATS_PER_M = 1 / 0.6  # two tiles of 0.3 m


def desk(rng: np.random.Generator) -> Scenario:
    """Build the study; every 24 s the camera tilts to the floor, and later turns to the wall.

    After the tilt one plane is in view, with few and repeating corners. At the wall, which the
    desk's lamp hardly reaches, most of what has texture and depth is a near, flat board.
    """
    build = SceneBuilder()
    build.box((0.2, 0.0, 1.3), (2.4, 2.1, 1.3), 'plaster', 0.4, (0.9, 0.88, 0.84))
    build.box((0.2, 0.0, 0.002), (2.4, 2.1, 0.002), 'tiles', _TILE_REPEATS_PER_M)
    add_desk(build, rng, np.array([0.75, -1.1]), np.array([1.5, 0.9]), 0.73, 22)
    add_monitor(build, 1.3, -0.45 + rng.uniform(-0.1, 0.1), 0.73, 0.1)
    build.box((2.595, -0.5, 1.55), (0.005, 0.6, 0.4), 'poster', 0.9)
    build.box((1.9, -1.9, 0.9), (0.6, 0.19, 0.9), 'books', 0.8)
    board = rng.uniform(-0.05, 0.05)
    build.box((0.25 + board, 0.95, 0.72), (0.4, 0.012, 0.42), 'wood', 0.9, (0.7, 0.65, 0.6))
    build.box((0.25 + board, 0.97, 0.15), (0.03, 0.03, 0.15), None, 1, (0.3,) * 3)
    motion = Motion(
        centre=(0.0, 0.0, 1.24, -6.0, -27.0, 0.0),
        sways=(
            Sway(X, 0.08, 9.1), Sway(Y, 0.22, 11.3, 0.4), Sway(Y, 0.06, 4.7),
            Sway(Z, 0.06, 6.3), Sway(YAW, 12.0, 12.7), Sway(YAW, 5.0, 5.1, 1.0),
            Sway(PITCH, 4.0, 5.9), Sway(ROLL, 5.0, 6.7),
        ),
        turns=(
            Turn(PITCH, 6.0, -50.0, 0.65), Turn(PITCH, 8.8, 50.0, 0.75),
            Turn(YAW, 13.0, 100.0, 1.3), Turn(PITCH, 13.0, 12.0, 1.3),
            Turn(YAW, 18.5, -100.0, 1.3), Turn(PITCH, 18.5, -12.0, 1.3),
        ),
    )  # fmt: skip
    return Scenario(build.build((1.3, -0.9, 1.9), 0.11), motion, pattern=14.0)
