# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Two covariances of a pose along the axes in which both are diagonal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FLOOR = 1e-12 * np.eye(6)  # 1 um, 1 urad: keeps a covariance invertible


def surer(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smaller of two covariances (6, 6) along each of their common principal axes.

    The result is below both.
    """
    half, ratios = common_axes(one, other)
    return np.asarray((half * np.minimum(ratios, 1.0)) @ half.T)


def common_axes(
    one: NDArray[np.float64], other: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return A (6, 6) and r (6,) with A A^T the `other` covariance and A diag(r) A^T the one."""
    root = np.linalg.cholesky(other + FLOOR)
    white = np.linalg.solve(root, np.linalg.solve(root, one).T)
    ratios, axes = np.linalg.eigh(0.5 * (white + white.T))
    return root @ axes, ratios
