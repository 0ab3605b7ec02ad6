# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Projection of sixteen Gaussians at a time, and the chain rule back to their parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from ..mapping.splats import PLANES, SH_C0
from .blending import LOG2_ALPHA_MIN
from .renderer import BLUR_PX2, MARGIN, NEAR_M, View
from .simd import (
    LANES,
    Vector,
    both,
    exp,
    index,
    load,
    log2,
    maximum,
    minimum,
    pointer,
    scalar_at,
    select,
    sqrt,
    store,
)

_LOG2_E, _LN_2 = math.log2(math.e), math.log(2.0)
# Positions of the numbers in `camera_numbers`.
_R, _T, _FX, _FY, _CX, _CY, _LOW_X, _HIGH_X, _LOW_Y, _HIGH_Y, _W, _H, _FAR = (
    0, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22,
)  # fmt: skip
_HUGE = 1e30  # larger values count as infinite
PROJECTED = 13  # vectors `project` writes: a row of `blending`, then 1 if the Gaussian is seen
GRADIENTS = len(PLANES) + 6  # vectors `chain` writes: by the parameters, and by the pose


def camera_numbers(view: View) -> NDArray[np.float32]:
    """Return (23,): T_cam_world (rotation, translation in metres), intrinsics, limits, size, far.

    Intrinsics and size in pixels, pixel centres at 1/2; limits of x/z and y/z for the Jacobian;
    the depth, metres, from which on nothing is drawn.
    """
    R = view.T_world_cam[:3, :3].T
    cx, cy = view.cx + 0.5, view.cy + 0.5
    beyond_x, beyond_y = 0.5 * MARGIN * view.width, 0.5 * MARGIN * view.height
    limits = (
        -(cx + beyond_x) / view.fx, (view.width - cx + beyond_x) / view.fx,
        -(cy + beyond_y) / view.fy, (view.height - cy + beyond_y) / view.fy,
    )  # fmt: skip
    t = -R @ view.T_world_cam[:3, 3]
    intrinsics = (view.fx, view.fy, cx, cy, *limits, view.width, view.height)
    far_m = min(view.far_m, _HUGE)
    return np.array([*R.ravel(), *t, *intrinsics, far_m], np.float32)


@dataclass
class _Geometry:
    """What projection and chain rule both need; a list of three has x, y, z."""

    parameters: list[Vector]  # 14, as PLANES
    R: list[Vector]  # 9, row by row, camera from world
    p_cam: list[Vector]  # metres
    inverse_z: Vector
    slope: tuple[Vector, Vector]  # x/z, y/z
    clamped: tuple[Vector, Vector]
    focal: tuple[Vector, Vector]
    quat: list[Vector]  # unit
    inverse_norm: Vector  # of the quaternion as it is stored
    scales: list[Vector]
    axes: list[list[Vector]]  # [row][axis]: axes of Sigma_r in the camera frame
    jacobian: tuple[Vector, Vector, Vector, Vector]  # dx/dX, dx/dZ, dy/dY, dy/dZ
    u: list[Vector]  # rows of J R diag(scales): Sigma_2D = (u.u, u.v, v.v)
    v: list[Vector]
    covariance: tuple[Vector, Vector, Vector]  # widened by BLUR_PX2
    inverse_det: Vector


def _geometry(builder: Any, planes: Any, count: Any, first: Any, camera: Any) -> _Geometry:
    """Emit the geometry of the Gaussians first to first + 15 of planes (14, count)."""

    def plane(k: int) -> Vector:
        at = builder.add(builder.mul(index(k), count), first)
        return load(builder, planes, at)

    def number(k: int) -> Vector:
        return scalar_at(builder, camera, k)

    p = [plane(k) for k in range(len(PLANES))]
    R = [number(_R + k) for k in range(9)]
    p_cam = [_dot(R[3 * i : 3 * i + 3], p[0:3]) + number(_T + i) for i in range(3)]
    inverse_z = 1.0 / p_cam[2]
    slope = p_cam[0] * inverse_z, p_cam[1] * inverse_z
    clamped = (
        minimum(maximum(slope[0], number(_LOW_X)), number(_HIGH_X)),
        minimum(maximum(slope[1], number(_LOW_Y)), number(_HIGH_Y)),
    )
    focal = number(_FX), number(_FY)
    inverse_norm = 1.0 / sqrt(_dot(p[6:10], p[6:10]))
    quat = [q * inverse_norm for q in p[6:10]]
    rotation = _rotation(quat)
    axes = [
        [_dot(R[3 * i : 3 * i + 3], [rotation[k][j] for k in range(3)]) for j in range(3)]
        for i in range(3)
    ]
    scales = [exp(s) for s in p[3:6]]
    jx, jy = focal[0] * inverse_z, focal[1] * inverse_z
    jacobian = jx, -jx * clamped[0], jy, -jy * clamped[1]
    u = [(jacobian[0] * axes[0][j] + jacobian[1] * axes[2][j]) * scales[j] for j in range(3)]
    v = [(jacobian[2] * axes[1][j] + jacobian[3] * axes[2][j]) * scales[j] for j in range(3)]
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    cross = _cross(u, v)  # det from sums of squares: a difference would cancel for long needles
    det = _dot(cross, cross) + (uu + vv) * BLUR_PX2 + BLUR_PX2**2
    covariance = uu + BLUR_PX2, uv, vv + BLUR_PX2
    return _Geometry(
        p, R, p_cam, inverse_z, slope, clamped, focal, quat, inverse_norm, scales, axes, jacobian,
        u, v, covariance, 1.0 / det,
    )  # fmt: skip


def _dot(a: list[Vector], b: list[Vector]) -> Vector:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def _cross(a: list[Vector], b: list[Vector]) -> list[Vector]:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]


def _rotation(q: list[Vector]) -> list[list[Vector]]:
    w, x, y, z = q
    return [
        [1.0 - (y * y + z * z) * 2.0, (x * y - w * z) * 2.0, (x * z + w * y) * 2.0],
        [(x * y + w * z) * 2.0, 1.0 - (x * x + z * z) * 2.0, (y * z - w * x) * 2.0],
        [(x * z - w * y) * 2.0, (y * z + w * x) * 2.0, 1.0 - (x * x + y * y) * 2.0],
    ]


@intrinsic
def project(typing, planes, count, first, camera, out):
    """Project the Gaussians first to first + 15 of planes (14, count); write `out`.

    `planes` float32 as in `Splats`, `camera` (23,) float32 of `camera_numbers`, `out`
    (PROJECTED * LANES,) float32: the numbers of `blending`'s rows, LANES of each, then 1 or 0.
    """
    signature = types.void(planes, types.int64, types.int64, camera, out)

    def emit(context, builder, signature, arguments):
        planes, camera, out = (
            pointer(context, builder, signature.args[k], arguments[k]) for k in (0, 3, 4)
        )
        g = _geometry(builder, planes, arguments[1], arguments[2], camera)
        for k, vector in enumerate(_projected(builder, g, camera)):
            store(builder, out, index(k * LANES), vector, 4 * LANES)
        return context.get_dummy_value()

    return signature, emit


def _projected(builder: Any, g: _Geometry, camera: Any) -> list[Vector]:
    """Return the vectors of `project`.

    Pixels with an alpha of at least ALPHA_MIN are within the reaches of the mean.
    """
    x = g.focal[0] * g.slope[0] + scalar_at(builder, camera, _CX)
    y = g.focal[1] * g.slope[1] + scalar_at(builder, camera, _CY)
    log2_opacity = -log2(exp(-g.parameters[10]) + 1.0)
    above = log2_opacity - LOG2_ALPHA_MIN
    xx, xy, yy = g.covariance
    squared = maximum(above, 0.0) * (2.0 * _LN_2)
    reach_x, reach_y = sqrt(squared * xx), sqrt(squared * yy)
    conic = [c * g.inverse_det * _LOG2_E for c in (yy, -xy, xx)]
    color = [c * SH_C0 + 0.5 for c in g.parameters[11:14]]
    seen = both(
        g.p_cam[2] >= NEAR_M, g.p_cam[2] < scalar_at(builder, camera, _FAR), above > 0.0,
        g.inverse_det > 0.0,
        x + reach_x > 0.0, x - reach_x < scalar_at(builder, camera, _W),
        y + reach_y > 0.0, y - reach_y < scalar_at(builder, camera, _H),
        builder=builder,
    )  # fmt: skip
    for value in (*conic, *color, *g.p_cam, *g.parameters[3:6], g.parameters[10]):
        seen = both(seen, value > -_HUGE, value < _HUGE, builder=builder)  # nor NaN
    row = [x, y, *conic, log2_opacity, *color, g.p_cam[2], reach_x, reach_y]
    return [*row, select(seen, 1.0, 0.0, builder)]


@intrinsic
def chain(typing, planes, count, first, camera, summed, active, out):
    """Turn gradient sums of the Gaussians first to first + 15 into derivatives; write `out`.

    `planes` (14, count) and `camera` (23,) as in `project`; `summed` (SUMS * LANES,) float32, the
    sums of `blending`, LANES of each; `active` (LANES,) float32 is 0 for a Gaussian that was not
    seen, whose derivatives are 0; `out` (GRADIENTS * LANES,) float32.
    """
    signature = types.void(planes, types.int64, types.int64, camera, summed, active, out)

    def emit(context, builder, signature, arguments):
        planes, camera, summed, active, out = (
            pointer(context, builder, signature.args[k], arguments[k]) for k in (0, 3, 4, 5, 6)
        )
        g = _geometry(builder, planes, arguments[1], arguments[2], camera)
        sums = [load(builder, summed, index(k * LANES), 4 * LANES) for k in range(10)]
        mask = load(builder, active, index(0), 4 * LANES) > 0.0
        for k, vector in enumerate(_chained(builder, g, sums, camera)):
            kept = select(mask, vector, 0.0, builder)
            store(builder, out, index(k * LANES), kept, 4 * LANES)
        return context.get_dummy_value()

    return signature, emit


def _chained(builder: Any, g: _Geometry, sums: list[Vector], camera: Any) -> list[Vector]:
    """Return the derivatives by the parameters, then by the pose."""
    A, B, C = (c * g.inverse_det for c in (g.covariance[2], -g.covariance[1], g.covariance[0]))
    by_x, by_y = A * sums[1] + B * sums[2], B * sums[1] + C * sums[2]
    by_u, by_v = _by_rows(g, (A, B, C), sums)
    by_axes, by_jacobian = _by_axes(g, by_u, by_v)
    by_p_cam = _by_p_cam(builder, g, (by_x, by_y), by_jacobian, sums[9], camera)
    by_mean = [_dot(g.R[i::3], by_p_cam) for i in range(3)]
    by_scale = [_dot([row[j] for row in by_axes], [row[j] for row in g.axes]) for j in range(3)]
    missing = 1.0 / (exp(g.parameters[10]) + 1.0)  # 1 - opacity, which would cancel
    return [
        *by_mean, *by_scale, *_by_quaternion(g, by_axes), sums[0] * missing,
        *(s * SH_C0 for s in sums[6:9]), *_by_pose(g, by_p_cam, by_axes),
    ]  # fmt: skip


def _by_rows(
    g: _Geometry, conic: tuple[Vector, Vector, Vector], sums: list[Vector]
) -> tuple[list[Vector], list[Vector]]:
    """Return the derivatives by u and v: dL/dSigma = -Q (dL/dQ) Q with Q the conic."""
    A, B, C = conic
    qa, qb, qc = sums[3] * -0.5, sums[4] * -0.5, sums[5] * -0.5
    w00, w01 = A * qa + B * qb, A * qb + B * qc
    w10, w11 = B * qa + C * qb, B * qb + C * qc
    xx = -(w00 * A + w01 * B)
    xy = -(w00 * B + w01 * C) - (w10 * A + w11 * B)
    yy = -(w10 * B + w11 * C)
    by_u = [xx * u * 2.0 + xy * v for u, v in zip(g.u, g.v, strict=True)]
    by_v = [xy * u + yy * v * 2.0 for u, v in zip(g.u, g.v, strict=True)]
    return by_u, by_v


def _by_axes(
    g: _Geometry, by_u: list[Vector], by_v: list[Vector]
) -> tuple[list[list[Vector]], list[Vector]]:
    """Return those by the axes in the camera frame, times their scales, and by the Jacobian."""
    jx, jxz, jy, jyz = g.jacobian
    su = [d * s for d, s in zip(by_u, g.scales, strict=True)]
    sv = [d * s for d, s in zip(by_v, g.scales, strict=True)]
    by_axes = [
        [jx * d for d in su],
        [jy * d for d in sv],
        [jxz * a + jyz * b for a, b in zip(su, sv, strict=True)],
    ]
    by_jacobian = [_dot(su, g.axes[0]), _dot(su, g.axes[2])]
    by_jacobian += [_dot(sv, g.axes[1]), _dot(sv, g.axes[2])]
    return by_axes, by_jacobian


def _by_p_cam(
    builder: Any,
    g: _Geometry,
    by_xy: tuple[Vector, Vector],
    by_jacobian: list[Vector],
    by_depth: Vector,
    camera: Any,
) -> list[Vector]:
    """Return those by the mean in the camera frame: through pixel, depth and Jacobian."""
    by: list[Vector] = []
    by_z = by_depth
    for k, (low, high) in enumerate(((_LOW_X, _HIGH_X), (_LOW_Y, _HIGH_Y))):
        j = g.jacobian[2 * k]
        by_j, by_jz = by_jacobian[2 * k], by_jacobian[2 * k + 1]
        inside = both(
            g.slope[k] > scalar_at(builder, camera, low),
            g.slope[k] < scalar_at(builder, camera, high),
            builder=builder,
        )
        bent = by_jz * j * g.inverse_z
        by.append(by_xy[k] * j - select(inside, bent, 0.0, builder))
        twice = select(inside, 2.0, 1.0, builder)  # j and the clamped slope, or j alone
        by_z = by_z - by_xy[k] * j * g.slope[k] - by_j * j * g.inverse_z
        by_z = by_z + bent * g.clamped[k] * twice
    return [*by, by_z]


def _by_quaternion(g: _Geometry, by_axes: list[list[Vector]]) -> list[Vector]:
    """Return those by the stored quaternion, through its normalisation."""
    d = [[_dot(g.R[i::3], [row[j] for row in by_axes]) for j in range(3)] for i in range(3)]
    w, x, y, z = g.quat
    by_unit = [
        (x * (d[2][1] - d[1][2]) + y * (d[0][2] - d[2][0]) + z * (d[1][0] - d[0][1])) * 2.0,
        (
            y * (d[0][1] + d[1][0]) + z * (d[0][2] + d[2][0]) + w * (d[2][1] - d[1][2])
            - x * (d[1][1] + d[2][2]) * 2.0
        ) * 2.0,
        (
            x * (d[0][1] + d[1][0]) + z * (d[1][2] + d[2][1]) + w * (d[0][2] - d[2][0])
            - y * (d[0][0] + d[2][2]) * 2.0
        ) * 2.0,
        (
            x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1]) + w * (d[1][0] - d[0][1])
            - z * (d[0][0] + d[1][1]) * 2.0
        ) * 2.0,
    ]  # fmt: skip
    along = _dot(by_unit, g.quat)
    return [(b - along * q) * g.inverse_norm for b, q in zip(by_unit, g.quat, strict=True)]


def _by_pose(g: _Geometry, by_p_cam: list[Vector], by_axes: list[list[Vector]]) -> list[Vector]:
    """Return those by xi in T_world_cam exp(xi).

    p_cam moves by -rho - phi x p_cam, an axis a by -phi x a.
    """
    turning = _cross(g.p_cam, by_p_cam)
    for j in range(3):
        arm = _cross([row[j] for row in g.axes], [row[j] for row in by_axes])
        turning = [a + b for a, b in zip(turning, arm, strict=True)]
    return [-d for d in (*by_p_cam, *turning)]
