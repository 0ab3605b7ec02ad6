# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Motion of a hand-held camera: slow sways, fast turns and shake; smooth and unending."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .path import poses_of


@dataclass(frozen=True)
class Sway:
    """One sine of one channel."""

    channel: int
    amplitude: float  # metres or degrees
    period_s: float
    phase: float = 0.0  # radians


@dataclass(frozen=True)
class Turn:
    """One quick change of one channel; its peak rate is 1.875 change / duration."""

    channel: int
    start_s: float  # within the cycle
    change: float  # metres or degrees
    duration_s: float


@dataclass(frozen=True)
class Motion:
    """The intended motion, without shake. Turns repeat every cycle; each channel's sum is zero."""

    centre: tuple[float, ...]  # x y z metres, world; yaw pitch roll degrees
    sways: tuple[Sway, ...]
    turns: tuple[Turn, ...] = ()
    cycle_s: float = 24.0
    shake_m: float = 0.008  # amplitude at 1 Hz
    shake_deg: float = 0.6  # amplitude at 1 Hz

    def path(self, seed: int, speed: float) -> HandHeldPath:
        """Return the path of a hand that moves so."""
        return HandHeldPath(self, seed, speed)


class HandHeldPath:
    """A motion at some speed, with the shake of a seed."""

    T_base_cam: NDArray[np.float64] | None = None

    def __init__(self, motion: Motion, seed: int, speed: float) -> None:
        """Draw the shake: five sines a channel, 0.4-2.2 Hz, amplitude falling as 1 / f."""
        self._motion, self._speed = motion, speed
        rng = np.random.default_rng((seed, 1))
        frequencies = np.exp(rng.uniform(np.log(0.4), np.log(2.2), (6, 5)))
        amplitudes = np.array([motion.shake_m] * 3 + [motion.shake_deg] * 3)[:, None]
        amplitudes = amplitudes * rng.uniform(0.3, 1.0, (6, 5)) / frequencies / np.sqrt(5)
        self._frequencies, self._amplitudes = frequencies, amplitudes
        self._phases = rng.uniform(0, 2 * np.pi, (6, 5))

    def poses(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return T_world_cam (N, 4, 4) at times (N,), x right, y down, z forward; world z up."""
        return poses_of(self._channels(np.asarray(times_s, np.float64) * self._speed))

    def ground(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return x, y, metres, and heading, radians (N, 3), of the camera above the ground."""
        x, y, _, yaw, *_ = self._channels(np.asarray(times_s, np.float64) * self._speed)
        return np.stack([x, y, np.deg2rad(yaw)], axis=1)

    def _channels(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions in metres and angles in degrees (6, N) at times (N,) of the path."""
        motion = self._motion
        values = np.tile(np.array(motion.centre)[:, None], (1, len(t)))
        for sway in motion.sways:
            values[sway.channel] += sway.amplitude * np.sin(
                2 * np.pi * t / sway.period_s + sway.phase
            )
        for turn in motion.turns:
            share = smooth_step((t % motion.cycle_s - turn.start_s) / turn.duration_s)
            values[turn.channel] += turn.change * share
        for k in range(self._frequencies.shape[1]):
            angle = 2 * np.pi * self._frequencies[:, k, None] * t + self._phases[:, k, None]
            values += self._amplitudes[:, k, None] * np.sin(angle)
        return values


def smooth_step(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far (N,) a change is at a share of its time: 0 before, 1 after, no jerk."""
    share = np.clip(share, 0, 1)
    return np.asarray(share**3 * (share * (6 * share - 15) + 10))
