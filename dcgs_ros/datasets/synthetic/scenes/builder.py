# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Building scenes of boxes and spheres: primitives, furniture and clutter."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..raycast import BOX, SPHERE, Scene
from ..textures import TEXTURE_NAMES

Floats = tuple[float, ...] | NDArray[np.float64]
WHITE = (1.0, 1.0, 1.0)
_CLUTTER_TEXTURES = ('poster', 'print', 'keys', 'poster', 'books')


class SceneBuilder:
    """Collects the primitives of a scene."""

    def __init__(self) -> None:
        self._rows: list[tuple[Any, ...]] = []

    def box(
        self,
        centre: Floats,
        half: Floats,
        texture: str | None,
        repeats_per_m: float = 0.5,
        tint: Floats = WHITE,
        yaw: float = 0.0,
    ) -> None:
        """Add a box turned about the vertical by `yaw` radians."""
        c, s = np.cos(yaw), np.sin(yaw)
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        index = TEXTURE_NAMES.index(texture) if texture else -1
        # Steps of the golden ratio, so that each box shows another part of the texture.
        offset = (0.618 * len(self._rows)) % 1.0, (0.414 * len(self._rows)) % 1.0
        self._rows.append((BOX, centre, half, rotation, index, (repeats_per_m, *offset), tint))

    def sphere(self, centre: Floats, radius: float, texture: str, repeats_per_m: float) -> None:
        """Add a sphere."""
        index = TEXTURE_NAMES.index(texture)
        mapping = (repeats_per_m, 0.0, (0.618 * len(self._rows)) % 1.0)
        self._rows.append((SPHERE, centre, (radius,) * 3, np.eye(3), index, mapping, WHITE))

    def build(self, lamp: Floats, ambient: float) -> Scene:
        """Return the scene of all primitives added."""
        kinds, centres, halves, rotations, textures, mappings, tints = zip(
            *self._rows, strict=True
        )
        return Scene(
            np.array(kinds, np.int64),
            np.array(centres, np.float64),
            np.array(halves, np.float64),
            np.array(rotations, np.float64),
            np.array(textures, np.int64),
            np.array(mappings, np.float32),
            np.array(tints, np.float32),
            np.array(lamp, np.float32),
            ambient,
        )


def add_desk(
    build: SceneBuilder,
    rng: np.random.Generator,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    height: float,
    things: int,
) -> None:
    """Add a desk over the rectangle low..high (2,), with clutter on it; metres."""
    middle, half = (low + high) / 2, (high - low) / 2
    build.box((*middle, height - 0.02), (*half, 0.02), 'wood', 0.7)
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = middle + (half - 0.04) * (sx, sy)
            build.box(
                (*leg, (height - 0.04) / 2), (0.03, 0.03, (height - 0.04) / 2), None, 1, (0.4,) * 3
            )
    add_clutter(build, rng, low + 0.12, high - 0.12, height, things)


def add_clutter(
    build: SceneBuilder,
    rng: np.random.Generator,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    height: float,
    things: int,
) -> None:
    """Scatter papers, boxes and balls over the rectangle low..high (2,) at `height`; metres."""
    for k in range(things):
        x, y = rng.uniform(low, high)
        kind = rng.random()
        yaw = float(rng.uniform(-0.6, 0.6))
        texture = str(rng.choice(_CLUTTER_TEXTURES))
        tint = rng.uniform(0.65, 1.0, 3)
        if kind < 0.3:
            thick = 0.002 + 0.0005 * k  # differs, so that one of two overlapping sheets is on top
            build.box((x, y, height + thick), (0.105, 0.148, thick), 'print', 1.6, tint, yaw)
        elif kind < 0.85:
            half = rng.uniform((0.04, 0.04, 0.02), (0.11, 0.11, 0.13))
            build.box((x, y, height + half[2]), half, texture, rng.uniform(1.2, 2.0), tint, yaw)
        else:
            radius = float(rng.uniform(0.04, 0.1))
            build.sphere((x, y, height + radius), radius, texture, 1.6)


def add_monitor(build: SceneBuilder, x: float, y: float, height: float, yaw: float) -> None:
    """Add a monitor on a desk, and a keyboard in front of it."""
    build.box((x, y, height + 0.06), (0.03, 0.05, 0.06), None, 1, (0.2,) * 3, yaw)
    build.box((x, y, height + 0.3), (0.025, 0.3, 0.19), 'print', 0.9, (0.55, 0.65, 0.8), yaw)
    build.box((x - 0.27, y, height + 0.012), (0.07, 0.21, 0.012), 'keys', 1.8, WHITE, yaw)


def add_walls(build: SceneBuilder) -> None:
    """Add walls, floor and pictures; the west wall and parts of the others stay plain."""
    build.box((0, 0, 1.3), (2.8, 2.4, 1.3), 'plaster', 0.4, (1.0, 0.97, 0.9))
    build.box((0, 0, 0.002), (2.8, 2.4, 0.002), 'carpet', 0.45, (0.9, 0.82, 0.75))
    for y, z, half_y, half_z in (
        (-1.5, 1.75, 0.4, 0.3),
        (0.05, 1.8, 0.35, 0.45),
        (1.3, 1.65, 0.45, 0.3),
    ):
        build.box((2.795, y, z), (0.005, half_y, half_z), 'poster', 0.9)
    for x, z, half_x, half_z in ((-0.9, 1.5, 0.4, 0.5), (2.0, 1.5, 0.35, 0.45)):
        build.box((x, 2.395, z), (half_x, 0.005, half_z), 'poster', 0.8, (1.0, 0.9, 0.9))
    for x, z, half_x, half_z in ((-0.3, 1.5, 0.5, 0.35), (1.4, 1.55, 0.55, 0.4)):
        build.box((x, -2.395, z), (half_x, 0.005, half_z), 'poster', 0.8, (0.9, 1.0, 0.9))
    build.box((-2.795, 0.7, 1.5), (0.005, 0.5, 0.4), 'poster', 0.7)
    build.box((-2.795, -0.9, 1.0), (0.01, 0.45, 1.0), 'wood', 0.5, (0.9, 0.8, 0.7))
