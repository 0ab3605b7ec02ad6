# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Walls as a ray caster would see them, and statistics of what a depth camera makes of them."""

import numpy as np

from dcgs_ros.datasets.synthetic.raycast import SceneView

SHAPE = (480, 640)


def wall(depth_m, contrast=40.0, brightness=120.0, cosine=1.0):
    """A wall (or any depth image) with white-noise texture."""
    depth = np.broadcast_to(np.float32(depth_m), SHAPE).copy()
    grey = brightness + contrast * np.random.default_rng(0).standard_normal((*SHAPE, 1))
    radiance = np.repeat(np.clip(grey, 0, 255), 3, axis=2).astype(np.float32)
    return SceneView(depth, np.full(SHAPE, cosine, np.float32), radiance)


def plane_residual(error, size, windows=400):
    """Rms of an image (H, W) against planes fitted within windows of `size` pixels."""
    y, x = np.mgrid[:size, :size].reshape(2, -1).astype(float)
    basis, _ = np.linalg.qr(np.stack([np.ones(size**2), x, y], axis=1))
    rng, total = np.random.default_rng(0), 0.0
    for v, u in rng.integers(0, np.array(error.shape) - size, (windows, 2)):
        values = error[v : v + size, u : u + size].ravel().astype(float)
        total += np.mean((values - basis @ (basis.T @ values)) ** 2)
    return np.sqrt(total / windows)


def correlation(error, shifts):
    """Pearson's coefficient of an image with itself sideways, the mean over shifts in pixels."""
    return np.mean(
        [np.corrcoef(error[:, k:].ravel(), error[:, :-k].ravel())[0, 1] for k in shifts]
    )
