# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A copy of the mapper's map, kept up from what it publishes, and how a tracker goes on in it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.config import Config
from ..core.gaussian_map import GaussianMap
from ..core.splats import Splats
from .ids import EPOCH, split_ids

_PENDING = 64  # updates kept until the whole map comes
_ID_MARGIN = 1 << 16  # ids that the last tracker may have given out unseen


class MapMirror:
    """Exactly the mapper's map, ids included, for who came late too.

    The whole map and each update have a stamp that only grows. An update applies to a map that is
    older; one that comes before any map waits for it.
    """

    def __init__(self) -> None:
        """Know nothing."""
        self.rows: NDArray | None = None  # (N,) MAP_GAUSSIAN in ascending order of id
        self._stamp_ns = -1
        self._waiting: deque[tuple[int, NDArray]] = deque(maxlen=_PENDING)

    def whole(self, stamp_ns: int, rows: NDArray) -> None:
        """Take the whole map, unless this one is newer already."""
        if self.rows is not None and stamp_ns < self._stamp_ns:
            return
        self.rows, self._stamp_ns = rows[np.argsort(rows['id'])], stamp_ns
        waiting, self._waiting = self._waiting, deque(maxlen=_PENDING)
        for update in sorted(waiting, key=lambda update: update[0]):
            self.update(*update)

    def update(self, stamp_ns: int, rows: NDArray) -> None:
        """Take the changed and the removed in; what is older than the map is in it already."""
        if self.rows is None:
            self._waiting.append((stamp_ns, rows))
        elif stamp_ns > self._stamp_ns:
            left = self.rows[~np.isin(self.rows['id'], rows['id'])]
            changed = rows[~np.isnan(rows['x'])]
            together = np.concatenate([left, changed])
            self.rows, self._stamp_ns = together[np.argsort(together['id'])], stamp_ns


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

    @staticmethod
    def of(rows: NDArray, poses: list[NDArray[np.float64]]) -> Resumable | None:
        """Take the tracker's Gaussians of a map; None where there are none."""
        epochs, _ = split_ids(rows['id'].astype(np.int64))
        measured = (epochs > 0) & (rows['keyframe'] < len(poses))
        if not poses or not measured.any():
            return None
        epoch = int(epochs[measured].max())
        return Resumable(epoch, rows[measured & (epochs == epoch)], poses)

    def gaussians(self, config: Config) -> GaussianMap:
        """Build the tracker's map: viewpoints are those of the keyframes."""
        rows, ids = self.rows, self.rows['id'].astype(np.int64) - self.epoch * EPOCH
        planes = np.zeros((14, len(rows)), np.float32)
        for k in range(3):
            planes[3 + k] = np.log(rows[f'scale_{k}'])
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
