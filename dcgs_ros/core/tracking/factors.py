# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Points matched to the map, with covariances, and their normal equations on SE(3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..kernels.jit import inlined, kernel
from ..kernels.small_matrix import inverse_symmetric, solve
from ..sensor import SensorNoise

_WEAK = np.eye(6)  # 1 / m^2, 1 / rad^2: keeps a system that says nothing solvable


@dataclass(frozen=True)
class Targets:
    """World points with transversely isotropic covariances: perp (I - u u^T) + along u u^T."""

    points: NDArray[np.float32]  # (N, 3) metres, world
    axes: NDArray[np.float32]  # (N, 3) unit u, world
    perp: NDArray[np.float32]  # (N,) variance across u, square metres; negative: no match
    along: NDArray[np.float32]  # (N,) variance along u, square metres
    hosts: NDArray[np.int32]  # (N,) keyframes from which they were measured; -1: another frame

    def __getitem__(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Targets:
        """Return the targets of a mask or of indices."""
        return Targets(
            self.points[keep], self.axes[keep], self.perp[keep], self.along[keep],
            self.hosts[keep],
        )  # fmt: skip

    def joined(self, other: Targets) -> Targets:
        """Return both sets together."""
        return Targets(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.axes, other.axes]),
            np.concatenate([self.perp, other.perp]),
            np.concatenate([self.along, other.along]),
            np.concatenate([self.hosts, other.hosts]),
        )

    @property
    def covariances(self) -> NDArray[np.float64]:
        """(N, 3, 3) square metres, world."""
        outer = self.axes[:, :, None] * self.axes[:, None, :]
        perp, along = self.perp[:, None, None], self.along[:, None, None]
        return np.asarray(perp * np.eye(3) + (along - perp) * outer)


def observed_from(
    points: NDArray[np.float32],  # (N, 3) metres, world
    viewpoints: NDArray[np.floating],  # (N, 3) metres, world
    sensor: SensorNoise,
    anchor: float,
    hosts: NDArray[np.int32],  # (N,)
) -> Targets:
    """Return points with Sigma_t = S(u, z; p) as seen from their viewpoints; `anchor` is p / f."""
    rays = points - viewpoints
    ranges = np.linalg.norm(rays, axis=1)
    return Targets(
        points,
        (rays / ranges[:, None]).astype(np.float32),
        np.square(anchor * ranges).astype(np.float32),
        np.square(sensor.sigma(ranges)).astype(np.float32),
        hosts,
    )


def covariances_along_rays(
    points: NDArray[np.floating],  # (N, 3) metres, camera
    perp: NDArray[np.floating],  # (N,) variance across the ray, square metres
    along: NDArray[np.floating],  # (N,) variance along the ray, square metres
) -> NDArray[np.float32]:
    """Return perp (I - v v^T) + along v v^T of the points' rays, (N, 6): xx xy xz yy yz zz."""
    v = points / np.linalg.norm(points, axis=1, keepdims=True)
    x, y, z = v.T
    k = along - perp
    out = np.column_stack(
        [perp + k * x * x, k * x * y, k * x * z, perp + k * y * y, k * y * z, perp + k * z * z]
    )
    return np.asarray(out, np.float32)


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton system of E(T exp(xi)) ~ xi^T H xi - 2 g^T xi + cost, camera frame."""

    H: NDArray[np.floating]  # (6, 6)
    g: NDArray[np.floating]  # (6,)
    cost: float

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """Return the equations of the sum of two costs."""
        return NormalEquations(self.H + other.H, self.g + other.g, self.cost + other.cost)

    def limited(self, Q: NDArray[np.float64]) -> NormalEquations:
        """Return the equations with a common motion of all points, covariance Q (6, 6), removed.

        It is marginalised: however many the points, their information on the pose is limited to
        that of Q.
        """
        both = np.empty((6, 7))
        both[:, :6], both[:, 6] = self.H, self.g
        solve(np.eye(6) + self.H @ Q, both)
        H, g = both[:, :6], both[:, 6]
        return NormalEquations(0.5 * (H + H.T), g, self.cost - float(self.g @ Q @ g))

    def apart_from(self, other: NormalEquations) -> NormalEquations:
        """Return the equations of the offset delta by which two terms place the pose apart.

        The pose is marginalised: delta = H_1^-1 g_1 - H_2^-1 g_2, with the information
        S = (H_1^-1 + H_2^-1)^-1, which is none along what either leaves open.
        """
        both = self + other
        share = np.linalg.solve(both.H + _WEAK, self.H)
        cost = both.cost - float(both.g @ np.linalg.solve(both.H + _WEAK, both.g))
        return NormalEquations(self.H - self.H @ share, self.g - share.T @ both.g, cost)

    def step(self, damping: float) -> NDArray[np.float64]:
        """Return the solution xi (6,) of (H + damping diag(H)) xi = g (Marquardt's scaling)."""
        system, xi = np.array(self.H, np.float64), np.array(self.g, np.float64)
        system.flat[::7] += damping * system.flat[::7] + 1e-9
        solve(system, xi[:, None])
        return xi


class Factor(Protocol):
    """A term of the cost."""

    def normal_equations(self, T_world_cam: NDArray[np.float64]) -> NormalEquations:
        """Return the term linearised at a pose (4, 4)."""
        ...


@dataclass(frozen=True)
class PosePrior:
    """A pose known beforehand: by how a hand moves, and by sensors beside the camera.

    The sigmas, of independent errors in the camera frame, are the hand's alone: how far from the
    pose a measurement may be, however sure the sensors are.
    """

    T_world_cam: NDArray[np.float64]  # (4, 4)
    sigma_m: float
    sigma_rad: float
    sensed: NDArray[np.float64] | None = None  # (6, 6) information of the sensors, camera frame

    def sigmas_to(
        self, T_world_cam: NDArray[np.float64], uncertain: NDArray[np.float64] | None = None
    ) -> float:
        """Return the Mahalanobis distance of a pose (4, 4) that is `uncertain` (6, 6) as well."""
        xi = se3.log(self._T_cam_world @ T_world_cam)
        covariance = np.diag(np.repeat([self.sigma_m**2, self.sigma_rad**2], 3))
        if uncertain is not None:
            covariance += uncertain
        return math.sqrt(xi @ np.linalg.solve(covariance, xi))

    def normal_equations(self, T_world_cam: NDArray[np.float64]) -> NormalEquations:
        """Return the term of the residual log(T^-1 T_prior), with the identity as Jacobian."""
        residual = -se3.log(self._T_cam_world @ T_world_cam)
        g = self._information @ residual
        return NormalEquations(self._information, g, float(residual @ g))

    @cached_property
    def _T_cam_world(self) -> NDArray[np.float64]:
        return se3.inverse(self.T_world_cam)

    @cached_property
    def _information(self) -> NDArray[np.float64]:
        """(6, 6) of the hand's motion and of the sensors together."""
        of_hand = np.diag(np.repeat([self.sigma_m**-2, self.sigma_rad**-2], 3))
        return of_hand if self.sensed is None else of_hand + self.sensed


@dataclass(frozen=True)
class PointFactors:
    """Measured points a_i with covariances D_i in the camera frame, each with its target.

    The residual, in the camera frame, is e_i = R^T (mu_i - t) - a_i with
    Omega_i = R^T Sigma_i R + D_i: the paper's d_i and Omega_i rotated by R^T, which does not
    change the cost and keeps D_i constant while the pose moves.
    """

    points: NDArray[np.float32]  # (N, 3) metres, camera
    covariances: NDArray[np.float32]  # (N, 6) xx xy xz yy yz zz, square metres, camera
    targets: Targets
    normals: NDArray[np.float32] | None = None  # (N, 3) n_i of depth points, unit, camera
    map_normals: NDArray[np.float32] | None = None  # (N, 3) n_j of their Gaussians, unit, world
    huber: float = math.inf  # delta, in units of sqrt(chi2)
    weight: float = 1.0
    Q: NDArray[np.float64] | None = None  # (6, 6) covariance of a motion common to all points

    def evaluated(
        self, T_world_cam: NDArray[np.float64]
    ) -> tuple[NormalEquations, NDArray[np.float64]]:
        """Return `normal_equations` and `chi2`, at the cost of one of them."""
        sums = np.empty((7, 7))
        chi2 = np.empty(len(self.points))
        t = self.targets
        _accumulate(
            self.points, self.covariances, t.points, t.axes, t.perp, t.along, T_world_cam,
            self.huber, sums, chi2,
        )  # fmt: skip
        equations = _weighted(sums, self.weight)
        return equations if self.Q is None else equations.limited(self.Q), chi2

    def __getitem__(self, keep: NDArray[np.bool_]) -> PointFactors:
        """Return the factors of a mask."""
        normals, map_normals = (
            None if n is None else n[keep] for n in (self.normals, self.map_normals)
        )
        return replace(
            self, points=self.points[keep], covariances=self.covariances[keep],
            targets=self.targets[keep], normals=normals, map_normals=map_normals,
        )  # fmt: skip

    def normal_equations(self, T_world_cam: NDArray[np.float64]) -> NormalEquations:
        """Return the sums of J^T Omega^-1 J and J^T Omega^-1 e, J = [I, -[a]x], Huber weighted."""
        return self.evaluated(T_world_cam)[0]

    def chi2(self, T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N,) squared Mahalanobis distances e^T Omega^-1 e; NaN without a match."""
        return self.evaluated(T_world_cam)[1]

    def across_rays(self) -> PointFactors:
        """Return factors that constrain only across the rays: what the image alone measured.

        Along the ray, where the point is from the depth image, the variance grows by 1 m^2.
        """
        n = len(self.points)
        along = covariances_along_rays(self.points, np.zeros(n), np.ones(n))
        return replace(self, covariances=self.covariances + along)

    def along_normals(self, T_world_cam: NDArray[np.float64]) -> NormalEquations:
        """Return the term of the residuals along the normals n_i alone: point to plane.

        This is the limit of an infinite association radius r: none of its tangential information
        comes from r.
        """
        sums = np.zeros((7, 7))
        t = self.targets
        _accumulate_along(
            self.points, self.covariances, self.normals, t.points, t.axes, t.perp, t.along,
            T_world_cam, sums,
        )  # fmt: skip
        return _weighted(sums, self.weight)


def _weighted(sums: NDArray[np.float64], weight: float) -> NormalEquations:
    """Return the weighted equations of the sums of [J e]^T Omega^-1 [J e] (7, 7)."""
    sums = weight * sums
    return NormalEquations(sums[:6, :6], sums[:6, 6], float(sums[6, 6]))


@kernel
def _accumulate(points, covariances, targets, axes, perp, along, T, huber, total, chi2):
    """Write the sum of [J e]^T Omega^-1 [J e] into `total` (7, 7), and `chi2` (N,).

    `points` (N, 3) metres and `covariances` (N, 6) square metres, camera; `targets` (N, 3) metres
    and `axes` (N, 3) unit, world; `perp` and `along` (N,) square metres; `T` (4, 4) T_world_cam;
    `huber` in units of sqrt(chi2). One thread: waking a second one would cost more than it saves.
    The sums are scalars, which stay in registers.
    """
    r00, r01, r02 = T[0, 0], T[0, 1], T[0, 2]
    r10, r11, r12 = T[1, 0], T[1, 1], T[1, 2]
    r20, r21, r22 = T[2, 0], T[2, 1], T[2, 2]
    t0, t1, t2 = T[0, 3], T[1, 3], T[2, 3]
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = 0.0
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = 0.0
    g0 = g1 = g2 = g3 = g4 = g5 = cost = 0.0
    for i in range(points.shape[0]):
        if perp[i] < 0.0:
            chi2[i] = np.nan
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        dx, dy, dz = targets[i, 0] - t0, targets[i, 1] - t1, targets[i, 2] - t2
        e0 = r00 * dx + r10 * dy + r20 * dz - x
        e1 = r01 * dx + r11 * dy + r21 * dz - y
        e2 = r02 * dx + r12 * dy + r22 * dz - z
        ux, uy, uz = axes[i, 0], axes[i, 1], axes[i, 2]
        u0 = r00 * ux + r10 * uy + r20 * uz
        u1 = r01 * ux + r11 * uy + r21 * uz
        u2 = r02 * ux + r12 * uy + r22 * uz
        m00, m01, m02, m11, m12, m22 = _inverse_of_sum(
            covariances[i], u0, u1, u2, perp[i], along[i]
        )
        square = (
            e0 * (m00 * e0 + 2.0 * (m01 * e1 + m02 * e2))
            + e1 * (m11 * e1 + 2.0 * m12 * e2)
            + m22 * e2 * e2
        )
        chi2[i] = square
        # Huber's rho(s) = s inside delta^2, 2 delta sqrt(s) - delta^2 beyond; weight rho'(s).
        w, rho = 1.0, square
        if square > huber * huber:
            w = huber / math.sqrt(square)
            rho = 2.0 * huber * math.sqrt(square) - huber * huber
        m00, m01, m02, m11, m12, m22 = w * m00, w * m01, w * m02, w * m11, w * m12, w * m22
        f0 = m00 * e0 + m01 * e1 + m02 * e2
        f1 = m01 * e0 + m11 * e1 + m12 * e2
        f2 = m02 * e0 + m12 * e1 + m22 * e2
        # The columns of -Omega^-1 [a]x.
        a0, a1, a2 = y * m02 - z * m01, y * m12 - z * m11, y * m22 - z * m12
        b0, b1, b2 = z * m00 - x * m02, z * m01 - x * m12, z * m02 - x * m22
        c0, c1, c2 = x * m01 - y * m00, x * m11 - y * m01, x * m12 - y * m02
        h00, h01, h02, h11, h12, h22 = (
            h00 + m00, h01 + m01, h02 + m02, h11 + m11, h12 + m12, h22 + m22,
        )  # fmt: skip
        h03, h13, h23 = h03 + a0, h13 + a1, h23 + a2
        h04, h14, h24 = h04 + b0, h14 + b1, h24 + b2
        h05, h15, h25 = h05 + c0, h15 + c1, h25 + c2
        h33 += y * a2 - z * a1
        h34 += y * b2 - z * b1
        h35 += y * c2 - z * c1
        h44 += z * b0 - x * b2
        h45 += z * c0 - x * c2
        h55 += x * c1 - y * c0
        g0, g1, g2 = g0 + f0, g1 + f1, g2 + f2
        g3 += y * f2 - z * f1
        g4 += z * f0 - x * f2
        g5 += x * f1 - y * f0
        cost += rho
    sums = (
        (h00, h01, h02, h03, h04, h05, g0),
        (h01, h11, h12, h13, h14, h15, g1),
        (h02, h12, h22, h23, h24, h25, g2),
        (h03, h13, h23, h33, h34, h35, g3),
        (h04, h14, h24, h34, h44, h45, g4),
        (h05, h15, h25, h35, h45, h55, g5),
        (g0, g1, g2, g3, g4, g5, cost),
    )
    for a in range(7):
        for b in range(7):
            total[a, b] = sums[a][b]


@inlined
def _inverse_of_sum(c, u0, u1, u2, perp, along):
    """Return (D + perp (I - u u^T) + along u u^T)^-1: xx, xy, xz, yy, yz, zz; `c` D (6,)."""
    k = along - perp
    return inverse_symmetric(
        c[0] + perp + k * u0 * u0, c[1] + k * u0 * u1, c[2] + k * u0 * u2,
        c[3] + perp + k * u1 * u1, c[4] + k * u1 * u2, c[5] + perp + k * u2 * u2,
    )  # fmt: skip


@kernel
def information(c, axis, perp, along, T):
    """Return Omega^-1 of a pair in the camera frame: xx, xy, xz, yy, yz, zz.

    `c` D (6,); `axis` (3,) world, `perp`, `along` of `Targets`; `T` (4, 4) T_world_cam, which
    `_accumulate` keeps in registers instead.
    """
    x, y, z = axis[0], axis[1], axis[2]
    u0 = T[0, 0] * x + T[1, 0] * y + T[2, 0] * z
    u1 = T[0, 1] * x + T[1, 1] * y + T[2, 1] * z
    u2 = T[0, 2] * x + T[1, 2] * y + T[2, 2] * z
    return _inverse_of_sum(c, u0, u1, u2, perp, along)


@kernel
def weighted_residual(point, c, target, axis, perp, along, T, huber):
    """Return a pair's residual e (3) and w Omega^-1, xx xy xz yy yz zz, with Huber's weight w.

    `point` (3,) camera, `target` (3,) world; the other arguments are those of `information`,
    `huber` is delta as in `PointFactors`.
    """
    dx, dy, dz = target[0] - T[0, 3], target[1] - T[1, 3], target[2] - T[2, 3]
    e0 = T[0, 0] * dx + T[1, 0] * dy + T[2, 0] * dz - point[0]
    e1 = T[0, 1] * dx + T[1, 1] * dy + T[2, 1] * dz - point[1]
    e2 = T[0, 2] * dx + T[1, 2] * dy + T[2, 2] * dz - point[2]
    m00, m01, m02, m11, m12, m22 = information(c, axis, perp, along, T)
    square = (
        e0 * (m00 * e0 + 2.0 * (m01 * e1 + m02 * e2))
        + e1 * (m11 * e1 + 2.0 * m12 * e2)
        + m22 * e2 * e2
    )
    w = huber / math.sqrt(square) if square > huber * huber else 1.0
    return (e0, e1, e2), (w * m00, w * m01, w * m02, w * m11, w * m12, w * m22)


@kernel
def plane_residual(point, c, normal, target, axis, perp, along, T):
    """Return a pair's variance along n, n . a in metres, and its residual n . (R^T (mu - t) - a).

    `point` a, `normal` n (3,) camera; `c` D (6,); `target` mu, `axis` (3,) world; `perp`, `along`
    of `Targets`; `T` (4, 4) T_world_cam.
    """
    a0, a1, a2 = normal[0], normal[1], normal[2]
    w0 = T[0, 0] * a0 + T[0, 1] * a1 + T[0, 2] * a2
    w1 = T[1, 0] * a0 + T[1, 1] * a1 + T[1, 2] * a2
    w2 = T[2, 0] * a0 + T[2, 1] * a1 + T[2, 2] * a2
    cosine = w0 * axis[0] + w1 * axis[1] + w2 * axis[2]
    variance = (
        c[0] * a0 * a0 + c[3] * a1 * a1 + c[5] * a2 * a2
        + 2.0 * (c[1] * a0 * a1 + c[2] * a0 * a2 + c[4] * a1 * a2)
        + perp + (along - perp) * cosine * cosine
    )  # fmt: skip
    depth = a0 * point[0] + a1 * point[1] + a2 * point[2]
    residual = (
        w0 * (target[0] - T[0, 3]) + w1 * (target[1] - T[1, 3]) + w2 * (target[2] - T[2, 3])
        - depth
    )  # fmt: skip
    return variance, depth, residual


@kernel
def _accumulate_along(points, covariances, normals, targets, axes, perp, along, T, total):
    """Add the point-to-plane terms to `total` (7, 7), as `_accumulate`.

    `normals` (N, 3) unit, camera; the other arguments are those of `_accumulate`.
    """
    row = np.zeros(7)
    for i in range(points.shape[0]):
        if perp[i] < 0.0:
            continue
        a0, a1, a2 = normals[i, 0], normals[i, 1], normals[i, 2]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        variance, _, row[6] = plane_residual(
            points[i], covariances[i], normals[i], targets[i], axes[i], perp[i], along[i], T
        )
        row[0], row[1], row[2] = a0, a1, a2
        row[3], row[4], row[5] = y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0
        for a in range(7):
            for b in range(a, 7):
                total[a, b] += row[a] * row[b] / variance
    for a in range(7):
        for b in range(a):
            total[a, b] = total[b, a]
