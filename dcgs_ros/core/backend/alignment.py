# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Where one image is relative to another, by features that look alike: matching and RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..sensor import SensorNoise
from .features import Features

_FARTHEST_BITS = 64  # between descriptors of one corner
_RATIO = 0.85  # of the distances to the best and the second best (Lowe 2004)
_FEWEST = 12  # matches, and inliers
_HYPOTHESES = 300
_TELLING, _TELLING_SHARE = 25, 0.5  # inliers, and their share of the matches
_THICK_M = 0.01  # off their best plane, root mean square
_REPROJECTED_PX = 4.0  # of an inlier, at most
_SIGMAS = 3.0  # of its depth
_ROUGH_M = 0.02  # ... plus this
_LEAST_SPREAD_M2 = 1e-4  # twice the area of a triangle of three matches
_NEAREST_M = 0.05
_REFINEMENTS = 3


@dataclass(frozen=True)
class Alignment:
    """A pose between two images, and the features that agree with it."""

    T_a_b: NDArray[np.float64]  # (4, 4)
    matched: int
    of_a: NDArray[np.int64]  # (I,) features of a that agree ...
    of_b: NDArray[np.int64]  # (I,) ... with these of b

    def is_telling(self, a: Features) -> bool:
        """Return whether the features that agree are many, most of them, and not in one plane."""
        enough = self.inliers >= max(_TELLING, _TELLING_SHARE * self.matched)
        return enough and not self.is_flat(a)

    def is_flat(self, a: Features) -> bool:
        """Return whether the features are in one plane, as of a floor that repeats itself."""
        points = a.points[self.of_a]
        off = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1]
        return bool(off / np.sqrt(len(points)) <= _THICK_M)

    def inverted(self) -> Alignment:
        """Return where a is relative to b."""
        return Alignment(se3.inverse(self.T_a_b), self.matched, self.of_b, self.of_a)

    @property
    def inliers(self) -> int:
        """How many features agree."""
        return len(self.of_a)


def match(a: Features, b: Features) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices (M,) of features of a and b that look alike, each the other's best."""
    if len(a) < 2 or len(b) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    norm = cv2.NORM_HAMMING
    distance, best = cv2.batchDistance(
        a.descriptors, b.descriptors, cv2.CV_32S, normType=norm, K=2
    )
    _, back = cv2.batchDistance(b.descriptors, a.descriptors, cv2.CV_32S, normType=norm, K=1)
    alike = (distance[:, 0] <= _FARTHEST_BITS) & (distance[:, 0] < _RATIO * distance[:, 1])
    alike &= back[best[:, 0], 0] == np.arange(len(a))
    of_a = np.flatnonzero(alike)
    return of_a, best[of_a, 0].astype(np.int64)


def align(
    a: Features, b: Features, sensor: SensorNoise, focal_px: float, seed: int
) -> Alignment | None:
    """Return where b is relative to a; None where fewer than a dozen features agree.

    Poses from three matches with depth on both sides are tried, and the one is taken that puts
    the most points of a, which need no depth in b, where b sees them.
    """
    of_a, of_b = match(a, b)
    known = a.depths_m[of_a] > 0.0
    of_a, of_b = of_a[known], of_b[known]
    if len(of_a) < _FEWEST:
        return None
    pairs = _Pairs(a[of_a], b[of_b], sensor, focal_px)
    best = pairs.best_of(_hypotheses(pairs, np.random.default_rng(seed)))
    if best is None:
        return None
    agree = pairs.agree(best[None])[0]
    for _ in range(_REFINEMENTS):
        if agree.sum() < _FEWEST:
            return None
        best = pairs.refined(best, agree)
        agree = pairs.agree(best[None])[0]
    if agree.sum() < _FEWEST:
        return None
    return Alignment(se3.inverse(best), len(known), of_a[agree], of_b[agree])


class _Pairs:
    """Matched features, of which those of a have depth; poses are T_b_a."""

    def __init__(self, a: Features, b: Features, sensor: SensorNoise, focal_px: float) -> None:
        self.a, self.b = a.points, b.points
        self.both = b.depths_m > 0.0
        self._rays = b.rays.astype(np.float64)
        self._z = b.depths_m.astype(np.float64)
        self._limit = _REPROJECTED_PX / focal_px
        sigma = np.hypot(sensor.sigma(self.a[:, 2]), sensor.sigma(self._z))
        self._depth_limit = _SIGMAS * sigma + _ROUGH_M
        self._focal = focal_px

    def agree(self, T_b_a: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return (H, M) which pairs agree with each pose (H, 4, 4)."""
        there = np.einsum('hij,mj->hmi', T_b_a[:, :3, :3], self.a) + T_b_a[:, None, :3, 3]
        z = np.maximum(there[..., 2], _NEAREST_M)
        off = np.linalg.norm(there[..., :2] / z[..., None] - self._rays, axis=2)
        right_depth = np.abs(there[..., 2] - self._z) < self._depth_limit
        return (off < self._limit) & (there[..., 2] > _NEAREST_M) & (right_depth | ~self.both)

    def best_of(self, T_b_a: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the pose (4, 4) that most pairs agree with, the first of equals."""
        if not len(T_b_a):
            return None
        return np.asarray(T_b_a[self.agree(T_b_a).sum(axis=1).argmax()])

    def refined(self, T_b_a: NDArray[np.float64], agree: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the pose after a Gauss-Newton step on the reprojections of pairs that agree."""
        q = se3.transform(T_b_a, self.a[agree])
        z = q[:, 2:]
        e = (q[:, :2] / z - self._rays[agree]).ravel()
        J_q = np.zeros((len(q), 2, 3))
        J_q[:, 0, 0] = J_q[:, 1, 1] = 1.0 / z[:, 0]
        J_q[:, :, 2] = -q[:, :2] / z**2
        J_left = np.zeros((len(q), 3, 6))  # exp(xi) T: dq = rho - [q] phi
        J_left[:, :, :3] = np.eye(3)
        J_left[:, :, 3:] = -np.array([se3.hat(one) for one in q])
        J = (J_q @ J_left).reshape(-1, 6)
        rows, errors = [J], [e]
        both = self.both[agree]
        if both.any():  # a depth counts as much as its noise lets it, against a pixel
            weight = (_REPROJECTED_PX / self._focal) / self._depth_limit[agree][both]
            rows.append(weight[:, None] * J_left[both, 2])
            errors.append(weight * (z[both, 0] - self._z[agree][both]))
        J, e = np.concatenate(rows), np.concatenate(errors)
        xi = np.linalg.solve(J.T @ J + 1e-9 * np.eye(6), J.T @ e)
        return np.asarray(se3.exp(-xi) @ T_b_a)


def _hypotheses(pairs: _Pairs, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return poses T_b_a (H, 4, 4) that move three points of a onto those of b."""
    both = np.flatnonzero(pairs.both)
    if len(both) < 3:
        return np.empty((0, 4, 4))
    chosen = both[rng.integers(len(both), size=(_HYPOTHESES, 3))]
    a, b = pairs.a[chosen], pairs.b[chosen]
    area = np.linalg.norm(np.cross(a[:, 1] - a[:, 0], a[:, 2] - a[:, 0]), axis=1)
    sides_a, sides_b = (np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2) for x in (a, b))
    rigid = np.abs(sides_a - sides_b).max(axis=1) < 2 * pairs._depth_limit[chosen].max(axis=1)
    kept = (area > _LEAST_SPREAD_M2) & rigid
    return _moving(a[kept], b[kept])


def _moving(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rigid motions (H, 4, 4) from points a to b, (H, P, 3) each (Kabsch 1976)."""
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(b - mean_b, 1, 2) @ (a - mean_a))
    proper = np.ones((len(a), 3))
    proper[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    T = np.tile(np.eye(4), (len(a), 1, 1))
    T[:, :3, :3] = (u * proper[:, None]) @ vt
    T[:, :3, 3] = mean_b[:, 0] - np.einsum('hij,hj->hi', T[:, :3, :3], mean_a[:, 0])
    return T
