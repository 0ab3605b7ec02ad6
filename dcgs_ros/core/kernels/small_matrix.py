# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Symmetric 3x3 matrices as six scalars (xx, xy, xz, yy, yz, zz), inlined into the kernels.

And small systems: NumPy's checks take longer than their solution.
"""

from __future__ import annotations

import math

from .jit import fast_kernel, inlined


@inlined
def inverse_symmetric(xx, xy, xz, yy, yz, zz):
    """Return the inverse (xx, xy, xz, yy, yz, zz) of a positive definite matrix of scalars."""
    c_xx = yy * zz - yz * yz
    c_xy = xz * yz - xy * zz
    c_xz = xy * yz - xz * yy
    s = 1.0 / (xx * c_xx + xy * c_xy + xz * c_xz)
    return (
        c_xx * s,
        c_xy * s,
        c_xz * s,
        (xx * zz - xz * xz) * s,
        (xy * xz - xx * yz) * s,
        (xx * yy - xy * xy) * s,
    )


@inlined
def eigenvalues_symmetric(xx, xy, xz, yy, yz, zz):
    """Return the three eigenvalues in descending order (trigonometric solution of the cubic)."""
    mean = (xx + yy + zz) / 3.0
    off = xy * xy + xz * xz + yz * yz
    p2 = (xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2.0 * off
    if p2 <= 0.0:
        return mean, mean, mean
    p = math.sqrt(p2 / 6.0)
    a, b, c = (xx - mean) / p, (yy - mean) / p, (zz - mean) / p
    d, e, f = xy / p, xz / p, yz / p
    half_det = 0.5 * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
    angle = math.acos(min(1.0, max(-1.0, half_det))) / 3.0
    largest = mean + 2.0 * p * math.cos(angle)
    smallest = mean + 2.0 * p * math.cos(angle + 2.0943951023931953)
    return largest, 3.0 * mean - largest - smallest, smallest


@inlined
def smallest_eigenvector(xx, xy, xz, yy, yz, zz, smallest):
    """Return the unit eigenvector x, y, z of the smallest eigenvalue, which is given.

    It is (0, 0, 1) if that eigenvalue is not distinct. The rows of M - lambda I are orthogonal to
    it: the longest of their cross products is the best conditioned.
    """
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    x0, y0, z0 = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    x1, y1, z1 = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    x2, y2, z2 = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    n0 = x0 * x0 + y0 * y0 + z0 * z0
    n1 = x1 * x1 + y1 * y1 + z1 * z1
    n2 = x2 * x2 + y2 * y2 + z2 * z2
    if n1 > n0:
        x0, y0, z0, n0 = x1, y1, z1, n1
    if n2 > n0:
        x0, y0, z0, n0 = x2, y2, z2, n2
    if n0 <= 0.0:
        return 0.0, 0.0, 1.0
    s = 1.0 / math.sqrt(n0)
    return x0 * s, y0 * s, z0 * s


@fast_kernel
def solve(A, B):
    """Overwrite `B` (N, K) with the solution X of A X = B; the contents of `A` (N, N) are lost.

    Gaussian elimination with partial pivoting. The solution of a singular system is not finite.
    """
    n, m = B.shape
    for c in range(n):
        pivot = c
        for r in range(c + 1, n):
            if abs(A[r, c]) > abs(A[pivot, c]):
                pivot = r
        for k in range(c, n):
            A[c, k], A[pivot, k] = A[pivot, k], A[c, k]
        for k in range(m):
            B[c, k], B[pivot, k] = B[pivot, k], B[c, k]
        for r in range(c + 1, n):
            share = A[r, c] / A[c, c]
            for k in range(c + 1, n):
                A[r, k] -= share * A[c, k]
            for k in range(m):
                B[r, k] -= share * B[c, k]
    for r in range(n - 1, -1, -1):
        for k in range(m):
            for c in range(r + 1, n):
                B[r, k] -= A[r, c] * B[c, k]
            B[r, k] /= A[r, r]
