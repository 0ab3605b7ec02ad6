# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Motion along a closed route over the ground, on wheels or on foot; smooth and unending."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from .path import poses_of

_STEP_M = 0.02  # of the samples of a route
_WINDOW_S = 0.35  # over which speed changes
_SWAY_S = 5.3  # period of looking left and right
_SHAKE_STREAM = 6


@dataclass(frozen=True)
class Gait:
    """How something moves along a route, and how it carries the camera."""

    speed_m_s: float  # on straight stretches
    turn_rad_s: float  # at most: it slows down in turns
    corner_m: float  # standard deviation of the blur that rounds the route's corners
    height_m: float  # of the camera
    pitch_deg: float
    shake_m: float  # amplitude of each channel's five sines together, at the lowest frequency
    shake_deg: float
    shake_hz: tuple[float, float]  # least and greatest frequency; amplitudes fall as 1 / f
    sway_deg: float = 0.0  # amplitude of looking left and right


# A small indoor robot: its vibration is of the wheels and of the mast that the camera is on.
WHEELED = Gait(0.45, 0.7, 0.25, 0.55, -8.0, 0.0004, 0.12, (4.0, 14.0))
# A walker with the camera in the hands; steps are at about 2 Hz.
HANDHELD = Gait(0.7, 1.0, 0.35, 1.35, -12.0, 0.02, 1.2, (0.5, 2.2), sway_deg=14.0)
GAITS = {'wheeled': WHEELED, 'handheld': HANDHELD}


@dataclass(frozen=True)
class Route:
    """A closed polygon over the ground and who follows it; the camera looks where it goes."""

    corners: tuple[tuple[float, float], ...]  # x y metres, in the order of the motion
    gait: Gait

    def path(self, seed: int, speed: float) -> RoutePath:
        """Return the path that follows the route."""
        return RoutePath(self, seed, speed)


class RoutePath:
    """A route at some speed, with the shake of a seed; it begins again where it is closed."""

    def __init__(self, route: Route, seed: int, speed: float) -> None:
        """Round the corners, then find when each place is reached."""
        gait = route.gait
        places = _rounded(np.array(route.corners, np.float64), gait.corner_m)
        lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(lengths)])
        self._place = CubicSpline(along, places, bc_type='periodic')
        times = _schedule(self._place, along, gait)
        self.length_m, self.cycle_s = float(along[-1]), float(times[-1])
        # What along is ahead of steady motion is periodic.
        ahead = along - times * (self.length_m / self.cycle_s)
        ahead[-1] = ahead[0]
        self._ahead = CubicSpline(times, ahead, bc_type='periodic')
        self._gait, self._speed = gait, speed
        mast = np.array([[0.0, 0.0, gait.height_m, 0.0, gait.pitch_deg, 0.0]]).T
        self.T_base_cam: NDArray[np.float64] | None = None if gait.sway_deg else poses_of(mast)[0]
        self._shake = Shake(gait, seed)

    def poses(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return T_world_cam (N, 4, 4) at times (N,), x right, y down, z forward; world z up."""
        x, y, yaw = self.ground(times_s).T
        gait, zero = self._gait, np.zeros_like(x)
        sway = gait.sway_deg * np.sin(2 * np.pi * self._times(times_s) / _SWAY_S)
        heights, pitches = zero + gait.height_m, zero + gait.pitch_deg
        channels = np.stack([x, y, heights, np.rad2deg(yaw) + sway, pitches, zero])
        return poses_of(channels + self._shake.channels(self._times(times_s)))

    def ground(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return x, y, metres, and heading, radians (N, 3), of what moves along the route."""
        t = self._times(times_s)
        along = t * (self.length_m / self.cycle_s) + self._ahead(t % self.cycle_s)
        x, y = self._place(along % self.length_m).T
        dx, dy = self._place(along % self.length_m, 1).T
        return np.stack([x, y, np.arctan2(dy, dx)], axis=1)

    def _times(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.asarray(times_s, np.float64) * self._speed


class Shake:
    """Five sines a channel, drawn with a seed."""

    def __init__(self, gait: Gait, seed: int) -> None:
        rng = np.random.default_rng((seed, _SHAKE_STREAM))
        low, high = gait.shake_hz
        self._frequencies = np.exp(rng.uniform(np.log(low), np.log(high), (6, 5)))
        sizes = np.array([gait.shake_m] * 3 + [gait.shake_deg] * 3)[:, None]
        self._amplitudes = sizes * low / self._frequencies / np.sqrt(5)
        self._phases = rng.uniform(0, 2 * np.pi, (6, 5))

    def channels(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return metres and degrees (6, N) at times (N,)."""
        angles = 2 * np.pi * self._frequencies[..., None] * t + self._phases[..., None]
        total: NDArray[np.float64] = (self._amplitudes[..., None] * np.sin(angles)).sum(axis=1)
        return total


def _rounded(corners: NDArray[np.float64], sigma_m: float) -> NDArray[np.float64]:
    """Return places (N, 2) along a closed polygon (C, 2), blurred; the last is the first."""
    sides = np.diff(np.vstack([corners, corners[:1]]), axis=0)
    counts = np.ceil(np.linalg.norm(sides, axis=1) / _STEP_M).astype(int)
    places = np.concatenate(
        [
            corner + side * (np.arange(count) / count)[:, None]
            for corner, side, count in zip(corners, sides, counts, strict=True)
        ]
    )
    places = gaussian_filter1d(places, sigma_m / _STEP_M, axis=0, mode='wrap')
    return np.vstack([places, places[:1]])


def _schedule(place: CubicSpline, along: NDArray[np.float64], gait: Gait) -> NDArray[np.float64]:
    """Return when each place (N,) at `along` metres is reached: slower where the route bends."""
    middles = 0.5 * (along[:-1] + along[1:])
    (dx, dy), (ddx, ddy) = place(middles, 1).T, place(middles, 2).T
    bends = np.abs(dx * ddy - dy * ddx) / np.hypot(dx, dy) ** 3
    pace = np.minimum(gait.speed_m_s, gait.turn_rad_s / np.maximum(bends, 1e-6))
    pace = gaussian_filter1d(pace, _WINDOW_S * gait.speed_m_s / _STEP_M, mode='wrap')
    return np.concatenate([[0.0], np.cumsum(np.diff(along) / pace)])
