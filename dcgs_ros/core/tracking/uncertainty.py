# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How uncertain a registered pose is, from the residuals that it leaves.

Depth errors are no independent noise: neighbouring points share them, over tens of pixels by the
matching of the sensor and over the whole image by its calibration. The residuals show it, without
any truth. Three parts of the pose's covariance follow from them:

- noise, by the sandwich H^-1 (sum_c s_c s_c^T) H^-1 with the scores s_c = sum J^T Omega^-1 e of
  the cells c of the image (Huber 1967, White 1980, with clusters): whatever the points of a cell
  share is counted once. Without correlation the expectation is H^-1.
- bias, a smooth relative error of depth b(u, v) = sum_k a_k phi_k(u, v) of cosines phi_k with
  var a_k = beta^2 s_k. Its longest waves move the pose and hardly show; beta^2 is told by the
  shorter ones, by the method of moments, and s_k, which falls with the fourth power of the
  frequency as for a smooth surface, extrapolates.
- lag, an error of depth's instant: it moves the depth term along the twist.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..kernels.jit import kernel
from .factors import PointFactors, plane_residual, weighted_residual
from .registration import Registration

_COLUMNS, _ROWS = 8, 6  # cells of the image: 80 px of 640x480
_WAVES_X, _WAVES_Y = 6, 5  # cosines: half waves across the image from 0 to these, exclusive
FEIGNED_SIGMAS = 2.0  # of what independent normals may add up to by chance
_PRIOR = np.eye(6)  # 1 m, 1 rad: keeps systems solvable
_LEFT_OUT = 2.0  # factor of the variance: what the residuals of one frame do not tell
_CORRELATED = 0.8  # share of the correlation of translation with rotation that is believed


def _cosines() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return phi_k at the cells' centres (cells, K), of unit mean square, and s_k (K,)."""
    p, q = np.divmod(np.arange(_WAVES_X * _WAVES_Y), _WAVES_Y)
    x = (np.arange(_COLUMNS) + 0.5) / _COLUMNS
    y = (np.arange(_ROWS) + 0.5) / _ROWS
    across = np.cos(np.pi * np.outer(x, p)) * np.where(p > 0, np.sqrt(2.0), 1.0)
    down = np.cos(np.pi * np.outer(y, q)) * np.where(q > 0, np.sqrt(2.0), 1.0)
    phi = (down[:, None, :] * across[None, :, :]).reshape(_ROWS * _COLUMNS, -1)
    return phi, 1.0 / np.maximum(p * p + q * q, 1.0) ** 2


_PHI, _SPECTRUM = _cosines()


@dataclass(frozen=True)
class PoseUncertainty:
    """What the residuals of one frame tell of its pose; all (6, 6) of xi in T exp(xi)."""

    information: NDArray[np.float64]  # (6, 6) of independent noise, less what noise can feign
    noise: NDArray[np.float64]  # (6, 6) covariance by the sandwich
    bias: NDArray[np.float64]  # (6, 6) covariance by a relative depth bias with beta = 1
    bias_evidence: tuple[float, float]  # whose quotient, over many frames, is beta^2
    follows_depth: NDArray[np.float64]  # (6, 6) share of a common motion of the depth points
    rows: NDArray[np.float64]  # (N, 12) whitened J_n of each pair's two normals, frame's and map's

    def covariance(
        self, beta2: float, lag_sigma_s: float, twist: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the pose in the map; `twist` (6,) per second.

        What the terms leave out is in two factors, found on the synthetic sensors with measured
        defects (`kinect_measured`, `d435i_measured`): one of all, and one of the correlation of
        translation with rotation, which a few smooth modes of bias make too sure.
        """
        lag = lag_sigma_s * (self.follows_depth @ twist)
        covariance = _LEFT_OUT * (self.noise + beta2 * self.bias + np.outer(lag, lag))
        covariance[:3, 3:] *= _CORRELATED
        covariance[3:, :3] *= _CORRELATED
        return covariance


def pose_uncertainty(
    found: Registration, camera: PinholeCamera, variance: float = 1.0
) -> PoseUncertainty:
    """Return the uncertainty of a registration.

    `variance` is that of a residual in units of its covariance, where those are not metric (the
    ablations with normalised covariances). The sandwich and the bias do not depend on it.
    """
    view = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height])
    depth, cross, rows = _depth_cells(found.depth, found.T_world_cam, view)
    image = _image_cells(found.image, found.T_world_cam, view)
    by_image = found.image_equations
    H_image = np.zeros((6, 6)) if by_image is None else by_image.H
    H_depth = _unfeigned(cross, rows, H_image)
    # A motion common to all depth points, covariance Q, as in NormalEquations.limited.
    Q = np.zeros((6, 6)) if found.depth.Q is None else found.depth.Q
    M = np.linalg.inv(np.eye(6) + H_depth @ Q)
    limited = M @ H_depth
    H = 0.5 * (limited + limited.T) + H_image
    inverse = np.linalg.inv(H + variance * _PRIOR)
    scores = depth[:, :6] @ M.T + image[:, :6]
    cells = int(np.count_nonzero(scores.any(axis=1)))
    meat = scores.T @ scores * (cells / max(cells - 1, 1))
    meat += variance * (limited @ Q @ limited.T + variance * _PRIOR)
    response = inverse @ (M @ (depth[:, 6:12].T @ _PHI) + image[:, 6:].T @ _PHI)
    return PoseUncertainty(
        information=H / variance,
        noise=inverse @ meat @ inverse,
        bias=(response * _SPECTRUM) @ response.T,
        bias_evidence=_bias_evidence(depth, found.sharp_depth.H + H_image, found.inliers),
        follows_depth=inverse @ limited,
        rows=rows,
    )


def _unfeigned(
    cross: NDArray[np.float64], rows: NDArray[np.float64], H_image: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the point-to-plane information (6, 6), of which noise of the normals feigns none.

    With one normal of each pair from the frame and one from the map, sum J_n^T J_m / variance,
    independent errors of the two cancel in the mean; with the frame's twice they add up to
    information that a plane does not have. What remains by chance has, in a direction u, the
    variance sum ((J_n u) (J_m u) / variance)^2, and twice its root is taken off.
    """
    crossed = 0.5 * (cross + cross.T)
    eigenvalues, U = np.linalg.eigh(crossed + H_image)
    chance = np.zeros((1, 6))
    sum_chance(rows, np.zeros(len(rows), np.int64), U[None], chance)
    by_image = np.einsum('ak,ab,bk->k', U, H_image, U)
    certain = np.maximum(eigenvalues - by_image - FEIGNED_SIGMAS * np.sqrt(chance[0]), 0.0)
    return np.asarray((U * certain) @ U.T)


def _bias_evidence(
    cells: NDArray[np.float64], H: NDArray[np.floating], pairs: int
) -> tuple[float, float]:
    """Return numerator and denominator of beta^2 by the method of moments.

    The scores c_k = sum phi_k d e / variance, d = n . a, of the residuals that the pose leaves
    have the covariance sigma^2 N + beta^2 N S N, where N is the Gram matrix of the phi_k d without
    what the pose explains.
    """
    across = cells[:, 6:12].T @ _PHI
    gram = _PHI.T @ (cells[:, 12:13] * _PHI)
    N = gram - across.T @ np.linalg.solve(H + _PRIOR, across)
    c = _PHI.T @ cells[:, 13]
    sigma2 = cells[:, 14].sum() / max(pairs - 6, 1)
    return float(c @ c - sigma2 * np.trace(N)), float(np.square(N).sum(axis=0) @ _SPECTRUM)


def _depth_cells(
    pairs: PointFactors, T: NDArray[np.float64], view: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the sums of `_sum_depth`: of cells (C, 15), crossed (6, 6), and the rows (N, 12)."""
    cells = np.zeros((_ROWS * _COLUMNS, 15))
    cross, rows = np.zeros((6, 6)), np.zeros((len(pairs.points), 12))
    t = pairs.targets
    _sum_depth(
        pairs.points, pairs.covariances, pairs.normals, pairs.map_normals, t.points, t.axes,
        t.perp, t.along, T, view, cells, cross, rows,
    )  # fmt: skip
    return cells, cross, rows


def _image_cells(
    pairs: PointFactors | None, T: NDArray[np.float64], view: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the scores and responses to a relative depth of cells (C, 12)."""
    cells = np.zeros((_ROWS * _COLUMNS, 12))
    if pairs is not None:
        t = pairs.targets
        _sum_image(
            pairs.points, pairs.covariances, t.points, t.axes, t.perp, t.along, T, pairs.huber,
            view, cells,
        )  # fmt: skip
        cells *= pairs.weight
    return cells


@kernel
def _cell(x, y, z, view):
    """Return the cell of the image that a point (x, y, z) of the camera frame is in.

    `view` (6,) fx, fy, cx, cy, width, height. The lens is ignored: cells are coarse.
    """
    column = int(_COLUMNS * (view[0] * x / z + view[2] + 0.5) / view[4])
    row = int(_ROWS * (view[1] * y / z + view[3] + 0.5) / view[5])
    return min(max(row, 0), _ROWS - 1) * _COLUMNS + min(max(column, 0), _COLUMNS - 1)


@kernel
def _sum_depth(
    points, covariances, normals, map_normals, targets, axes, perp, along, T, view, cells, cross,
    rows,
):  # fmt: skip
    """Add the point-to-plane terms to their cells, and those of crossed normals to `cross`.

    `points`, `normals` (N, 3), camera, `covariances` (N, 6), `targets`, `axes`, `map_normals`
    (N, 3), world, `perp`, `along` (N,) as in `PointFactors`; `T` (4, 4) T_world_cam; `view` as in
    `_cell`. With J the row n^T [I, -[a]x], w its weight, e its residual and d = n . a, adds to
    `cells` (C, 15) J w e (6), J w d (6), w d d, w d e and w e e, and to `cross` (6, 6) the
    J_n^T w J_m of the frame's and the map's normal. Writes sqrt(w) J_n and sqrt(w) J_m into
    `rows` (N, 12), zeros before.
    """
    for i in range(points.shape[0]):
        if perp[i] < 0.0:
            continue
        a0, a1, a2 = normals[i, 0], normals[i, 1], normals[i, 2]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        variance, d, e = plane_residual(
            points[i], covariances[i], normals[i], targets[i], axes[i], perp[i], along[i], T
        )
        m0, m1, m2 = map_normals[i, 0], map_normals[i, 1], map_normals[i, 2]
        b0 = T[0, 0] * m0 + T[1, 0] * m1 + T[2, 0] * m2
        b1 = T[0, 1] * m0 + T[1, 1] * m1 + T[2, 1] * m2
        b2 = T[0, 2] * m0 + T[1, 2] * m1 + T[2, 2] * m2
        s = 1.0 / np.sqrt(variance)
        row = rows[i]
        row[0], row[1], row[2] = s * a0, s * a1, s * a2
        row[3], row[4], row[5] = (
            s * (y * a2 - z * a1),
            s * (z * a0 - x * a2),
            s * (x * a1 - y * a0),
        )
        row[6], row[7], row[8] = s * b0, s * b1, s * b2
        row[9], row[10], row[11] = (
            s * (y * b2 - z * b1),
            s * (z * b0 - x * b2),
            s * (x * b1 - y * b0),
        )
        for a in range(6):
            for b in range(6):
                cross[a, b] += row[a] * row[6 + b]
        d, e = s * d, s * e
        cell = cells[_cell(x, y, z, view)]
        for a in range(6):
            cell[a] += row[a] * e
            cell[6 + a] += row[a] * d
        cell[12] += d * d
        cell[13] += d * e
        cell[14] += e * e


@kernel
def sum_chance(rows, slots, U, total):
    """Add the squares of (J_n u_k) (J_m u_k) to `total` (K, 6), `U` (K, 6, 6) of each slot.

    `rows` (N, 12) are those of `PoseUncertainty`, each of one of the `slots` (N,).
    """
    for i in range(rows.shape[0]):
        slot = slots[i]
        for k in range(6):
            p = q = 0.0
            for a in range(6):
                p += rows[i, a] * U[slot, a, k]
                q += rows[i, 6 + a] * U[slot, a, k]
            total[slot, k] += (p * q) ** 2


@kernel
def _sum_image(points, covariances, targets, axes, perp, along, T, huber, view, cells):
    """Add J^T W e and J^T W a, W = w Omega^-1 with Huber's weight w, to `cells` (C, 12).

    The arguments are those of `_sum_depth`; `huber` is delta as in `PointFactors`.
    """
    for i in range(points.shape[0]):
        if perp[i] < 0.0:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        (e0, e1, e2), (m00, m01, m02, m11, m12, m22) = weighted_residual(
            points[i], covariances[i], targets[i], axes[i], perp[i], along[i], T, huber
        )
        f0 = m00 * e0 + m01 * e1 + m02 * e2
        f1 = m01 * e0 + m11 * e1 + m12 * e2
        f2 = m02 * e0 + m12 * e1 + m22 * e2
        g0 = m00 * x + m01 * y + m02 * z
        g1 = m01 * x + m11 * y + m12 * z
        g2 = m02 * x + m12 * y + m22 * z
        cell = cells[_cell(x, y, z, view)]
        for k0, h0, h1, h2 in ((0, f0, f1, f2), (6, g0, g1, g2)):
            cell[k0] += h0
            cell[k0 + 1] += h1
            cell[k0 + 2] += h2
            cell[k0 + 3] += y * h2 - z * h1
            cell[k0 + 4] += z * h0 - x * h2
            cell[k0 + 5] += x * h1 - y * h0
