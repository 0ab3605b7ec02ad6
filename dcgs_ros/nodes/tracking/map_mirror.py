# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A copy of the mapper's map, kept up from what it publishes, and how a tracker goes on in it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.config.stages import Config
from ...core.mapping.splats import Splats
from ...core.tracking.gaussian_map import GaussianMap
from ..messages.ids import EPOCH, EPOCHS, split_ids

_PENDING = 64  # updates kept until the whole map comes
_ID_MARGIN = 1 << 16  # ids that the last tracker may have given out unseen
_LEAST_M = 1e-30  # a scale that has a logarithm
_USED = 'id x y z scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3'.split()


class MapMirror:
    """Exactly the mapper's map, ids included, for who came late too.

    It is the last whole map and the updates with later stamps. Each topic keeps its order, the two
    of them come interleaved anyhow. A stamp of an update that does not grow is of another mapper.
    """

    def __init__(self) -> None:
        """Know nothing."""
        self.rows: NDArray | None = None  # (N,) MAP_GAUSSIAN in ascending order of id
        self._whole: tuple[int, NDArray] | None = None
        self._updates: deque[tuple[int, NDArray]] = deque(maxlen=_PENDING)  # since the whole map

    def whole(self, stamp_ns: int, rows: NDArray) -> None:
        """Take the whole map."""
        self._whole = stamp_ns, rows[np.argsort(rows['id'])]
        later = (update for update in self._updates if update[0] > stamp_ns)
        self._updates = deque(later, maxlen=_PENDING)
        self._replay()

    def update(self, stamp_ns: int, rows: NDArray) -> None:
        """Take the changed and the removed in; what is older than the map is in it already."""
        if self._updates and stamp_ns <= self._updates[-1][0]:
            self._updates.clear()
            self._replay()
        if self._whole is not None and stamp_ns <= self._whole[0]:
            return
        self._updates.append((stamp_ns, rows))
        if self.rows is not None:
            self.rows = _updated(self.rows, rows)

    def _replay(self) -> None:
        """Begin at the whole map once more."""
        if self._whole is not None:
            self.rows = self._whole[1]
            for _, rows in self._updates:
                self.rows = _updated(self.rows, rows)


def _updated(rows: NDArray, update: NDArray) -> NDArray:
    left = rows[~np.isin(rows['id'], update['id'])]
    together = np.concatenate([left, update[~np.isnan(update['x'])]])
    return together[np.argsort(together['id'])]


def changes(before: NDArray, now: NDArray) -> NDArray:
    """Rows that lead from one map to another, both in ascending order of id: an update.

    A removed Gaussian's row is NaN but for its id.
    """
    at = np.searchsorted(before['id'], now['id'])
    at[at == len(before)] = 0
    same = np.zeros(len(now), np.bool_)
    if len(before):
        plain = f'V{now.dtype.itemsize}'
        same = before.view(plain)[at] == now.view(plain)
    gone = np.setdiff1d(before['id'], now['id'], assume_unique=True)
    removed = np.zeros(len(gone), now.dtype)
    for name in now.dtype.names or ():
        if now.dtype[name].kind == 'f':
            removed[name] = np.nan
    removed['id'] = gone
    return np.concatenate([now[~same], removed])


@dataclass(frozen=True)
class Resumable:
    """What a tracker needs to go on in a map that it did not make."""

    epoch: int
    rows: NDArray  # (N,) MAP_GAUSSIAN of the tracker's Gaussians, of one epoch
    poses: list[NDArray[np.float64]]  # T_world_cam (4, 4) of the keyframes
    stamps_ns: frozenset[int]  # their names

    @staticmethod
    def of(
        rows: NDArray, poses: list[NDArray[np.float64]], stamps_ns: Iterable[int]
    ) -> Resumable | None:
        """Take the tracker's Gaussians of a map; None where there are none."""
        rows = rows[np.all([np.isfinite(rows[name]) for name in _USED], axis=0)]
        epochs, _ = split_ids(rows['id'].astype(np.int64))
        hosts = rows['keyframe']
        measured = (0 < epochs) & (epochs < EPOCHS) & (0 <= hosts) & (hosts < len(poses))
        if not measured.any():
            return None
        epoch = int(epochs[measured].max())
        chosen = rows[measured & (epochs == epoch)]
        return Resumable(epoch, chosen, poses, frozenset(stamps_ns))

    def gaussians(self, config: Config) -> GaussianMap:
        """Build the tracker's map: viewpoints are those of the keyframes."""
        rows, ids = self.rows, self.rows['id'].astype(np.int64) - self.epoch * EPOCH
        planes = np.zeros((14, len(rows)), np.float32)
        for k in range(3):
            planes[3 + k] = np.log(np.maximum(rows[f'scale_{k}'], _LEAST_M))
        for k in range(4):
            planes[6 + k] = rows[f'rot_{k}']
        normals, flatness = Splats(planes).shape(np.arange(len(rows)))
        means = np.stack([rows['x'], rows['y'], rows['z']], axis=1)
        centres = np.array([T[:3, 3] for T in self.poses], np.float32)
        viewpoints = centres[rows['keyframe']]
        away = np.einsum('ij,ij->i', normals, means - viewpoints) > 0
        normals[away] *= -1.0  # towards who measured them
        gaussians = GaussianMap(2.0 * config.registration.radius_m)
        hosts = rows['keyframe'].astype(np.int32)
        next_id = int(ids.max()) + _ID_MARGIN
        gaussians.restore(ids, means, normals, flatness, viewpoints, hosts, next_id)
        return gaussians
