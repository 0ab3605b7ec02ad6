# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A loop of 55 m through two corridors and four rooms."""

from __future__ import annotations

import numpy as np

from ..motion.errand import Errand
from ..motion.route import GAITS, Route
from .builder import SceneBuilder, add_clutter, add_desk, add_monitor
from .corridor import add_door
from .scenario import Scenario

_HALF_X_M, _HALF_Y_M = 11.0, 6.2  # of the building
_CORE_X_M, _CORE_Y_M = 6.5, 3.8  # of the closed block in its middle
_ROUTE_X_M, _ROUTE_Y_M = 8.85, 5.0
_DOORWAY_M = 0.65  # half width
_PATCH_M = 2.0
_HEIGHT_M = 1.3  # half of the walls'


def ring(rng: np.random.Generator, motion: str, period: float, direction: str) -> Scenario:
    """Build a block with a corridor along its long sides and two rooms at either end.

    The floor repeats itself after `period` metres, or with 0 never. The route begins in the south
    corridor; `direction` is ccw or cw as seen from above.
    """
    build = SceneBuilder()
    build.box(
        (0, 0, _HEIGHT_M), (_HALF_X_M, _HALF_Y_M, _HEIGHT_M), 'plaster', 0.4, (1.0, 0.97, 0.9)
    )
    _add_floor(build, rng, period)
    build.box((0, 0, _HEIGHT_M), (_CORE_X_M, _CORE_Y_M, _HEIGHT_M), 'plaster', 0.4)
    for side in (-1, 1):
        for y in (-_ROUTE_Y_M, _ROUTE_Y_M):
            _add_doorway(build, side * _CORE_X_M, y)
        wall_x = (_HALF_X_M - _ROUTE_X_M, _ROUTE_X_M - _CORE_X_M)
        for sign, width in zip((1, -1), wall_x, strict=True):
            half = (width - _DOORWAY_M) / 2
            x = side * (_ROUTE_X_M + sign * (_DOORWAY_M + half))
            build.box((x, 0, _HEIGHT_M), (half, 0.06, _HEIGHT_M), 'plaster', 0.4)
    _furnish_corridors(build, rng)
    for side in (-1, 1):
        for end in (-1, 1):
            _furnish_room(build, rng, side, end)
    x, y = _ROUTE_X_M, _ROUTE_Y_M
    corners = ((-4.0, -y), (x, -y), (x, y), (-x, y), (-x, -y))
    if direction == 'cw':
        corners = (corners[0], *reversed(corners[1:]))
    scene = build.build((0.0, -5.0, 2.4), 0.75)
    errand = motion == 'errand'
    return Scenario(scene, Errand(corners) if errand else Route(corners, GAITS[motion]), 16.0)


def _add_floor(build: SceneBuilder, rng: np.random.Generator, period: float) -> None:
    """Add tiles that repeat, or patches of which each shows a texture somewhere else."""
    if period > 0:
        build.box((0, 0, 0.002), (_HALF_X_M, _HALF_Y_M, 0.002), 'tiles', 1 / period)
        return
    half = _PATCH_M / 2
    for x in np.arange(-_HALF_X_M + half, _HALF_X_M, _PATCH_M):
        for y in np.arange(-_HALF_Y_M + half, _HALF_Y_M + half, _PATCH_M):
            if abs(x) + half <= _CORE_X_M and abs(y) + half <= _CORE_Y_M:
                continue
            texture = 'carpet' if rng.random() < 0.7 else 'wood'
            yaw = 0.5 * np.pi * rng.integers(4)
            tint = rng.uniform(0.7, 0.95, 3)
            build.box(
                (x, y, 0.002), (half, half, 0.002), texture, rng.uniform(0.4, 0.6), tint, yaw
            )


def _add_doorway(build: SceneBuilder, x: float, y: float) -> None:
    """Add a wall across a corridor along x, with an opening in its middle and a lintel."""
    inner, outer = _ROUTE_Y_M - _CORE_Y_M, _HALF_Y_M - _ROUTE_Y_M
    for sign, width in ((1, outer), (-1, inner)):
        half = (width - _DOORWAY_M) / 2
        place = y + np.sign(y) * sign * (_DOORWAY_M + half)
        build.box((x, place, _HEIGHT_M), (0.06, half, _HEIGHT_M), 'plaster', 0.4)
    build.box((x, y, 2.35), (0.06, _DOORWAY_M, 0.25), 'wood', 0.6)


def _furnish_corridors(build: SceneBuilder, rng: np.random.Generator) -> None:
    """Add doors, a few pictures in the south, a shelf in the north."""
    for y, inwards in ((-_HALF_Y_M, 1), (-_CORE_Y_M, -1), (_CORE_Y_M, 1), (_HALF_Y_M, -1)):
        for x in (-3.5, 2.5):
            add_door(build, x + float(rng.uniform(-1, 1)), y, inwards)
        x = float(rng.uniform(-1.0, 0.5))
        build.box((x, y + 0.01 * inwards, 1.4), (0.45, 0.01, 0.35), 'poster', 0.8)
    build.box((5.2, 6.0, 0.8), (0.7, 0.17, 0.8), 'books', 0.8)
    build.box((-5.4, -4.0, 0.45), (0.4, 0.17, 0.45), 'keys', 0.7, (0.8, 0.85, 1.0))


def _furnish_room(build: SceneBuilder, rng: np.random.Generator, side: int, end: int) -> None:
    """Add desks, shelves, pictures and clutter to the room at the side x, the end y (signs)."""
    wall, inner = side * _HALF_X_M, side * _CORE_X_M
    low, high = sorted((wall - side * 0.8, wall - side * 0.05))
    near, far = sorted((end * 1.0, end * 2.9))
    add_desk(build, rng, np.array([low, near]), np.array([high, far]), 0.74, 12)
    add_monitor(build, wall - side * 0.35, end * 1.9, 0.74, np.pi if side < 0 else 0.0)
    y = end * (3.6 + rng.uniform(0, 0.6))
    build.box((wall - side * 0.22, y, 0.9), (0.2, 0.5, 0.9), 'books', 0.8)
    for place in (1.3, 2.4, 4.2):
        height = 1.6 + rng.uniform(-0.1, 0.1)
        build.box((wall - side * 0.005, end * place, height), (0.005, 0.4, 0.3), 'poster', 0.9)
    build.box((inner + side * 0.25, end * 2.2, 0.4), (0.25, 0.7, 0.4), 'wood', 0.8)
    corner = np.array([min(inner + side * 0.1, inner + side * 0.4), end * 2.2 - 0.5])
    add_clutter(build, rng, corner, corner + np.array([0.3, 1.0]), 0.8, 6)
    build.box((inner + side * 0.005, end * 2.2, 1.6), (0.005, 0.5, 0.35), 'print', 0.9)
    end_y = end * (_HALF_Y_M - 0.005)
    build.box((side * 9.6, end_y, 1.5), (0.5, 0.005, 0.4), 'poster', 0.8)
    build.box((side * 7.6, end * 5.95, 0.35), (0.45, 0.2, 0.35), 'keys', 0.7, (0.9, 0.8, 0.8))
