# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tells what came into view by itself, and may go on, from what has stood there.

A point where a depth image of the last seconds saw nothing is of a thing that moves. It enters
the map only when it has stood for a while.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..sensor import SensorNoise
from .consensus import told_by_nearest
from .estimator import RegisteredFrame
from .gaussian_map import AGREES, EMPTY, GaussianMap, verdicts_on

_KEPT_S = 3.0  # how long an image tells what was there
_EVERY_S = 0.3  # between two images that are kept: a third of a metre of a walk
_STOOD_S = 1.5  # what an image that is older shows is taken for a part of the place
_IMAGES = 2  # that must see nothing: in a fast turn one may be off
_SOME = 0.02  # share of the points, at most: noise at edges, no thing


@dataclass(frozen=True)
class _Sight:
    """A depth image, and where it was taken."""

    stamp_ns: int
    T_world_cam: NDArray[np.float64]  # (4, 4) at its instant
    depth_m: NDArray[np.float32]  # (H, W)


class Newcomers:
    """The depth images of the last seconds."""

    def __init__(self, camera: PinholeCamera) -> None:
        """Start without any."""
        self._camera = camera
        self._sights: list[_Sight] = []

    def observe(self, frame: RegisteredFrame, gaussians: GaussianMap, sensor: SensorNoise) -> bool:
        """Keep the depth of a tracked frame, if the last one kept is old enough; forget older.

        The map notices what the frame no longer shows. Return whether it was kept.
        """
        stamp_ns = frame.frame.stamp_ns
        kept = [s for s in self._sights if 0 < stamp_ns - s.stamp_ns <= 1e9 * _KEPT_S]
        due = not kept or stamp_ns - kept[-1].stamp_ns >= 1e9 * _EVERY_S
        if due:
            T = frame.T_world_cam @ frame.T_cam_cam_at_depth
            kept.append(_Sight(stamp_ns, T, frame.frame.depth_m))
            gaussians.notice(T, frame.frame.depth_m, self._camera, sensor)
        self._sights = kept
        return due

    def among(self, points: NDArray[np.floating], sensor: SensorNoise) -> NDArray[np.bool_]:
        """Return (N,) which points (N, 3), metres, world, are where two images saw nothing.

        Of a point that no image tells of, since a plain wall behind it had no depth or it was out
        of view, the nearest one tells of which they do.
        """
        points = np.ascontiguousarray(points, np.float32)
        empty, stood = np.zeros(len(points), np.int64), np.zeros(len(points), np.bool_)
        for sight in self._sights:
            verdicts = verdicts_on(points, sight.T_world_cam, sight.depth_m, self._camera, sensor)
            empty += verdicts == EMPTY
            if self._sights[-1].stamp_ns - sight.stamp_ns > 1e9 * _STOOD_S:
                stood |= verdicts == AGREES
        new = (empty >= _IMAGES) & ~stood
        told = np.flatnonzero(new | stood)
        if np.count_nonzero(new) <= _SOME * len(points):
            return np.zeros(len(points), np.bool_)
        return told_by_nearest(points[told], new[told], points)

    def move(self, motion: NDArray[np.float64]) -> None:
        """Move the images by `motion` (4, 4), in the world."""
        self._sights = [replace(s, T_world_cam=motion @ s.T_world_cam) for s in self._sights]
