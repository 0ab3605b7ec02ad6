# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What moves in front of a camera: a person who crosses, a door that opens, a box carried by.

Each is placed ahead of where the camera looks when it does so: x ahead, y to the left, z up from
the floor. It stands still while an image is read out, and its motion does not blur the image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..motion.hand_held import smooth_step
from ..motion.path import Path
from ..raycast import Scene
from .builder import SceneBuilder

Place = tuple[NDArray[np.float64], float]  # offsets (P, 3) of the parts, metres; turn, radians
_NOWHERE = (0.0, 0.0, 1.0)  # of the lamp: a mover is lit by that of its scene

_CROSSES_S, _WALK_M_S, _WALK_M, _PERSON_AHEAD_M = 2.0, 1.0, 2.2, 1.6
_STRIDE_M, _STEPS_HZ = 0.22, 0.9

_DOOR_S, _DOOR_OPENS_S, _DOOR_RAD = 1.5, 1.5, np.deg2rad(-80.0)  # begins to open; takes; by
_HINGE = np.array([1.7, 0.45, 0.0])

_BOX_STOPS_S, _BOX_STANDS_S, _BOX_M_S, _BOX_M = 1.6, 2.0, 0.8, 1.5
_BOX_AHEAD_M, _BOX_Z_M = 1.0, 1.0


@dataclass(frozen=True)
class Mover:
    """A thing of some parts, and where they are at any time."""

    parts: Scene  # P of them, each where it is at offset 0
    place: Callable[[float], Place | None]  # at a time, seconds; None: out of sight
    T_world_ahead: NDArray[np.float64]  # (4, 4) what it is placed in

    def at(self, time_s: float) -> Scene | None:
        """Return the parts in the world at a time, None where they are out of sight."""
        place = self.place(time_s)
        if place is None:
            return None
        (offsets, turn), T = place, self.T_world_ahead
        c, s = np.cos(turn), np.sin(turn)
        R = T[:3, :3] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        centres = self.parts.centres @ R.T + offsets @ T[:3, :3].T + T[:3, 3]
        return replace(self.parts, centres=centres, R_world_local=R @ self.parts.R_world_local)


def person(path: Path) -> Mover:
    """Return a person in patterned clothes who crosses the view at 1 m/s, 1.6 m ahead."""
    build = SceneBuilder()
    for y in (-0.09, 0.09):
        build.box((y, y, 0.45), (0.08, 0.08, 0.45), 'books', 1.5, (0.6, 0.6, 0.9))
    for y in (-0.24, 0.24):
        build.box((0.0, y, 1.1), (0.05, 0.05, 0.3), 'poster', 1.4, (0.9, 0.6, 0.6))
    build.box((0.0, 0.0, 1.18), (0.13, 0.19, 0.28), 'poster', 1.4, (0.9, 0.6, 0.6))
    build.box((0.0, 0.0, 1.6), (0.1, 0.08, 0.12), 'print', 1.0, (0.9, 0.7, 0.6))
    swings = np.array([1.0, -1.0, -0.7, 0.7, 0.0, 0.0]) * _STRIDE_M

    def place(time_s: float) -> Place | None:
        along = _WALK_M_S * (time_s - _CROSSES_S)
        offsets = np.zeros((len(swings), 3))
        offsets[:, 0] = _PERSON_AHEAD_M
        offsets[:, 1] = along + swings * np.sin(2 * np.pi * _STEPS_HZ * time_s)
        return None if abs(along) > _WALK_M else (offsets, 0.0)

    return Mover(build.build(_NOWHERE, 1.0), place, _ahead(path, _CROSSES_S))


def door(path: Path) -> Mover:
    """Return a slab of 0.9 x 2 m across the view, 1.7 m ahead, that opens towards the camera."""
    build = SceneBuilder()
    build.box((0.0, -0.45, 1.0), (0.02, 0.45, 1.0), 'wood', 0.7, (0.9, 0.85, 0.75))
    build.box((0.0, -0.45, 1.35), (0.025, 0.22, 0.3), 'print', 1.2)  # a notice

    def place(time_s: float) -> Place:
        turned = smooth_step(np.array([(time_s - _DOOR_S) / _DOOR_OPENS_S]))[0]
        return np.tile(_HINGE, (2, 1)), _DOOR_RAD * float(turned)

    return Mover(build.build(_NOWHERE, 1.0), place, _ahead(path, _DOOR_S))


def box(path: Path) -> Mover:
    """Return a box over a third of the view that is carried by, stands for 2 s, and goes on."""
    build = SceneBuilder()
    build.box((0.0, 0.0, _BOX_Z_M), (0.18, 0.26, 0.23), 'poster', 1.3, (1.0, 0.9, 0.7))

    def place(time_s: float) -> Place | None:
        since = time_s - _BOX_STOPS_S
        along = _BOX_M_S * (min(since, 0.0) + max(since - _BOX_STANDS_S, 0.0))
        offsets = np.array([[_BOX_AHEAD_M, -along, 0.0]])
        return None if abs(along) > _BOX_M else (offsets, 0.0)

    stands_s = _BOX_STOPS_S + _BOX_STANDS_S / 2
    return Mover(build.build(_NOWHERE, 1.0), place, _ahead(path, stands_s))


MOVERS: Mapping[str, Callable[[Path], Mover]] = {'person': person, 'door': door, 'box': box}


def _ahead(path: Path, time_s: float) -> NDArray[np.float64]:
    """Return (4, 4) the place on the floor below the camera at a time, x where it looks."""
    T_world_cam = path.poses(np.array([time_s]))[0]
    x, y = T_world_cam[:2, 2] / np.linalg.norm(T_world_cam[:2, 2])
    T = np.eye(4)
    T[:2, 0], T[:2, 1], T[:2, 3] = (x, y), (-y, x), T_world_cam[:2, 3]
    return T
