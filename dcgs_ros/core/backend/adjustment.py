# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Bundle adjustment: keyframes' poses from the corners that they see, and from odometry and loops.

A corner of the world X, tracked from frame to frame, is seen by the keyframes k along the rays
(x/z, y/z) and at the depths z. With q = T_k^-1 X the residuals are

    (q_x / q_z - x, q_y / q_z - y) f / sigma_px      and      (q_z - z) / sigma_z,

sigma_z^2 being that of the sensor's noise and of its smooth relative bias. The depth of many more
points is in the edges: each keyframe as it was registered against the map, with its covariance.
Points are eliminated (Schur complement; Triggs et al. 2000), poses are T_k exp(xi).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config
from ..kernels.jit import kernel
from ..kernels.small_matrix import inverse_symmetric
from ..keyframe import Sightings
from . import linearisation
from .block_structure import BlockStructure
from .edges import Edge, EdgeArrays

_HUBER = 2.0  # standard deviations of a ray, and of a depth
_NEAREST_M = 0.05
_STEPS = 12
_SETTLED = 1e-3  # relative decrease of the cost below which no further step is taken
_WEAK_POINT = 1e-6  # 1 / m^2: keeps a point solvable that two rays hardly hold
_DAMPING = 1e-6  # of the diagonal
_LOOSER = 30.0  # factor of the damping after a step that made it worse


@dataclass(frozen=True)
class Tracks:
    """What K keyframes see of L corners: N sightings, in the order of their corners."""

    starts: NDArray[np.int64]  # (L + 1,) first sighting of each corner, and N
    keyframes: NDArray[np.int32]  # (N,)
    rays: NDArray[np.float32]  # (N, 2) undistorted x/z, y/z
    depths_m: NDArray[np.float32]  # (N,) 0: none

    @classmethod
    def of(cls, sightings: Sequence[Sightings]) -> Tracks:
        """Collect the corners that two or more of the keyframes see, one of them with depth."""
        sightings = list(sightings) or [Sightings.none()]
        ids = np.concatenate([s.ids for s in sightings])
        keyframes = np.repeat(np.arange(len(sightings)), [len(s.ids) for s in sightings])
        depths = np.concatenate([s.depths_m for s in sightings])
        order = np.argsort(ids, kind='stable')
        _, corner, counts = np.unique(ids[order], return_inverse=True, return_counts=True)
        measured = np.bincount(corner, depths[order] > 0.0)
        kept = ((counts > 1) & (measured > 0))[corner]
        order, corner = order[kept], corner[kept]
        starts = np.flatnonzero(np.diff(corner, prepend=-1, append=-1))
        rays = np.concatenate([s.rays for s in sightings])
        return cls(
            starts.astype(np.int64), keyframes[order].astype(np.int32), rays[order], depths[order]
        )

    def points(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the corners (L, 3) in the world: the means of where they were measured."""
        local = np.column_stack([self.rays, np.ones(len(self.rays))]) * self.depths_m[:, None]
        T = poses[self.keyframes]
        world = np.einsum('nij,nj->ni', T[:, :3, :3], local) + T[:, :3, 3]
        weights = (self.depths_m > 0.0).astype(np.float64)
        sums = np.add.reduceat(world * weights[:, None], self.starts[:-1])
        return np.asarray(sums / np.add.reduceat(weights, self.starts[:-1])[:, None])


def adjust(
    poses: NDArray[np.float64],
    tracks: Tracks,
    edges: Sequence[Edge],
    fixed: Collection[int],
    camera: PinholeCamera,
    config: Config,
) -> NDArray[np.float64]:
    """Return better poses (K, 4, 4) of the keyframes that are not `fixed`.

    `edges` are odometry, and loops that are believed: they count in full.
    """
    if len(poses) == len(set(fixed)):
        return poses
    system = _System(tracks, EdgeArrays.of(edges), len(poses), fixed, camera, config)
    points = tracks.points(poses)
    cost, damping = system.linearise(poses, points), _DAMPING
    for _ in range(_STEPS):
        trial, moved = system.step(poses, points, damping)
        before = cost
        cost = system.linearise(trial, moved)
        if cost > before:
            damping *= _LOOSER
            cost = system.linearise(poses, points)
            continue
        poses, points, damping = trial, moved, max(damping / _LOOSER, _DAMPING)
        if before - cost <= _SETTLED * before:
            break
    return np.array([se3.orthonormalised(T) for T in poses])


class _System:
    """The normal equations of poses, after the points are eliminated, block by block."""

    def __init__(
        self,
        tracks: Tracks,
        edges: EdgeArrays,
        poses: int,
        fixed: Collection[int],
        camera: PinholeCamera,
        config: Config,
    ) -> None:
        self._tracks, self._edges = tracks, edges
        free = np.ones(poses, np.bool_)
        free[list(fixed)] = False
        self._nodes = np.where(free, np.cumsum(free) - 1, -1)
        self._free = int(free.sum())
        sensor = config.sensor
        self._sensor = (
            camera.focal / config.landmarks.sigma_px, sensor.a_m, sensor.b_per_m,
            sensor.depth_bias,
        )  # fmt: skip
        pairs = np.concatenate([_pairs_of(tracks), np.stack([edges.a, edges.b], axis=1)])
        self._structure = BlockStructure(self._nodes[pairs], self._free)
        seen = len(pairs) - len(edges.a)
        self._track_slots = self._structure.slots[:seen]
        self._edge_slots = self._structure.slots[seen:]

    def linearise(self, poses: NDArray[np.float64], points: NDArray[np.float64]) -> float:
        """Build the equations at poses (K, 4, 4) and points (L, 3); return the cost."""
        tracks, edges = self._tracks, self._edges
        self._blocks = np.zeros((self._structure.blocks, 6, 6))
        self._gradient = np.zeros((self._free, 6))
        self._crosses = np.zeros((len(tracks.keyframes), 6, 3))  # of poses and points
        self._inverses = np.zeros((len(points), 3, 3))
        self._pulls = np.zeros((len(points), 3))
        cost = _accumulate(
            tracks.starts, tracks.keyframes, tracks.rays, tracks.depths_m, poses, points,
            self._sensor, self._nodes, self._track_slots, self._blocks, self._gradient,
            self._crosses, self._inverses, self._pulls,
        )  # fmt: skip
        errors = np.empty((len(edges.a), 6))
        chi2, one = np.empty(len(edges.a)), np.ones(len(edges.a))
        linearisation.residuals(poses, edges.a, edges.b, edges.T_b_a, errors)
        linearisation.chi2(errors, edges.information, chi2)
        linearisation.accumulate(
            poses, edges.a, edges.b, errors, edges.information, one, self._edge_slots,
            self._nodes, self._blocks, self._gradient,
        )  # fmt: skip
        return float(cost + chi2.sum())

    def step(
        self, poses: NDArray[np.float64], points: NDArray[np.float64], damping: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return poses and points after a step of the equations built last."""
        xi = self._structure.solve(self._blocks, self._gradient, damping)
        trial = np.empty_like(poses)
        linearisation.step(poses, self._nodes, xi, trial)
        tracks = self._tracks
        moved = points.copy()
        _move_points(
            tracks.starts, tracks.keyframes, self._nodes, xi, self._crosses, self._inverses,
            self._pulls, moved,
        )  # fmt: skip
        return trial, moved


def _pairs_of(tracks: Tracks) -> NDArray[np.int32]:
    """Return every pair (P, 2) of sightings' keyframes of one corner, of each with itself too.

    In the order in which `_accumulate` comes to them.
    """
    counts = np.diff(tracks.starts)
    pairs = np.empty((int(np.sum(counts * (counts + 1) // 2)), 2), np.int32)
    _write_pairs(tracks.starts, tracks.keyframes, pairs)
    return pairs


@kernel
def _write_pairs(starts, keyframes, pairs):
    """Write the keyframes of sightings i <= j of each corner into `pairs` (P, 2)."""
    n = 0
    for corner in range(len(starts) - 1):
        for i in range(starts[corner], starts[corner + 1]):
            for j in range(i, starts[corner + 1]):
                pairs[n, 0], pairs[n, 1] = keyframes[i], keyframes[j]
                n += 1


@kernel
def _accumulate(
    starts, keyframes, rays, depths, poses, points, sensor, nodes, slots, blocks, gradient,
    crosses, inverses, pulls,
):  # fmt: skip
    """Add the equations of all corners to `blocks` (B, 6, 6) and `gradient` (F, 6); return cost.

    `slots` (P, 4) are the blocks of each pair of sightings, in the order of `_write_pairs`: ii,
    ij, ji, jj; -1: fixed. Writes what the points' steps need: `crosses` (N, 6, 3),
    `inverses` (L, 3, 3) of the points' blocks, and `pulls` (L, 3), their gradients.
    """
    cost, pair = 0.0, 0
    J_pose, J_point, e = np.zeros((3, 6)), np.zeros((3, 3)), np.zeros(3)
    for corner in range(len(points)):
        first, end = starts[corner], starts[corner + 1]
        V = np.zeros((3, 3))
        for i in range(first, end):
            node = nodes[keyframes[i]]
            cost += _sighting(
                rays[i], depths[i], poses[keyframes[i]], points[corner], sensor, e, J_pose, J_point
            )
            V += J_point.T @ J_point
            pulls[corner] += e @ J_point
            crosses[i] = J_pose.T @ J_point
            if node >= 0:
                gradient[node] += e @ J_pose
                blocks[slots[pair, 0]] += J_pose.T @ J_pose
            pair += end - i
        pair -= (end - first) * (end - first + 1) // 2
        inverse = _inverted(V)
        inverses[corner] = inverse
        for i in range(first, end):
            node, gain = nodes[keyframes[i]], crosses[i] @ inverse
            if node >= 0:
                gradient[node] -= gain @ pulls[corner]
            for j in range(i, end):
                if node >= 0 and nodes[keyframes[j]] >= 0:
                    shared = gain @ crosses[j].T
                    blocks[slots[pair, 1]] -= shared
                    if j > i:
                        blocks[slots[pair, 2]] -= shared.T
                pair += 1
    return cost


@kernel
def _sighting(ray, depth, T, point, sensor, e, J_pose, J_point):
    """Write weighted residual (3,) and derivatives (3, 6), (3, 3) of a sighting; return its cost.

    `sensor` is (f / sigma_px, a_m, b_per_m, relative bias). Huber's weights are of the ray as a
    whole and of the depth.
    """
    per_unit, a, b, bias = sensor
    q = np.zeros(3)
    for k in range(3):
        for m in range(3):
            q[k] += T[m, k] * (point[m] - T[m, 3])
    e[:] = 0.0
    J_pose[:] = 0.0
    J_point[:] = 0.0
    if not q[2] > _NEAREST_M:
        return 0.0
    s = per_unit / q[2]
    e[0], e[1] = per_unit * q[0] / q[2] - per_unit * ray[0], s * q[1] - per_unit * ray[1]
    size = math.sqrt(e[0] * e[0] + e[1] * e[1])
    w = math.sqrt(_HUBER / size) if size > _HUBER else 1.0
    cost = size * size if size <= _HUBER else _HUBER * (2.0 * size - _HUBER)
    J = np.zeros((3, 3))
    J[0, 0], J[0, 2] = w * s, -w * s * q[0] / q[2]
    J[1, 1], J[1, 2] = w * s, -w * s * q[1] / q[2]
    e[0], e[1] = w * e[0], w * e[1]
    if depth > 0.0:
        t = 1.0 / math.sqrt((a + b * depth * depth) ** 2 + (bias * depth) ** 2)
        size = t * (q[2] - depth)
        w = math.sqrt(_HUBER / abs(size)) if abs(size) > _HUBER else 1.0
        cost += size * size if abs(size) <= _HUBER else _HUBER * (2.0 * abs(size) - _HUBER)
        e[2], J[2, 2] = w * size, w * t
    for k in range(3):  # q = R^T (X - t): dq = -rho + [q] phi under T exp(rho, phi)
        J_pose[k, 0], J_pose[k, 1], J_pose[k, 2] = -J[k, 0], -J[k, 1], -J[k, 2]
        J_pose[k, 3] = J[k, 1] * q[2] - J[k, 2] * q[1]
        J_pose[k, 4] = J[k, 2] * q[0] - J[k, 0] * q[2]
        J_pose[k, 5] = J[k, 0] * q[1] - J[k, 1] * q[0]
        for m in range(3):
            J_point[k, m] = J[k, 0] * T[m, 0] + J[k, 1] * T[m, 1] + J[k, 2] * T[m, 2]
    return cost


@kernel
def _inverted(V):
    """Return the inverse of a symmetric matrix (3, 3), which `_WEAK_POINT` keeps from singular."""
    xx, xy, xz, yy, yz, zz = inverse_symmetric(
        V[0, 0] + _WEAK_POINT, V[0, 1], V[0, 2], V[1, 1] + _WEAK_POINT, V[1, 2],
        V[2, 2] + _WEAK_POINT,
    )  # fmt: skip
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@kernel
def _move_points(starts, keyframes, nodes, xi, crosses, inverses, pulls, points):
    """Move `points` (L, 3) by what the step of the poses, `xi` (F, 6), leaves of their pulls."""
    for corner in range(len(points)):
        pull = pulls[corner].copy()
        for i in range(starts[corner], starts[corner + 1]):
            node = nodes[keyframes[i]]
            if node >= 0:
                pull += xi[node] @ crosses[i]
        points[corner] -= inverses[corner] @ pull
