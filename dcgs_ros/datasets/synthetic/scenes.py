# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The synthetic scenes: a furnished room, a textured plane, an untextured folding screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera_motion import PITCH, ROLL, YAW, Motion, Sway, Turn, X, Y, Z
from .raycast import BOX, SPHERE, Scene
from .textures import TEXTURE_NAMES

Floats = tuple[float, ...] | NDArray[np.float64]
WHITE = (1.0, 1.0, 1.0)
_CLUTTER = ('poster', 'print', 'keys', 'poster', 'books')


@dataclass(frozen=True)
class Scenario:
    """A scene, and the motion of the camera through it."""

    scene: Scene
    motion: Motion
    pattern: float  # contrast of an infrared dot pattern on white at 1 m, grey levels


class _Builder:
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


def _desk(
    build: _Builder,
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
    _clutter(build, rng, low + 0.12, high - 0.12, height, things)


def _clutter(
    build: _Builder,
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
        texture = str(rng.choice(_CLUTTER))
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


def _screen(build: _Builder, x: float, y: float, height: float, yaw: float) -> None:
    """Add a monitor on a desk, and a keyboard in front of it."""
    build.box((x, y, height + 0.06), (0.03, 0.05, 0.06), None, 1, (0.2,) * 3, yaw)
    build.box((x, y, height + 0.3), (0.025, 0.3, 0.19), 'print', 0.9, (0.55, 0.65, 0.8), yaw)
    build.box((x - 0.27, y, height + 0.012), (0.07, 0.21, 0.012), 'keys', 1.8, WHITE, yaw)


def _walls(build: _Builder) -> None:
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


def _room(rng: np.random.Generator) -> Scenario:
    """Build a study of 5.6 x 4.8 x 2.6 m; the camera stays in its middle, facing the desks."""
    build = _Builder()
    _walls(build)
    _desk(build, rng, np.array([1.9, -1.75]), np.array([2.76, -0.05]), 0.74, 13)
    _desk(build, rng, np.array([1.9, 0.05]), np.array([2.76, 1.75]), 0.72, 13)
    _screen(build, 2.5, -0.9 + rng.uniform(-0.1, 0.1), 0.74, 0.15)
    _screen(build, 2.5, 0.85 + rng.uniform(-0.1, 0.1), 0.72, -0.1)
    build.box((0.55, 2.2, 0.95), (0.75, 0.19, 0.95), 'books', 0.8)
    build.box((-1.2, 2.15, 0.4), (0.6, 0.24, 0.4), 'wood', 0.8, (0.9, 1.0, 1.0))
    _clutter(build, rng, np.array([-1.7, 2.0]), np.array([-0.7, 2.3]), 0.8, 6)
    build.box((0.6, -2.1, 0.38), (0.9, 0.28, 0.38), 'wood', 0.8, (1.0, 0.85, 0.7))
    _clutter(build, rng, np.array([-0.2, -2.25]), np.array([1.4, -1.95]), 0.76, 9)
    build.box((-2.45, -1.85, 0.9), (0.33, 0.5, 0.9), 'keys', 0.7, (0.8, 0.85, 1.0))
    for y in (-0.85, 0.95):  # chairs
        build.box((1.72, y, 0.44), (0.21, 0.21, 0.03), 'poster', 1.0, (0.7, 0.8, 1.0))
        build.box((1.72, y, 0.21), (0.03, 0.03, 0.21), None, 1, (0.25,) * 3)
        build.box((1.53, y, 0.7), (0.02, 0.2, 0.22), 'carpet', 1.2, (0.8, 0.6, 0.6))
    _clutter(build, rng, np.array([0.9, -1.7]), np.array([1.5, 1.9]), 0.004, 8)
    build.box((0.5, 0.0, 2.52), (0.6, 0.15, 0.05), None, 1, (1.3, 1.3, 1.25))
    motion = Motion(
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
    return Scenario(build.build((0.5, 0.0, 2.3), 0.55), motion, pattern=4.0)


def _plane(rng: np.random.Generator) -> Scenario:
    """Build one textured plane: depth alone leaves three degrees of freedom unobserved."""
    build = _Builder()
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


def _zigzag(rng: np.random.Generator) -> Scenario:
    """Build a folding screen before a wall, without texture: only geometry constrains."""
    build = _Builder()
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


_SCENARIOS: dict[str, Callable[[np.random.Generator], Scenario]] = {
    'room': _room,
    'plane': _plane,
    'zigzag': _zigzag,
}
SCENE_NAMES = tuple(_SCENARIOS)


def build_scenario(name: str, seed: int) -> Scenario:
    """Build one of `SCENE_NAMES`; the seed places the clutter."""
    return _SCENARIOS[name](np.random.default_rng((seed, 2)))
