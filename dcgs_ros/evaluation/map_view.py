# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A saved map rendered from tracked poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.mapping.corrections import Corrections
from ..core.mapping.exposure import Exposure
from ..core.render.renderer import Renderer, Rendering, View
from ..io.map_archive import MapFileError, SavedKeyframe, SavedMap

_ROUNDING = 1e-6  # of a rotation matrix after thousands of small updates
_FARTHEST_M = 1e9


class MapView:
    """Renders at tracked poses, corrected as the mapper corrected the keyframes around them."""

    def __init__(self, saved: SavedMap, renderer: Renderer) -> None:
        """Raise `MapFileError` as `read_corrections` does."""
        self._corrections = read_corrections(saved)
        self._saved, self._renderer = saved, renderer
        self.keyframes = frozenset(keyframe.stamp_ns for keyframe in _of_last_session(saved))

    def show(self, stamp_ns: int, T_tracked: NDArray[np.float64]) -> Rendering:
        """Render at the tracked pose (4, 4); the result is valid until the next call."""
        T_world_cam = self._corrections.pose(stamp_ns, T_tracked)
        view = View.of(self._saved.camera, T_world_cam)
        return self._renderer.render(self._saved.splats.planes, view)

    def exposed(self, stamp_ns: int, color: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return colours (..., 3) with the exposure interpolated to an instant applied."""
        exposure = self._corrections.exposure(stamp_ns)
        return color * exposure.gain + exposure.offset


def read_corrections(saved: SavedMap) -> Corrections:
    """Return the corrections that the mapper made to the keyframes of the last session.

    Raises `MapFileError` for a map without Gaussians, or whose keyframes have unordered stamps or
    invalid poses.
    """
    if not len(saved.splats):
        raise MapFileError('map holds no Gaussian')
    keyframes = _of_last_session(saved)  # at least one: every Gaussian has a host
    stamps_ns = np.array([keyframe.stamp_ns for keyframe in keyframes], np.int64)
    if np.any(stamps_ns[1:] <= stamps_ns[:-1]):
        raise MapFileError('stamps of the keyframes do not increase')
    T_tracked = np.array([keyframe.T_tracked for keyframe in keyframes])
    T_world_cam = np.array([keyframe.T_world_cam for keyframe in keyframes])
    for name, poses in (('T_tracked', T_tracked), ('T_world_cam', T_world_cam)):
        bad = np.flatnonzero(~_rigid(poses))
        if len(bad):
            raise MapFileError(f'{name} of keyframe {bad[0]} is not a pose')
    exposures = [Exposure(*keyframe.exposure) for keyframe in keyframes]
    return Corrections(stamps_ns, T_tracked, T_world_cam, exposures)


def _of_last_session(saved: SavedMap) -> tuple[SavedKeyframe, ...]:
    """Return the keyframes of the last session that has any: those of several may look alike."""
    views = [session.views for session in saved.sessions if session.views]
    return saved.keyframes[-views[-1] :] if views else ()


def _rigid(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of the matrices (N, 4, 4) are rigid transforms, (N,)."""
    R = poses[:, :3, :3]
    near = np.abs(poses).max(axis=(1, 2)) < _FARTHEST_M
    R = np.where(near[:, None, None], R, 0)  # so that nothing overflows
    errors = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    last = np.all(poses[:, 3] == (0, 0, 0, 1), axis=1)
    return near & last & (errors < _ROUNDING) & (np.linalg.det(R) > 0)
