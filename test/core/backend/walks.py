# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Walks round a block, as a tracker with an honest covariance would report them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.backend.closure import Loop
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe, Odometry

STEP_M = 0.3  # between keyframes
ODOMETRY = np.diag(np.square(np.repeat([0.004, 0.003], 3)))  # drifts by 1-2 % of the way
LOOP = np.diag(np.square(np.repeat([0.01, 0.006], 3)))
PERIOD_M = 2.22  # of the floor
_HOSTS = 3


@dataclass(frozen=True)
class Walk:
    """Keyframes along a path."""

    truth: NDArray[np.float64]  # (K, 4, 4)
    tracked: NDArray[np.float64]  # (K, 4, 4)
    odometry: list[Odometry]

    def keyframes(self) -> Iterator[Keyframe]:
        """Yield what the tracker hands over."""
        for k, (T, odometry) in enumerate(zip(self.tracked, self.odometry, strict=True)):
            yield keyframe(k, T, odometry)

    def error_m(self, poses: NDArray[np.float64]) -> float:
        """Return the root mean square of the error of positions."""
        offsets = poses[:, :3, 3] - self.truth[: len(poses), :3, 3]
        return float(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))

    def loop(self, a: int, b: int, rng: np.random.Generator, shift_m: float = 0.0) -> Loop:
        """Return a loop; the place of a wrong one lies `shift_m` along the way of a."""
        there = self.truth[a].copy()
        there[:3, 3] += shift_m * there[:3, 2]
        T = se3.inverse(there) @ self.truth[b] @ drawn(rng, LOOP)
        return Loop(a, b, T, LOOP, inliers=100)


def keyframe(k: int, T_world_cam: NDArray[np.float64], odometry: Odometry) -> Keyframe:
    """Return a keyframe without image or Gaussians."""
    stamp_ns = (k + 1) * 10**9
    frame = RgbdFrame(stamp_ns, stamp_ns, np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), 'f4'))
    none = np.empty((0, 3), np.float32)
    return Keyframe(frame, T_world_cam, np.eye(4), np.empty(0, np.int64), none, none, odometry)


def drawn(rng: np.random.Generator, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a motion (4, 4) of that covariance (6, 6)."""
    return se3.exp(np.linalg.cholesky(covariance) @ rng.normal(size=6))


def round_block(
    count: int,
    seed: int,
    size_m: tuple[float, float] = (17.7, 10.0),
    drift: float = 1.0,
) -> Walk:
    """Walk round a rectangle, looking ahead; with `drift` times the noise."""
    covariance = drift**2 * ODOMETRY
    rng = np.random.default_rng(seed)
    truth = np.array([_at(k * STEP_M, size_m) for k in range(count)])
    tracked, odometry = [truth[0]], [first(0)]
    for k in range(1, count):
        hosts, shares = _hosts(k, 0)
        host = int(rng.choice(hosts[::-1], p=shares[::-1]))  # whose error it inherits
        T = tracked[host] @ se3.inverse(truth[host]) @ truth[k] @ drawn(rng, covariance)
        odometry.append(relative(k, T, np.array(tracked), covariance))
        tracked.append(T)
    return Walk(truth, np.array(tracked), odometry)


def first(k: int, submap: int = 0) -> Odometry:
    """Return that of a keyframe that begins a map."""
    return Odometry(
        k,
        submap,
        np.empty(0, np.int32),
        np.empty((0, 4, 4)),
        np.empty((0, 6, 6)),
        np.zeros((6, 6)),
    )


def relative(
    k: int,
    T: NDArray[np.float64],
    before: NDArray[np.float64],
    covariance: NDArray[np.float64] = ODOMETRY,
    submap: int = 0,
    begin: int = 0,
) -> Odometry:
    """Return that of a keyframe at T (4, 4) with the last ones of `before` (k, 4, 4) as hosts.

    Hosts are not before `begin`.
    """
    hosts, shares = _hosts(k, begin)
    T_host_cam = np.array([se3.inverse(before[h]) @ T for h in hosts])
    information = shares[:, None, None] * np.linalg.inv(covariance)
    return Odometry(k, submap, hosts.astype('i4'), T_host_cam, information, covariance)


def _hosts(k: int, begin: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    hosts = np.arange(max(k - _HOSTS, begin), k)
    shares = np.linspace(1.0, 2.0, len(hosts))
    return hosts, shares / shares.sum()


def _at(way_m: float, size_m: tuple[float, float]) -> NDArray[np.float64]:
    """Return the pose on the rectangle, z ahead and y down."""
    x_m, y_m = size_m
    lap = way_m % (2 * (x_m + y_m))
    sides = ((x_m, 0.0), (y_m, 0.5), (x_m, 1.0), (y_m, 1.5))
    corner = np.zeros(2)
    for length, half_turns in sides:
        heading = np.pi * half_turns
        ahead = np.array([np.cos(heading), np.sin(heading)])
        if lap <= length:
            break
        corner, lap = corner + length * ahead, lap - length
    T = np.eye(4)
    T[:3, 2] = (*ahead, 0.0)
    T[:3, 0] = (ahead[1], -ahead[0], 0.0)
    T[:3, 1] = (0.0, 0.0, -1.0)
    T[:3, 3] = (*(corner + lap * ahead), 1.3)
    return T
