# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Scenes around a standing person: a furnished room, a textured plane, a folding screen."""

from __future__ import annotations

import numpy as np

from ..motion.hand_held import Motion, Sway, Turn
from ..motion.path import PITCH, ROLL, YAW, X, Y, Z
from ..motion.path import Motion as Moves
from ..motion.route import GAITS, Route
from ..motion.turning import OnTheSpot
from .builder import SceneBuilder, add_clutter, add_desk, add_monitor, add_walls
from .movers import MOVERS
from .scenario import Scenario

_MIDDLE = (-0.4, 0.1)
_ROUND_THE_ROOM = ((-1.4, -1.0), (0.6, -1.0), (0.6, 1.2), (-1.4, 1.2))


def room(rng: np.random.Generator, motion: str, mover: str | None = None) -> Scenario:
    """Build a study of 5.6 x 4.8 x 2.6 m.

    In the hand the camera stays in its middle, facing the desks; on wheels it goes round, or turns
    on the spot. `mover`, one of `MOVERS`, comes in front of it.
    """
    build = SceneBuilder()
    add_walls(build)
    add_desk(build, rng, np.array([1.9, -1.75]), np.array([2.76, -0.05]), 0.74, 13)
    add_desk(build, rng, np.array([1.9, 0.05]), np.array([2.76, 1.75]), 0.72, 13)
    add_monitor(build, 2.5, -0.9 + rng.uniform(-0.1, 0.1), 0.74, 0.15)
    add_monitor(build, 2.5, 0.85 + rng.uniform(-0.1, 0.1), 0.72, -0.1)
    build.box((0.55, 2.2, 0.95), (0.75, 0.19, 0.95), 'books', 0.8)
    build.box((-1.2, 2.15, 0.4), (0.6, 0.24, 0.4), 'wood', 0.8, (0.9, 1.0, 1.0))
    add_clutter(build, rng, np.array([-1.7, 2.0]), np.array([-0.7, 2.3]), 0.8, 6)
    build.box((0.6, -2.1, 0.38), (0.9, 0.28, 0.38), 'wood', 0.8, (1.0, 0.85, 0.7))
    add_clutter(build, rng, np.array([-0.2, -2.25]), np.array([1.4, -1.95]), 0.76, 9)
    build.box((-2.45, -1.85, 0.9), (0.33, 0.5, 0.9), 'keys', 0.7, (0.8, 0.85, 1.0))
    for y in (-0.85, 0.95):  # chairs
        build.box((1.72, y, 0.44), (0.21, 0.21, 0.03), 'poster', 1.0, (0.7, 0.8, 1.0))
        build.box((1.72, y, 0.21), (0.03, 0.03, 0.21), None, 1, (0.25,) * 3)
        build.box((1.53, y, 0.7), (0.02, 0.2, 0.22), 'carpet', 1.2, (0.8, 0.6, 0.6))
    add_clutter(build, rng, np.array([0.9, -1.7]), np.array([1.5, 1.9]), 0.004, 8)
    build.box((0.5, 0.0, 2.52), (0.6, 0.15, 0.05), None, 1, (1.3, 1.3, 1.25))
    hand = Motion(
        centre=(0.35, 0.0, 1.28, 0.0, -17.0, 0.0),
        sways=(
            Sway(X, 0.45, 13.0), Sway(X, 0.14, 5.9, 1.0),
            Sway(Y, 0.6, 17.0, 0.4), Sway(Y, 0.18, 6.7),
            Sway(Z, 0.12, 8.3), Sway(Z, 0.05, 3.7, 2.0),
            Sway(YAW, 46.0, 19.0), Sway(YAW, 13.0, 7.3, 1.0),
            Sway(PITCH, 8.0, 6.1), Sway(ROLL, 6.0, 5.3),
        ),
        turns=(
            Turn(YAW, 3.0, 42.0, 0.85), Turn(YAW, 5.2, -42.0, 1.1),
            Turn(YAW, 9.5, -48.0, 0.95), Turn(YAW, 12.0, 48.0, 1.2),
            Turn(PITCH, 14.5, -12.0, 0.4), Turn(PITCH, 15.4, 12.0, 0.5),
            Turn(YAW, 18.0, 25.0, 0.5), Turn(YAW, 19.0, -25.0, 0.55),
        ),
    )  # fmt: skip
    moves: Moves = hand
    if motion != 'handheld':
        on_wheels = motion == 'wheeled'
        moves = Route(_ROUND_THE_ROOM, GAITS[motion]) if on_wheels else OnTheSpot(_MIDDLE)
    scene = build.build((0.5, 0.0, 2.3), 0.55)
    return Scenario(scene, moves, pattern=4.0, mover=MOVERS[mover] if mover else None)


def plane(rng: np.random.Generator) -> Scenario:
    """Build one textured plane: depth alone leaves three degrees of freedom unobserved."""
    build = SceneBuilder()
    build.box((0, 0, -0.01), (6, 6, 0.01), 'poster', 0.5)
    motion = Motion(
        centre=(0.0, 0.0, 0.95, 90.0, -72.0, 0.0),
        sways=(
            Sway(X, 0.95, 19.0), Sway(Y, 0.6, 11.0, 0.5), Sway(Z, 0.12, 6.0),
            Sway(YAW, 12.0, 7.0), Sway(PITCH, 6.0, 5.0), Sway(ROLL, 6.0, 6.1),
        ),
        turns=(Turn(YAW, 7.0, 14.0, 0.45), Turn(YAW, 8.0, -14.0, 0.45)),
        cycle_s=16.0,
    )  # fmt: skip
    return Scenario(build.build((0.0, 0.0, 3.0), 0.6), motion, pattern=4.0)


def zigzag(rng: np.random.Generator) -> Scenario:
    """Build a folding screen before a wall, without texture: only geometry constrains."""
    build = SceneBuilder()
    build.box((0, -2.3, 1.5), (5.0, 3.5, 1.5), None, 1, (0.62, 0.64, 0.62))
    build.box((0, -2.3, 0.002), (5.0, 3.5, 0.002), None, 1, (0.8, 0.8, 0.8))
    angle, width = np.deg2rad(35.0), 0.55
    step = width * np.cos(angle)
    for k in range(13):
        sign = 1 if k % 2 == 0 else -1
        centre = ((k - 6) * step, 0.5 * width * np.sin(angle), 0.75)
        build.box(centre, (width / 2, 0.01, 0.75), None, 1, (0.95, 0.95, 0.93), sign * angle)
    motion = Motion(
        centre=(0.0, -1.0, 0.85, 90.0, -22.0, 0.0),
        sways=(
            Sway(X, 0.95, 19.0), Sway(Y, 0.2, 7.0, 1.0), Sway(Z, 0.12, 5.0),
            Sway(YAW, 8.0, 5.2), Sway(PITCH, 4.0, 4.3), Sway(ROLL, 6.0, 6.0),
        ),
        turns=(Turn(YAW, 6.0, 22.0, 0.7), Turn(YAW, 7.2, -22.0, 0.7)),
        cycle_s=16.0,
    )  # fmt: skip
    return Scenario(build.build((-1.0, -2.0, 2.6), 0.5), motion, pattern=16.0)
