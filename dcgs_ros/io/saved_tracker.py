# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker's part of a map file: its Gaussians as the sensor measured them, its keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..core.camera import PinholeCamera
from ..core.config.stages import Config
from ..core.keyframe import Odometry
from ..core.tracking.depth_bias import TERMS
from ..core.tracking.gaussian_map import GaussianMap
from ..core.tracking.tracker import Tracker
from ..core.tracking.verification import Usual
from .map_parts import MapFileError, check, check_finite, check_keyframes, check_unique, part

ID_MARGIN = 1 << 16  # ids that may have been given out after the highest that is known
_PREFIX = 'tracker_'  # of the arrays in the file
_USUAL = f'{_PREFIX}usual'
_MOST_IDS = 1 << 28  # a tracker keeps four bytes for each id that it has given out
# Type and shape of each array; T Gaussians, K keyframes, E edges.
_LAYOUT: dict[str, tuple[DTypeLike, tuple[str | int, ...]]] = {
    'ids': (np.int64, ('T',)),
    'means': (np.float32, ('T', 3)),
    'normals': (np.float32, ('T', 3)),
    'flatness': (np.float32, ('T',)),
    'viewpoints': (np.float32, ('T', 3)),
    'hosts': (np.int32, ('T',)),
    'observers': (np.int32, ('T',)),
    'stamps_ns': (np.int64, ('K',)),
    'poses': (np.float64, ('K', 4, 4)),
    'submaps': (np.int32, ('K',)),
    'covariances': (np.float64, ('K', 6, 6)),
    'edges': (np.int32, ('E', 2)),
    'edge_poses': (np.float64, ('E', 4, 4)),
    'edge_information': (np.float64, ('E', 6, 6)),
    'usual': (np.float64, (4,)),
    'depth_bias': (np.float64, (TERMS,)),
}


@dataclass(frozen=True)
class SavedTracker:
    """T Gaussians as they were measured, and K keyframes.

    Keyframes have the tracker's own numbers, from 0; the mapper's views have others.
    """

    ids: NDArray[np.int64]  # (T,) those of the same Gaussians in the mapper
    means: NDArray[np.float32]  # (T, 3) metres, world
    normals: NDArray[np.float32]  # (T, 3) unit, world
    flatness: NDArray[np.float32]  # (T,)
    viewpoints: NDArray[np.float32]  # (T, 3) optical centre of the last observation, metres
    hosts: NDArray[np.int32]  # (T,) keyframe that spawned each
    observers: NDArray[np.int32]  # (T,) keyframe of each viewpoint
    next_id: int  # of the next Gaussian; lower ones were given out
    stamps_ns: NDArray[np.int64]  # (K,) of the keyframes' colour images
    poses: NDArray[np.float64]  # (K, 4, 4) T_world_cam
    submaps: NDArray[np.int32]  # (K,)
    covariances: NDArray[np.float64]  # (K, 6, 6) of `Odometry`; zeros where it is not known
    edges: NDArray[np.int32]  # (E, 2) keyframe and a host that it was tracked against
    edge_poses: NDArray[np.float64]  # (E, 4, 4) T_host_cam
    edge_information: NDArray[np.float64]  # (E, 6, 6) of `Odometry`
    usual: NDArray[np.float64]  # (4,) overlap, chi2, agreement and frames of `Usual`
    depth_bias: NDArray[np.float64]  # (5,) that the camera's depth was corrected by

    def __post_init__(self) -> None:
        """Check that the parts fit each other; raises `MapFileError` naming one that does not."""
        sizes = {'T': self.ids.size, 'K': self.stamps_ns.size, 'E': len(self.edges)}
        for name, (dtype, shape) in _LAYOUT.items():
            sized = tuple(n if isinstance(n, int) else sizes[n] for n in shape)
            check(f'{_PREFIX}{name}', getattr(self, name), dtype, sized)
            if np.dtype(dtype).kind == 'f':
                check_finite(f'{_PREFIX}{name}', getattr(self, name))
        check_unique(self.ids)
        for name in ('hosts', 'observers', 'edges'):
            rows = getattr(self, name).ravel()
            check_keyframes(f'{_PREFIX}{name}', rows, sizes['K'], 'keyframes')
        low, high = (self.ids.min(), self.ids.max()) if len(self.ids) else (0, -1)
        if low < 0 or not high < self.next_id <= _MOST_IDS:
            raise MapFileError(
                f'ids of the tracker are {low} to {high}, the next is {self.next_id}'
            )

    @classmethod
    def of(cls, tracker: Tracker) -> SavedTracker:
        """Return a copy of what a tracker has, its Gaussians in ascending order of id."""
        gaussians, visited = tracker.gaussians, tracker.visited
        slots = np.argsort(gaussians.ids)[np.count_nonzero(gaussians.ids < 0) :]
        odometries = [known for known in visited.odometries if known is not None]
        hosts = [(o.keyframe, host) for o in odometries for host in o.hosts]
        covariances = np.zeros((len(visited), 6, 6))
        for known in odometries:
            covariances[known.keyframe] = known.covariance
        return cls(
            gaussians.ids[slots], gaussians.means[slots], gaussians.normals[slots],
            gaussians.flatness[slots], gaussians.viewpoints[slots], gaussians.hosts[slots],
            gaussians.observers[slots], gaussians.next_id,
            np.array(visited.stamps_ns, np.int64), np.array(visited.poses).reshape(-1, 4, 4),
            np.array(visited.submaps, np.int32), covariances,
            np.array(hosts, np.int32).reshape(-1, 2),
            np.concatenate([np.empty((0, 4, 4)), *(o.T_host_cam for o in odometries)]),
            np.concatenate([np.empty((0, 6, 6)), *(o.information for o in odometries)]),
            np.array(astuple(tracker.usual), np.float64), tracker.depth_bias.copy(),
        )  # fmt: skip

    @classmethod
    def from_parts(cls, arrays: Mapping[str, NDArray[Any]], next_id: Any) -> SavedTracker:
        """Return what the arrays of a file hold; raises `MapFileError`."""
        if not isinstance(next_id, int):
            raise MapFileError(f'next_id is {next_id!r}, no number')
        return cls(next_id=next_id, **{n: part(arrays, _PREFIX + n) for n in _LAYOUT})

    def is_same_map(self, other: SavedTracker) -> bool:
        """Return whether two are equal to the byte but for `usual`, which any frame changes."""
        ours, theirs = self.parts, other.parts
        same = all(ours[n].tobytes() == theirs[n].tobytes() for n in ours if n != _USUAL)
        return same and self.next_id == other.next_id

    @property
    def parts(self) -> dict[str, NDArray[Any]]:
        """The arrays of the file; `next_id` is not among them."""
        return {_PREFIX + name: getattr(self, name) for name in _LAYOUT}

    def odometry(self, keyframe: int) -> Odometry | None:
        """Return where a keyframe was tracked; None where that is not known."""
        rows = self.edges[:, 0] == keyframe
        if not rows.any() and not self.covariances[keyframe].any() and keyframe:
            return None
        return Odometry(
            keyframe, int(self.submaps[keyframe]), self.edges[rows, 1].copy(),
            self.edge_poses[rows], self.edge_information[rows], self.covariances[keyframe],
        )  # fmt: skip

    def gaussians(self, config: Config) -> GaussianMap:
        """Return the tracker's map."""
        gaussians = GaussianMap(2.0 * config.registration.radius_m)
        gaussians.restore(
            self.ids, self.means, self.normals, self.flatness, self.viewpoints, self.hosts,
            self.next_id, self.observers,
        )  # fmt: skip
        return gaussians

    def resume(self, tracker: Tracker, camera: PinholeCamera) -> None:
        """Have a tracker that has tracked nothing yet go on in this map, made with a `camera`.

        Raises `MapFileError` for a map without keyframes.
        """
        if not len(self.poses) or not len(self.ids):
            raise MapFileError(
                f'{len(self.ids)} Gaussians of {len(self.poses)} keyframes: nothing to track'
            )
        overlap, chi2, agreement, frames = self.usual.tolist()
        config = tracker.config.scaled_to(tracker.camera.width, tracker.camera.height)
        tracker.resume(
            self.gaussians(config), list(self.poses), self.stamps_ns.tolist(),
            self.submaps.tolist(), [self.odometry(k) for k in range(len(self.poses))],
            Usual(overlap, chi2, agreement, int(frames)),
            self.depth_bias if camera == tracker.camera else None,
        )  # fmt: skip
