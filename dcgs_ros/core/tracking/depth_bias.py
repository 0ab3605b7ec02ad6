# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The smooth error of an uncalibrated depth camera, estimated while tracking.

Such a camera measures depth as z (1 + b), b(x, y) = sum_k theta_k phi_k(x, y) over the image, by
up to some per cent. Wherever the camera goes, the pattern goes along and holds the pose back. It
shows in every point that is seen in two places of the image: with a point a at the pixel of now,
and its Gaussian or landmark mu, which was measured from t_h at the pixel of then, the residual is

    e = J xi + (mu - t_h) phi_h . (theta - theta_h) - a phi . (theta - theta_now) + noise

where theta_h and theta_now are what depth has been corrected by. The pose xi of each frame is
marginalised out relative to each host, since the hosts' own poses have given way to the bias too.
How far the intervals between keyframes agree on theta tells its covariance, since their residuals
are far from independent; where they disagree theta is not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..frame import RgbdFrame
from ..kernels.jit import inlined, kernel, parallel_kernel
from .factors import PointFactors, information, plane_residual
from .registration import Registration

TERMS = 5  # x, y, xy, x^2, y^2; a constant cannot be told from the scale of the world
_EVERY = 4  # depth pairs of which one is used: neighbours repeat each other
_HUBER = 2.0  # in units of sqrt(chi2)
_FEWEST_INTERVALS = 6
_OVERDISPERSED = 5.0  # least variance of an interval's score: that of independent residuals is 1
_LEFT_OUT = 2.0  # factor of the variance: what all intervals have in common
_NEAREST_M = 0.1  # nearer points of a host have no meaningful direction
_NO_NORMALS = np.empty((0, 3), np.float32)
_WEAK_POSE = 1e-3 * np.eye(6)  # 1 / m^2, 1 / rad^2: keeps a system solvable


class DepthBias:
    """Estimates theta, and corrects depth by it."""

    def __init__(self, camera: PinholeCamera, sigma: float) -> None:
        """Start without a bias; `sigma` is what each theta_k may be, 0 if there is none."""
        self._camera, self._sigma = camera, sigma
        self._half_view = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
        self.theta = np.zeros(TERMS)  # that depth is corrected by
        self._gain: NDArray[np.float32] | None = None
        # Of the intervals that are over: L, v, and what the scatter of v - L theta is made of.
        self._intervals = 0
        self._L, self._v = np.zeros((TERMS, TERMS)), np.zeros(TERMS)
        self._LL = np.zeros((TERMS,) * 4)
        self._Lv, self._vv = np.zeros((TERMS,) * 3), np.zeros((TERMS, TERMS))
        self.reset(())

    def reset(self, visited: Sequence[NDArray[np.float64]]) -> None:
        """Go on in another map, whose keyframes were corrected by something else."""
        self._hosts = np.array(visited, np.float64).reshape(-1, 4, 4)
        self._thetas = np.full((len(self._hosts), TERMS), np.nan)
        self._begin_interval()

    def move(self, visited: Sequence[NDArray[np.float64]]) -> None:
        """Take the corrected poses (4, 4) of the hosts."""
        self._hosts = np.array(visited, np.float64).reshape(-1, 4, 4)

    def _begin_interval(self) -> None:
        self._system, self._right = np.zeros((TERMS, TERMS)), np.zeros(TERMS)

    def corrected(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame with its depth (H, W) divided by 1 + b."""
        return frame if self._gain is None else replace(frame, depth_m=frame.depth_m * self._gain)

    def observe(self, found: Registration) -> None:
        """Take what the residuals of a registered frame tell of theta."""
        if self._sigma == 0.0:
            return
        pairs = [(found.depth, _EVERY)] + ([(found.image, 1)] if found.image is not None else [])
        hosts = np.concatenate([factors.targets.hosts for factors, _ in pairs])
        seen = np.flatnonzero(np.bincount(hosts + 1, minlength=len(self._hosts) + 1)[1:])
        upper = np.zeros((len(seen), 7 + TERMS, 7 + TERMS))
        for factors, every in pairs:
            self._add(factors, found.T_world_cam, every, seen, upper)
        upper = upper[upper[:, 0, 0] > 0.0]
        systems = upper + np.triu(upper, 1).transpose(0, 2, 1)
        H, across = systems[:, :6, :6] + _WEAK_POSE, systems[:, :6, 6:]
        within = across.transpose(0, 2, 1) @ np.linalg.solve(H, across)
        marginal = (systems[:, 6:, 6:] - within).sum(axis=0)
        self._system += marginal[:TERMS, :TERMS]
        self._right += marginal[:TERMS, TERMS]

    def add_keyframe(self, T_world_cam: NDArray[np.float64]) -> None:
        """Add a host at a pose (4, 4): an interval ends, and depth is corrected anew after it."""
        self._hosts = np.concatenate([self._hosts, [T_world_cam]])
        self._thetas = np.concatenate([self._thetas, [self.theta]])
        if not self._system.any():
            return
        L, v = self._system, self._right
        self._intervals += 1
        self._L, self._v = self._L + L, self._v + v
        self._LL += np.multiply.outer(L, L)
        self._Lv += np.multiply.outer(L, v)
        self._vv += np.outer(v, v)
        self._begin_interval()
        if self._intervals >= _FEWEST_INTERVALS:
            self.correct_by(self._estimate())

    def _estimate(self) -> NDArray[np.float64]:
        """Return theta: least squares, shrunk by its covariance against that of the prior.

        The covariance is L^-1 (sum s s^T) L^-1 with the scores s = v - L theta of the intervals.
        """
        prior = self._sigma**2 * np.eye(TERMS)
        L = self._L + 1e-3 * np.linalg.inv(prior)
        theta = np.linalg.solve(L, self._v)
        across = np.einsum('ijk,j->ik', self._Lv, theta)
        scatter = self._vv - across - across.T
        scatter += np.einsum('ijkl,j,l->ik', self._LL, theta, theta)
        scatter *= self._intervals / (self._intervals - TERMS)
        inverse = np.linalg.inv(L)
        covariance = _LEFT_OUT * inverse @ (scatter + _OVERDISPERSED * L) @ inverse
        return np.asarray(prior @ np.linalg.solve(prior + covariance, theta))

    def correct_by(self, theta: NDArray[np.float64]) -> None:
        """Divide depth by 1 + b of theta (5,) from now on."""
        self.theta = theta
        rays = self._camera.undistortion_map
        self._gain = np.empty(rays.shape[:2], np.float32)
        _write_gain(rays, self._half_view, theta, self._gain)

    def _add(
        self,
        pairs: PointFactors,
        T_world_cam: NDArray[np.float64],
        every: int,
        seen: NDArray[np.int64],  # (S,) hosts
        upper: NDArray[np.float64],  # (S, 12, 12)
    ) -> None:
        t = pairs.targets
        rows = np.full(len(self._hosts) + 1, -1, np.int32)  # the last one of no host
        rows[seen] = np.arange(len(seen))
        normals = _NO_NORMALS if pairs.normals is None else pairs.normals
        _accumulate(
            pairs.points, pairs.covariances, normals, t.points, t.axes, t.perp, t.along,
            rows[t.hosts], T_world_cam, self._hosts[seen], self._thetas[seen], self.theta,
            self._half_view, every, upper,
        )  # fmt: skip


@inlined
def _terms(x, y, half_view):
    """Return the five phi_k at x/z, y/z; `half_view` is that of the image's edge."""
    x, y = x / half_view[0], y / half_view[1]
    return x, y, x * y, x * x - 1.0 / 3.0, y * y - 1.0 / 3.0


@parallel_kernel
def _write_gain(rays, half_view, theta, gain):
    """Write 1 / (1 + b) of the rays x/z, y/z (H, W, 2) into `gain` (H, W)."""
    t0, t1, t2, t3, t4 = theta[0], theta[1], theta[2], theta[3], theta[4]
    for v in prange(rays.shape[0]):
        for u in range(rays.shape[1]):
            p0, p1, p2, p3, p4 = _terms(rays[v, u, 0], rays[v, u, 1], half_view)
            gain[v, u] = 1.0 / (1.0 + p0 * t0 + p1 * t1 + p2 * t2 + p3 * t3 + p4 * t4)


@kernel
def _accumulate(
    points, covariances, normals, targets, axes, perp, along, hosts, T, T_hosts, thetas, theta,
    half_view, every, systems,
):  # fmt: skip
    """Add the [J B y]^T W [J B y] of each `every`-th factor to that of its host in `systems`.

    Only the upper triangles of `systems` (K, 12, 12) are written.

    `points` to `along` and `T` as in `factors`; `normals` (N, 3) of depth points, which count
    along them only, or (0, 3). `hosts` (N,) are keyframes, or -1: `T_hosts` (K, 4, 4) T_world_cam
    and `thetas` (K, 5), NaN where depth was corrected by something else. B is the derivative of
    the residual by theta, and y what it would be had depth not been corrected.
    """
    rows, e = np.zeros((3, 12)), np.zeros(3)
    for i in range(0, points.shape[0], every):
        host = hosts[i]
        if perp[i] < 0.0 or host < 0 or np.isnan(thetas[host, 0]):
            continue
        H = T_hosts[host]
        dx, dy, dz = targets[i, 0] - H[0, 3], targets[i, 1] - H[1, 3], targets[i, 2] - H[2, 3]
        z_then = H[0, 2] * dx + H[1, 2] * dy + H[2, 2] * dz
        if not z_then > _NEAREST_M:
            continue
        x_then = (H[0, 0] * dx + H[1, 0] * dy + H[2, 0] * dz) / z_then
        y_then = (H[0, 1] * dx + H[1, 1] * dy + H[2, 1] * dz) / z_then
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        then, now = _terms(x_then, y_then, half_view), _terms(x / z, y / z, half_view)
        b_then = b_now = 0.0  # that depth was corrected by
        for m in range(5):
            b_then += then[m] * thetas[host, m]
            b_now += now[m] * theta[m]
        rows[0, 0] = rows[1, 1] = rows[2, 2] = 1.0
        rows[0, 4], rows[0, 5], rows[1, 3] = z, -y, -z
        rows[1, 5], rows[2, 3], rows[2, 4] = x, y, -x
        for k in range(3):
            e[k] = -points[i, k]
            reach = T[0, k] * dx + T[1, k] * dy + T[2, k] * dz  # of mu - t_h
            for m in range(3):
                e[k] += T[m, k] * (targets[i, m] - T[m, 3])
            for m in range(5):
                rows[k, 6 + m] = reach * then[m] - points[i, k] * now[m]
            rows[k, 11] = e[k] + reach * b_then - points[i, k] * b_now
        if normals.shape[0] > 0:
            n0, n1, n2 = normals[i, 0], normals[i, 1], normals[i, 2]
            variance = plane_residual(
                points[i], covariances[i], normals[i], targets[i], axes[i], perp[i], along[i], T
            )[0]
            m00, m01, m02 = n0 * n0 / variance, n0 * n1 / variance, n0 * n2 / variance
            m11, m12, m22 = n1 * n1 / variance, n1 * n2 / variance, n2 * n2 / variance
        else:
            m00, m01, m02, m11, m12, m22 = information(
                covariances[i], axes[i], perp[i], along[i], T
            )
        square = (
            m00 * e[0] * e[0] + m11 * e[1] * e[1] + m22 * e[2] * e[2]
            + 2.0 * (m01 * e[0] * e[1] + m02 * e[0] * e[2] + m12 * e[1] * e[2])
        )  # fmt: skip
        w = _HUBER / np.sqrt(square) if square > _HUBER * _HUBER else 1.0
        for b in range(12):
            r0, r1, r2 = rows[0, b], rows[1, b], rows[2, b]
            f0 = w * (m00 * r0 + m01 * r1 + m02 * r2)
            f1 = w * (m01 * r0 + m11 * r1 + m12 * r2)
            f2 = w * (m02 * r0 + m12 * r1 + m22 * r2)
            for a in range(b + 1):
                systems[host, a, b] += rows[0, a] * f0 + rows[1, a] * f1 + rows[2, a] * f2
