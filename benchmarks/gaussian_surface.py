# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A wavy surface of Gaussians, all within the image of a camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.mapping.splats import PLANES, SH_C0, Splats


def wavy_surface(n: int, width: int, height: int, shuffled: bool) -> tuple[Splats, PinholeCamera]:
    """Return n flat Gaussians spread over the image of a camera at the origin, and the camera.

    They are in the order of the image rows, or `shuffled`. Their sigmas are 0.7 to 1.3 times their
    spacing along the longest axis, 0.3 to 1 of that across, and 0.15 of that along the normal.
    """
    rng = np.random.default_rng(0)
    focal = 525.0 * width / 640.0
    camera = PinholeCamera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
    u, v = _spread(rng, n, width, height)
    means, normals = _surface(u, v, camera)
    spacing = np.sqrt(width * height / n)
    along = rng.uniform(0.7, 1.3, n) * spacing * means[2] / focal
    across = along * rng.uniform(0.3, 1.0, n)
    opacity = rng.normal(0.9, 0.04, n).clip(0.6, 0.98)
    waves = np.sin(np.array([[9.0], [13.0], [17.0]]) * (means[:1] + means[1:2]))
    color = 0.5 + 0.3 * waves + rng.normal(0, 0.03, (3, n))
    planes = np.empty((len(PLANES), n), np.float32)
    planes[0:3] = means
    planes[3:6] = np.log([along, across, 0.15 * across])
    planes[6:10] = _facing(normals, rng.uniform(0, np.pi, n))
    planes[10] = np.log(opacity / (1 - opacity))
    planes[11:14] = (color - 0.5) / SH_C0
    return Splats(planes[:, rng.permutation(n)] if shuffled else planes), camera


def _spread(
    rng: np.random.Generator, n: int, width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels u (N,) and v (N,), one at random in each cell of a grid, row by row."""
    rows = round(np.sqrt(n * height / width))
    columns = -(-n // rows)
    row, column = np.divmod(np.arange(n), columns)
    u = (column + rng.uniform(size=n)) * width / columns - 0.5
    v = (row + rng.uniform(size=n)) * height / rows - 0.5
    return u, v


def _surface(
    u: NDArray[np.float64], v: NDArray[np.float64], camera: PinholeCamera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (3, N), metres, and unit normals (3, N) of the surface at pixels (N,)."""

    def point(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        return (2.0 + 0.3 * np.sin(7.0 * x) * np.cos(6.0 * y)) * np.stack([x, y, np.ones_like(x)])

    points, step = point(u, v), 1e-3 * camera.width
    normals = np.cross(point(u, v + step) - points, point(u + step, v) - points, axis=0)
    return points, normals / np.linalg.norm(normals, axis=0)


def _facing(normals: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quaternions wxyz (4, N) that rotate by `angles` (N,) about z, then z to `normals`."""
    first = np.cross(normals, [[1.0], [0.0], [0.0]], axis=0)
    first /= np.linalg.norm(first, axis=0)
    axes = np.stack([first, np.cross(normals, first, axis=0), normals], axis=1)  # (3, 3, N)
    about_z = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0])
    turned = Rotation.from_matrix(axes.transpose(2, 0, 1)) * about_z
    return np.asarray(turned.as_quat().T[[3, 0, 1, 2]])
