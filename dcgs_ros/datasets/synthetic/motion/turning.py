# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A robot that turns on the spot, as fast as its wheels can; smooth and unending."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .hand_held import smooth_step
from .path import poses_of

_CAMERA = (
    0.2,
    0.55,
    -8.0,
)  # metres before the base's origin and above the floor, pitch in degrees
_TURNS_RAD = np.pi * np.array([1.0, 1.0, -1.0, -1.0])
_TURN_S = 1.875 * np.pi / 3.0  # half a turn that reaches 3 rad/s
_EACH_S, _BEGINS = 3.0, 0.3  # from one to the next, and the share of it before the turn


@dataclass(frozen=True)
class OnTheSpot:
    """Turns twice to the left by half a turn each, then twice to the right."""

    place: tuple[float, float]  # x y metres, world

    def path(self, seed: int, speed: float) -> TurningPath:
        """Return the path; it does not depend on the seed."""
        return TurningPath(self.place, speed)


class TurningPath:
    """The turns at some speed."""

    T_base_cam: NDArray[np.float64] | None

    def __init__(self, place: tuple[float, float], speed: float) -> None:
        """Stand at a place (x, y)."""
        self._place, self._speed = place, speed
        ahead_m, height_m, pitch_deg = _CAMERA
        self.T_base_cam = poses_of(np.array([[ahead_m, 0.0, height_m, 0.0, pitch_deg, 0.0]]).T)[0]

    def poses(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return T_world_cam (N, 4, 4) at times (N,), x right, y down, z forward; world z up."""
        x, y, yaw = self.ground(times_s).T
        ahead_m, height_m, pitch_deg = _CAMERA
        zero = np.zeros_like(x)
        x, y = x + ahead_m * np.cos(yaw), y + ahead_m * np.sin(yaw)
        return poses_of(np.stack([x, y, zero + height_m, np.rad2deg(yaw), zero + pitch_deg, zero]))

    def ground(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return x, y, metres, and heading, radians (N, 3), of the base."""
        t = np.asarray(times_s, np.float64) * self._speed
        within = t % (_EACH_S * len(_TURNS_RAD))
        yaw = np.zeros_like(t)
        for k, turn in enumerate(_TURNS_RAD):
            yaw += turn * smooth_step((within - _EACH_S * (k + _BEGINS)) / _TURN_S)
        x, y = np.broadcast_to(np.array(self._place)[:, None], (2, len(t)))
        return np.stack([x, y, yaw], axis=1)
