# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Simulated wheel odometry: wheels of slightly wrong size that slip in turns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .path import Path

RATE_HZ = 50
_STREAM = 8
_BLOCK = 1000  # samples that are computed at once


@dataclass(frozen=True)
class WheelErrors:
    """What is wrong with the wheels; the first two are drawn once, with the seed."""

    scale: float  # standard deviation of the relative error of distances
    turn_scale: float  # of turns: the distance between the wheels is the worst known
    slip: float  # share of a turn that is lost; it varies by half of itself, over about 1 s
    sideways_s: float  # sideways slip, metres per metre and rad/s of turning
    noise: float  # standard deviation after 1 m, or 1 rad, in these; it grows with the root


# An indoor robot on a hard floor: 1 % and 2 % after a careful calibration.
WHEELS = WheelErrors(0.01, 0.02, 0.04, 0.02, 0.005)
NO_ERRORS = WheelErrors(0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class OdometryBlock:
    """N samples of the base's motion."""

    times_s: NDArray[np.float64]  # (N,)
    poses: NDArray[np.float64]  # (N, 3) x, y, metres, heading, radians; of the first sample: zero
    velocities: NDArray[np.float64]  # (N, 3) forward, left, m/s, turning left, rad/s


def exact_steps(path: Path, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how the base moved (N - 1, 3) between times (N,): forward, left, turned left.

    The translation is taken at the heading midway, as for an arc of a circle.
    """
    ground = path.ground(times_s)
    steps = np.diff(ground, axis=0)
    steps[:, 2] = (steps[:, 2] + np.pi) % (2 * np.pi) - np.pi
    middle = ground[:-1, 2] + 0.5 * steps[:, 2]
    c, s = np.cos(middle), np.sin(middle)
    forward, left = c * steps[:, 0] + s * steps[:, 1], c * steps[:, 1] - s * steps[:, 0]
    return np.stack([forward, left, steps[:, 2]], axis=1)


def measured_odometry(
    path: Path, start_s: float, end_s: float, seed: int, errors: WheelErrors
) -> Iterator[OdometryBlock]:
    """Measure at 50 Hz from `start_s` to `end_s`, in blocks; the same with the same seed."""
    rng = np.random.default_rng((seed, _STREAM))
    scales = 1 + rng.standard_normal(3) * (errors.scale, errors.scale, errors.turn_scale)
    pose, slipping = np.zeros(3), 0.0
    count = int((end_s - start_s) * RATE_HZ) + 1
    for first in range(0, count, _BLOCK):
        times_s = start_s + np.arange(first - 1, min(first + _BLOCK, count)) / RATE_HZ
        steps = exact_steps(path, times_s)
        slips, slipping = _wandering(rng, len(steps), slipping)
        steps = _mistaken(steps, slips, rng.standard_normal(steps.shape), scales, errors)
        moved = steps.copy()
        if first == 0:
            moved[0] = 0  # poses are relative to the first sample
        poses = _summed(pose, moved)
        pose = poses[-1]
        yield OdometryBlock(times_s[1:], poses, steps * RATE_HZ)


def _wandering(
    rng: np.random.Generator, count: int, last: float
) -> tuple[NDArray[np.float64], float]:
    """Return values (N,) of unit variance with a memory of 1 s, after `last`; and the last one."""
    keep = np.exp(-1.0 / RATE_HZ)
    values = np.empty(count)
    for k, fresh in enumerate(np.sqrt(1 - keep**2) * rng.standard_normal(count)):
        last = values[k] = keep * last + fresh
    return values, last


def _mistaken(
    steps: NDArray[np.float64],  # (N, 3) true
    slips: NDArray[np.float64],  # (N,) unit variance
    white: NDArray[np.float64],  # (N, 3) standard normal
    scales: NDArray[np.float64],  # (3,)
    errors: WheelErrors,
) -> NDArray[np.float64]:
    """Return the steps (N, 3) that the wheels measure."""
    slip = errors.slip * (1 + 0.5 * slips)
    measured = steps * scales
    # Wheels that slip turn further than the base does; a base that drifts outwards in a turn
    # does so unseen.
    measured[:, 2] *= 1 + slip
    measured[:, 1] -= errors.sideways_s * np.abs(steps[:, 0]) * steps[:, 2] * RATE_HZ
    return measured + errors.noise * np.sqrt(np.abs(steps)) * white


def _summed(pose: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses (N, 3) after each step (N, 3), from `pose` (3,)."""
    headings = pose[2] + np.cumsum(steps[:, 2])
    middle = headings - 0.5 * steps[:, 2]
    c, s = np.cos(middle), np.sin(middle)
    x = pose[0] + np.cumsum(c * steps[:, 0] - s * steps[:, 1])
    y = pose[1] + np.cumsum(s * steps[:, 0] + c * steps[:, 1])
    return np.stack([x, y, headings], axis=1)
