# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A copy of the mapper's map, built from what it publishes, and how a tracker goes on in it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.config.stages import Config
from ...core.shape import normals_and_flatness
from ...core.tracking.gaussian_map import GaussianMap
from ...core.tracking.tracker import Tracker
from ..messages.ids import EPOCH, EPOCHS, split_ids
from ..messages.maps import updated
from .back_end_worker import KnownKeyframes

_PENDING = 64  # updates kept until the whole map comes
_ID_MARGIN = 1 << 16  # ids that the last tracker may have given out since its map was published
_LEAST_M = 1e-30  # a scale whose logarithm is finite
_USED = 'id x y z scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3'.split()


class MapMirror:
    """Exactly the mapper's map, ids included, however late the subscription began.

    It is the last whole map with the updates of later stamps. Each topic keeps its order; how the
    two interleave does not matter. An update whose stamp does not grow is of another mapper.
    """

    def __init__(self) -> None:
        """Start without a map."""
        self.rows: NDArray[Any] | None = None  # (N,) MAP_GAUSSIAN in ascending order of id
        self._whole: tuple[int, NDArray[Any]] | None = None
        self._updates: deque[tuple[int, NDArray[Any]]] = deque(maxlen=_PENDING)  # since the whole

    def whole(self, stamp_ns: int, rows: NDArray[Any]) -> None:
        """Take the whole map: MAP_GAUSSIAN rows (N,) in any order."""
        self._whole = stamp_ns, rows[np.argsort(rows['id'])]
        later = (update for update in self._updates if update[0] > stamp_ns)
        self._updates = deque(later, maxlen=_PENDING)
        self._replay()

    def update(self, stamp_ns: int, rows: NDArray[Any]) -> None:
        """Take an update: rows (K,) as `messages.maps.changes` makes them.

        One that is not newer than the whole map is in it already.
        """
        if self._updates and stamp_ns <= self._updates[-1][0]:
            self._updates.clear()
            self._replay()
        if self._whole is not None and stamp_ns <= self._whole[0]:
            return
        self._updates.append((stamp_ns, rows))
        if self.rows is not None:
            self.rows = updated(self.rows, rows)

    def _replay(self) -> None:
        """Apply the updates to the whole map again."""
        if self._whole is not None:
            self.rows = self._whole[1]
            for _, rows in self._updates:
                self.rows = updated(self.rows, rows)


@dataclass(frozen=True)
class Resumable:
    """What a tracker needs to go on in the map of another tracker."""

    epoch: int
    rows: NDArray[Any]  # (N,) MAP_GAUSSIAN of the tracker's Gaussians, all of this epoch
    poses: list[NDArray[np.float64]]  # T_world_cam (4, 4) of the keyframes
    stamps_ns: tuple[int, ...]  # of the keyframes
    submaps: tuple[int, ...] = ()  # likewise; by default all 0

    def __str__(self) -> str:
        """Return its size in words."""
        return f'{len(self.rows)} Gaussians, {len(self.poses)} keyframes'

    @staticmethod
    def of(
        rows: NDArray[Any],
        poses: list[NDArray[np.float64]],
        stamps_ns: Iterable[int],
        submaps: Iterable[int] = (),
    ) -> Resumable | None:
        """Select a tracker's Gaussians, of the highest epoch, from a map; None without any."""
        rows = rows[np.all([np.isfinite(rows[name]) for name in _USED], axis=0)]
        epochs, _ = split_ids(rows['id'].astype(np.int64))
        hosts = rows['keyframe']
        measured = (0 < epochs) & (epochs < EPOCHS) & (0 <= hosts) & (hosts < len(poses))
        if not measured.any():
            return None
        epoch = int(epochs[measured].max())
        chosen = rows[measured & (epochs == epoch)]
        return Resumable(epoch, chosen, poses, tuple(stamps_ns), tuple(submaps))

    def resume(self, tracker: Tracker) -> None:
        """Have a tracker that has tracked nothing yet go on in the map."""
        gaussians = self.gaussians(tracker.config)
        tracker.resume(gaussians, self.poses, self.stamps_ns, self.submaps)

    def keyframes(self, tracker: Tracker) -> KnownKeyframes:
        """Return the keyframes for the back end of the tracker, without images."""
        return KnownKeyframes(
            self.stamps_ns, np.array(self.poses), tracker.keyframe_submaps.tolist()
        )

    def without_images(self) -> Resumable:
        """Return this: there are none in it."""
        return self

    def gaussians(self, config: Config) -> GaussianMap:
        """Build the tracker's map, with the keyframes' positions as viewpoints."""
        rows, ids = self.rows, self.rows['id'].astype(np.int64) - self.epoch * EPOCH
        scales = np.array([np.maximum(rows[f'scale_{k}'], _LEAST_M) for k in range(3)])
        quats = np.array([rows[f'rot_{k}'] for k in range(4)])
        normals, flatness = normals_and_flatness(np.log(scales), quats)
        means = np.stack([rows['x'], rows['y'], rows['z']], axis=1)
        centres = np.array([T[:3, 3] for T in self.poses], np.float32)
        viewpoints = centres[rows['keyframe']]
        away = np.einsum('ij,ij->i', normals, means - viewpoints) > 0
        normals[away] *= -1.0  # towards the viewpoint
        gaussians = GaussianMap(2.0 * config.registration.radius_m)
        hosts = rows['keyframe'].astype(np.int32)
        next_id = int(ids.max()) + _ID_MARGIN
        gaussians.restore(ids, means, normals, flatness, viewpoints, hosts, next_id)
        return gaussians
