# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the tracker needs of Sigma_r: its normal and its flatness, as in a `MapUpdate`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def normals_and_flatness(
    log_scales: NDArray[np.float32], quats_wxyz: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the thinnest axes (N, 3), unit, world, and lambda3 / lambda2 (N,) of Sigma_r.

    `log_scales` (3, N) are logarithms of its standard deviations, `quats_wxyz` (4, N) rotate its
    axes to the world and may have any length but zero.
    """
    w, x, y, z = quats_wxyz / np.linalg.norm(quats_wxyz, axis=0)
    axes = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    thinnest = np.argmin(log_scales, axis=0)
    normals = axes[thinnest, :, np.arange(quats_wxyz.shape[1])]
    ordered = np.sort(log_scales, axis=0)
    return normals, np.exp(2 * (ordered[0] - ordered[1]))
