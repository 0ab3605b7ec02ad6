# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whether what a frame shows has been seen before, by true poses and measured depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame

_STRIDE_PX = 40
_TOLERANCE, _TOLERANCE_M = 0.05, 0.05  # of depth, which is biased, and not of colour's instant
_NEAREST_M = 0.1

View = tuple[RgbdFrame, NDArray[np.float64]]  # a frame and its true T_world_cam (4, 4)


def share_seen(view: View, earlier: Sequence[View], camera: PinholeCamera) -> float:
    """Return which share of a frame's points is where one of the earlier frames measured depth."""
    points = _points(view, camera)
    seen = np.zeros(len(points), np.bool_)
    for frame, T_world_cam in earlier:
        left = np.flatnonzero(~seen)
        seen[left] = _measured(points[left], frame, T_world_cam, camera)
    return float(seen.mean()) if len(points) else 0.0


def _points(view: View, camera: PinholeCamera) -> NDArray[np.float64]:
    """Return some of a frame's points (N, 3), world."""
    frame, T_world_cam = view
    cells = (slice(_STRIDE_PX // 2, None, _STRIDE_PX),) * 2
    depth_m = frame.depth_m[cells].astype(np.float64)
    rays = np.dstack([camera.undistortion_map[cells], np.ones_like(depth_m)])
    points = (rays * depth_m[..., None])[depth_m > 0]
    return np.asarray(se3.transform(T_world_cam, points))


def _measured(
    points: NDArray[np.float64],
    frame: RgbdFrame,
    T_world_cam: NDArray[np.float64],
    camera: PinholeCamera,
) -> NDArray[np.bool_]:
    """Return (N,) which world points lie on the depth image of a frame."""
    there = se3.transform(se3.inverse(T_world_cam), points)
    z = there[:, 2]
    found = z > _NEAREST_M
    found &= np.all(np.abs(there[:, :2]) < 1.5 * z[:, None], axis=1)  # within the lens model
    pixels = np.round(camera.project(there[found])).astype(int)
    inside = np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
    found[found] = inside
    u, v = pixels[inside].T
    found[found] = np.abs(frame.depth_m[v, u] - z[found]) < _TOLERANCE * z[found] + _TOLERANCE_M
    return found
