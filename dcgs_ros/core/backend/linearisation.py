# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Residuals of the edges of a pose graph, and their normal equations block by block.

The residual of an edge is e = log(T_a_b^-1 T_a^-1 T_b). With T exp(xi) on both ends its derivative
is J_b = J_r^-1(e) with respect to b, and J_a = -J_b Ad(T_b^-1 T_a).
"""

from __future__ import annotations

import math

import numpy as np

from ..kernels.jit import kernel
from ..se3 import _exp, _log_rotation, _log_translation

_NEAR_PI = math.pi - 1e-3  # as in se3: the sine is too small to give the axis
_SERIES = 0.05  # rad: below, the series of the coefficients is exact to 1e-10


@kernel
def residuals(poses, a, b, T_b_a, out):
    """Write the residuals of edges `a` (E,), `b` (E,), `T_b_a` (E, 4, 4) into `out` (E, 6)."""
    for n in range(len(a)):
        _log(T_b_a[n] @ _relative(poses[a[n]], poses[b[n]]), out[n])


@kernel
def chi2(errors, information, out):
    """Write e^T W e of `errors` (E, 6) with `information` (E, 6, 6) into `out` (E,)."""
    for n in range(len(errors)):
        total = 0.0
        for i in range(6):
            for j in range(6):
                total += errors[n, i] * information[n, i, j] * errors[n, j]
        out[n] = total


@kernel
def accumulate(poses, a, b, errors, information, weights, slots, nodes, blocks, gradient):
    """Add J^T W J of weighted edges to `blocks` (B, 6, 6) and J^T W e to `gradient` (N, 6).

    `slots` (E, 4) are the blocks aa, ab, ba and bb of each edge, `nodes` (K,) the row of each
    pose in the system; -1: it is fixed. Edges are added in their order, so the sum is always the
    same.
    """
    for n in range(len(a)):
        if weights[n] == 0.0:
            continue
        J_b = right_jacobian_inverse(errors[n])
        J_a = -J_b @ _adjoint(_relative(poses[b[n]], poses[a[n]]))
        W_a = weights[n] * (information[n] @ J_a)
        W_b = weights[n] * (information[n] @ J_b)
        if slots[n, 0] >= 0:
            blocks[slots[n, 0]] += J_a.T @ W_a
            gradient[nodes[a[n]]] += errors[n] @ W_a
        if slots[n, 3] >= 0:
            blocks[slots[n, 3]] += J_b.T @ W_b
            gradient[nodes[b[n]]] += errors[n] @ W_b
        if slots[n, 1] >= 0:
            cross = J_a.T @ W_b
            blocks[slots[n, 1]] += cross
            blocks[slots[n, 2]] += cross.T


@kernel
def step(poses, nodes, xi, out):
    """Write T exp(xi) of `poses` (K, 4, 4) with `xi` (N, 6) at `nodes` (K,) into `out`."""
    T = np.empty((4, 4))
    for k in range(len(poses)):
        out[k] = poses[k]
        if nodes[k] >= 0:
            _exp(xi[nodes[k]], T)
            out[k] = poses[k] @ T


@kernel
def right_jacobian_inverse(xi):
    """Return J_r^-1 (6, 6) with log(exp(xi) exp(d)) = xi + J_r^-1(xi) d + ...

    It is I + ad/2 + p ad^2 + q ad^4, because ad (6, 6) of a twist satisfies
    ad^5 + 2 angle^2 ad^3 + angle^4 ad = 0 (D'Eleuterio and Barfoot 2022).
    """
    x2 = xi[3] ** 2 + xi[4] ** 2 + xi[5] ** 2
    x = math.sqrt(x2)
    if x < _SERIES:
        p, q = 1.0 / 12.0 - x2 * x2 / 30240.0, -1.0 / 720.0 - x2 / 15120.0
    else:
        sine, versine = math.sin(x), 2.0 * math.sin(0.5 * x) ** 2
        p = 2.0 / x2 - (x + 3.0 * sine) / (4.0 * x * versine)
        q = 1.0 / (x2 * x2) - (x + sine) / (4.0 * x2 * x * versine)
    ad = np.zeros((6, 6))
    _hat(xi[3:], ad[:3, :3])
    _hat(xi[3:], ad[3:, 3:])
    _hat(xi[:3], ad[:3, 3:])
    ad2 = ad @ ad
    return np.eye(6) + 0.5 * ad + p * ad2 + q * (ad2 @ ad2)


@kernel
def _hat(v, out):
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]


@kernel
def _adjoint(T):
    """Return the same as `se3.adjoint`."""
    Ad = np.zeros((6, 6))
    cross = np.zeros((3, 3))
    _hat(T[:3, 3], cross)
    R = np.ascontiguousarray(T[:3, :3])
    Ad[:3, :3] = R
    Ad[3:, 3:] = R
    Ad[:3, 3:] = cross @ R
    return Ad


@kernel
def _relative(T_world_a, T_world_b):
    """Return T_a_b (4, 4)."""
    out = np.zeros((4, 4))
    for i in range(3):
        for k in range(3):
            for j in range(3):
                out[i, j] += T_world_a[k, i] * T_world_b[k, j]
            out[i, 3] += T_world_a[k, i] * (T_world_b[k, 3] - T_world_a[k, 3])
    out[3, 3] = 1.0
    return out


@kernel
def _log(T, xi):
    """Write the twist of `T` (4, 4) into `xi` (6,), as `se3.log`."""
    angle = _log_rotation(T, xi)
    if angle > _NEAR_PI:
        _half_turn(T, angle, xi)
    _log_translation(T, xi)


@kernel
def _half_turn(T, angle, xi):
    """Write the rotation vector of a turn by nearly pi: R + R^T = 2 cos I + 2 (1 - cos) n n^T."""
    cosine = math.cos(angle)
    best = 0
    for i in range(1, 3):
        if T[i, i] > T[best, best]:
            best = i
    axis = np.empty(3)
    for i in range(3):
        axis[i] = 0.5 * (T[i, best] + T[best, i]) - (cosine if i == best else 0.0)
    norm = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    sine = axis[0] * (T[2, 1] - T[1, 2]) + axis[1] * (T[0, 2] - T[2, 0])
    sine += axis[2] * (T[1, 0] - T[0, 1])
    scale = (angle if sine >= 0.0 else -angle) / norm
    for i in range(3):
        xi[3 + i] = scale * axis[i]
