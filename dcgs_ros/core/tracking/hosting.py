# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which keyframes a pose is placed relative to, and what each of them holds of it.

The walls of a corridor, whoever saw them first, do not hold a camera along it: that do a few
landmarks, of the last keyframe mostly. So the hosts share a pose direction by direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..covariances import FLOOR
from ..kernels.jit import kernel
from .factors import weighted_residual
from .registration import Registration
from .uncertainty import FEIGNED_SIGMAS, sum_chance

_MOST = 6  # hosts of a pose, those that hold most
_PRIOR = np.eye(6)  # 1 / m^2, 1 / rad^2: what nothing holds goes on from the last keyframe
_LEAST = 1e-12  # eigenvalue that rounding may have made negative
VAGUE = 1e-2 * np.eye(6)  # 10 m, 10 rad: along what a few hosts do not hold


@dataclass(frozen=True)
class Hosts:
    """Keyframes that hold a pose, in the order of their numbers."""

    keyframes: NDArray[np.int32]  # (H,)
    information: NDArray[np.float64]  # (H, 6, 6) of each on the pose; their sum is C^-1

    @classmethod
    def none(cls) -> Hosts:
        """Return those of a pose that begins a map."""
        return cls(np.empty(0, np.int32), np.empty((0, 6, 6)))

    @classmethod
    def only(cls, keyframe: int, covariance: NDArray[np.float64]) -> Hosts:
        """Return one that holds all of a pose with this covariance (6, 6)."""
        whole = np.asarray(np.linalg.inv(covariance + FLOOR))
        return cls(np.array([keyframe], np.int32), whole[None])

    def inherited(self, theirs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what a pose's covariance (6, 6) is with the hosts' own (H, 6, 6).

        All are of the camera's frame. Relative to the first n hosts the pose is as sure as they
        make it, and they are as sure as the least sure of them, whatever their correlation is. Of
        these bounds the smallest counts: back where the map began it is that of the oldest hosts.
        """
        if not len(self.keyframes):
            return np.zeros((6, 6))
        together = np.cumsum(self.information, axis=0)
        together[:-1] += VAGUE
        sizes = np.trace(theirs, axis1=1, axis2=2)
        worst = [int(np.argmax(sizes[: n + 1])) for n in range(len(sizes))]
        bounds = theirs[worst] + np.linalg.inv(together)
        return np.asarray(bounds[np.argmin(np.trace(bounds, axis1=1, axis2=2))])

    def within_reach(
        self, theirs: NDArray[np.float64], last: NDArray[np.float64], reach_m: float
    ) -> Hosts:
        """Return those that are known to within a distance relative to the last keyframe.

        `theirs` (H, 6, 6) and that of the `last` one are covariances in the world, camera frame.
        Where a camera comes back to an old part of the map and may be beside it by more than the
        association reaches, what matches there is chance; and so is what still matches the part
        that it was found away from. The newest of those that are left gets that share.
        """
        apart = np.abs(np.linalg.eigvalsh((last - theirs)[:, :3, :3])).max(axis=1)
        known = apart < reach_m**2
        if not known.any():
            return self
        information = self.information[known]
        information[-1] += self.information[~known].sum(axis=0)
        return Hosts(self.keyframes[known], information)


def hosts_of(
    found: Registration,
    rows: NDArray[np.float64],  # (N, 12) of `PoseUncertainty`
    covariance: NDArray[np.float64],  # (6, 6) of the pose in the map
    last: int,  # the keyframe before
) -> Hosts:
    """Return the keyframes that hold a registered pose, by what their Gaussians tell of it.

    With P the axes in which both `covariance` C and the sum H of what the hosts tell, H_k, are
    diagonal, P^T C^-1 P = I and P^T H P = D, host k has P^-T D^(-1/2) P^T H_k P D^(-1/2) P^-1 of
    C^-1. A landmark of a frame between keyframes is taken as one of the last keyframe.
    """
    keyframes, held = _held(found, rows, last)
    root = _power(covariance, 0.5)
    scales, U = np.linalg.eigh(root.T @ held.sum(axis=0) @ root)
    P = root @ U
    half = P / np.sqrt(np.maximum(scales, _LEAST))
    shares = half.T @ held @ half  # their sum is the identity
    best = np.sort(np.argsort(-np.trace(shares, axis1=1, axis2=2), kind='stable')[:_MOST])
    shares = shares[best]
    whole = _power(shares.sum(axis=0), -0.5)  # 1 where none was left out
    back = whole @ np.linalg.inv(P)
    return Hosts(keyframes[best], back.T @ shares @ back)


def _held(
    found: Registration, rows: NDArray[np.float64], last: int
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return keyframes (K,) and the information (K, 6, 6) that their Gaussians give on the pose.

    That of depth is with crossed normals, and less what noise can feign, as in `uncertainty`.
    """
    of_depth, image = found.depth.targets.hosts, found.image
    of_image = np.empty(0, np.int32) if image is None else image.targets.hosts
    of_image = np.where(of_image < 0, last, of_image)
    matched = np.bincount(np.concatenate([of_depth + 1, of_image + 1, [last + 1]]))[1:] > 0
    keyframes = np.flatnonzero(matched)
    held = np.zeros((len(keyframes), 6, 6))
    places = np.cumsum(matched) - 1  # of each keyframe in `keyframes`
    slots = places[of_depth]
    _sum_crossed(rows, slots, held)
    eigenvalues, U = np.linalg.eigh(_symmetric(held))
    chance = np.zeros((len(keyframes), 6))
    sum_chance(rows, slots, U, chance)
    certain = np.maximum(eigenvalues - FEIGNED_SIGMAS * np.sqrt(chance), 0.0)
    held = (U * certain[:, None]) @ U.transpose(0, 2, 1)
    if image is not None:
        slots, t = places[of_image], image.targets
        _sum_landmarks(
            image.points, image.covariances, t.points, t.axes, t.perp, t.along,
            found.T_world_cam, image.huber, image.weight, slots, held,
        )  # fmt: skip
    held[places[last]] += _PRIOR
    return keyframes.astype(np.int32), held


def _power(matrix: NDArray[np.floating], exponent: float) -> NDArray[np.float64]:
    """Return the power of a matrix (6, 6) that is symmetric and, but for rounding, positive."""
    eigenvalues, U = np.linalg.eigh(matrix)
    return np.asarray((U * np.maximum(eigenvalues, _LEAST) ** exponent) @ U.T)


def _symmetric(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.5 * (matrices + np.swapaxes(matrices, -1, -2))


@kernel
def _sum_crossed(rows, slots, total):
    """Add the J_n^T J_m of `rows` (N, 12) to `total` (K, 6, 6) of their `slots` (N,)."""
    for i in range(rows.shape[0]):
        block = total[slots[i]]
        for a in range(6):
            for b in range(6):
                block[a, b] += rows[i, a] * rows[i, 6 + b]


@kernel
def _sum_landmarks(
    points, covariances, targets, axes, perp, along, T, huber, weight, slots, total
):
    """Add J^T W J, J = [I, -[a]x], of landmarks to `total` (K, 6, 6) of their `slots` (N,).

    The other arguments are those of `factors`.
    """
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        _, (m00, m01, m02, m11, m12, m22) = weighted_residual(
            points[i], covariances[i], targets[i], axes[i], perp[i], along[i], T, huber
        )
        block = total[slots[i]]
        columns = (
            (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, -z, y), (z, 0.0, -x),
            (-y, x, 0.0),
        )  # fmt: skip
        for b, (j0, j1, j2) in enumerate(columns):
            f0 = weight * (m00 * j0 + m01 * j1 + m02 * j2)
            f1 = weight * (m01 * j0 + m11 * j1 + m12 * j2)
            f2 = weight * (m02 * j0 + m12 * j1 + m22 * j2)
            block[0, b] += f0
            block[1, b] += f1
            block[2, b] += f2
            block[3, b] += y * f2 - z * f1
            block[4, b] += z * f0 - x * f2
            block[5, b] += x * f1 - y * f0
