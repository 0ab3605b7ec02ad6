# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A low robot that drives straight, stops, turns on the spot and drives on; smooth, unending."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .hand_held import smooth_step
from .path import poses_of
from .route import WHEELED, Shake

_AHEAD_M, _HEIGHT_M = 0.2, 0.3  # of the camera, before the base's origin and above the floor
_SPEED_M_S, _RAMP_S = 0.5, 0.8
_RATE_RAD_S = 1.5  # the most in a turn
_PAUSE_S = 0.5  # before a turn and after it


@dataclass(frozen=True)
class Errand:
    """Straight stretches from corner to corner of a closed polygon, with a stop at each."""

    corners: tuple[tuple[float, float], ...]  # x y metres, in the order of the motion

    def path(self, seed: int, speed: float) -> ErrandPath:
        """Return the path, with the vibration of a seed."""
        return ErrandPath(self.corners, seed, speed)


class ErrandPath:
    """An errand at some speed."""

    T_base_cam: NDArray[np.float64] | None

    def __init__(self, corners: tuple[tuple[float, float], ...], seed: int, speed: float) -> None:
        """Plan when each stretch and each turn begins."""
        self._first = np.array(corners[0])
        self._sides = np.roll(np.array(corners), -1, axis=0) - np.array(corners)
        self._lengths_m = np.linalg.norm(self._sides, axis=1)
        headings = np.arctan2(self._sides[:, 1], self._sides[:, 0])
        turns = np.diff(headings, append=headings[:1])
        self._heading, self._turns = headings[0], (turns + np.pi) % (2 * np.pi) - np.pi
        drives_s = self._lengths_m / _SPEED_M_S + _RAMP_S
        self._turns_s = 1.875 * np.abs(self._turns) / _RATE_RAD_S + 1e-9
        ends_s = np.cumsum(drives_s + self._turns_s + 2 * _PAUSE_S)
        self.cycle_s = float(ends_s[-1])
        self._starts_s = np.concatenate([[0.0], ends_s[:-1]])
        self._turning_s = self._starts_s + drives_s + _PAUSE_S
        self._speed, self._shake = speed, Shake(WHEELED, seed)
        mast = np.array([[_AHEAD_M, 0.0, _HEIGHT_M, 0.0, 0.0, 0.0]]).T
        self.T_base_cam = poses_of(mast)[0]

    def poses(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return T_world_cam (N, 4, 4) at times (N,), x right, y down, z forward; world z up."""
        x, y, yaw = self.ground(times_s).T
        t, zero = np.asarray(times_s, np.float64) * self._speed, np.zeros_like(x)
        moving = sum(_pace(t % self.cycle_s - s, m)
                     for s, m in zip(self._starts_s, self._lengths_m, strict=True))  # fmt: skip
        x, y = x + _AHEAD_M * np.cos(yaw), y + _AHEAD_M * np.sin(yaw)
        channels = np.stack([x, y, zero + _HEIGHT_M, np.rad2deg(yaw), zero, zero])
        return poses_of(channels + moving * self._shake.channels(t))

    def ground(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return x, y, metres, and heading, radians (N, 3), of the base."""
        laps, within = np.divmod(np.asarray(times_s, np.float64) * self._speed, self.cycle_s)
        place = np.repeat(self._first[None], len(within), axis=0)
        yaw = self._heading + laps * self._turns.sum()
        for k, (side, length_m) in enumerate(zip(self._sides, self._lengths_m, strict=True)):
            gone_m = _gone(within - self._starts_s[k], length_m)
            place = place + gone_m[:, None] * (side / length_m)
            yaw = yaw + self._turns[k] * smooth_step(
                (within - self._turning_s[k]) / self._turns_s[k]
            )
        return np.column_stack([place, yaw])


def _gone(seconds: NDArray[np.float64], length_m: float) -> NDArray[np.float64]:
    """Return how far (N,) a stretch is driven (N,) after its start, between two smooth ramps."""
    begun, ended = seconds / _RAMP_S, (seconds - length_m / _SPEED_M_S) / _RAMP_S
    return _SPEED_M_S * _RAMP_S * (_ramped(begun) - _ramped(ended))


def _pace(seconds: NDArray[np.float64], length_m: float) -> NDArray[np.float64]:
    """Return the speed (N,) there as a share of the full one."""
    begun, ended = seconds / _RAMP_S, (seconds - length_m / _SPEED_M_S) / _RAMP_S
    return np.asarray(smooth_step(begun) - smooth_step(ended))


def _ramped(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the integral of `smooth_step` up to t (N,)."""
    within = np.clip(t, 0.0, 1.0)
    return np.asarray(within**4 * (within * (within - 3.0) + 2.5) + np.maximum(t - 1.0, 0.0))
