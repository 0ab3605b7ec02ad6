# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Where the tracker's keyframes are, in which sub-map, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..keyframe import Correction, Odometry
from .hosting import Hosts
from .propagation import KeyframeChain

_APART_M = 1000.0  # between sub-maps: farther than any goes, and float32 still tells 0.1 mm
UNKNOWN = np.diag(np.repeat([1e6, 10.0], 3))  # where a sub-map is before it is joined


def origin(submap: int) -> NDArray[np.float64]:
    """Return the displacement (3,) of a sub-map, metres, until it is joined to another one.

    All sub-maps are in one world, so far apart that nothing of one is taken for the other.
    """
    return np.array([_APART_M * submap, 0.0, 0.0])


class Visited:
    """Stamps, poses and sub-maps of the keyframes, by their index."""

    def __init__(self) -> None:
        """Start without keyframes."""
        self.stamps_ns: list[int] = []
        self.poses: list[NDArray[np.float64]] = []  # (4, 4) T_world_cam
        self.submaps: list[int] = []
        self.odometries: list[Odometry | None] = []  # None: tracked by another tracker
        self._chain = KeyframeChain()

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.poses)

    def reset(
        self,
        stamps_ns: Sequence[int] = (),
        poses: Sequence[NDArray[np.float64]] = (),
        submaps: Sequence[int] = (),
        odometries: Sequence[Odometry | None] = (),
    ) -> None:
        """Start anew with keyframes at certain poses (4, 4): the world is theirs.

        By default all are in sub-map 0, and how they were tracked is not known.
        """
        self.stamps_ns, self.poses = list(stamps_ns), list(poses)
        self.submaps = list(submaps) or [0] * len(self.poses)
        self.odometries = list(odometries) or [None] * len(self.poses)
        self._chain.reset(len(self.poses))

    def add(
        self,
        stamp_ns: int,
        T_world_cam: NDArray[np.float64],
        odometry: Odometry,
        in_world: NDArray[np.floating],
    ) -> None:
        """Add a keyframe with the covariance (6, 6) of its pose in the world, camera frame."""
        self.stamps_ns.append(stamp_ns)
        self.poses.append(T_world_cam)
        self.submaps.append(odometry.submap)
        self.odometries.append(odometry)
        self._chain.add(T_world_cam, in_world)

    def in_world(
        self,
        T_world_cam: NDArray[np.float64],
        hosts: Hosts,
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) in the world, as `KeyframeChain.in_world`."""
        return self._chain.in_world(T_world_cam, hosts)

    def within_reach(
        self, T_world_cam: NDArray[np.float64], hosts: Hosts, last: int, reach_m: float
    ) -> Hosts:
        """Return the hosts of a pose after keyframe `last` as `Hosts.within_reach`."""
        if len(hosts.keyframes) < 2:
            return hosts
        theirs = self._chain.seen_from(T_world_cam, hosts.keyframes)
        before = self._chain.seen_from(T_world_cam, np.array([last]))
        return hosts.within_reach(theirs, before, reach_m)

    def odometry(
        self,
        T_world_cam: NDArray[np.float64],
        submap: int,
        covariance: NDArray[np.float64],
        hosts: Hosts,
    ) -> Odometry:
        """Return the next keyframe relative to its hosts."""
        T_host_cam = [se3.inverse(self.poses[k]) @ T_world_cam for k in hosts.keyframes]
        return Odometry(
            len(self), submap, hosts.keyframes, np.reshape(T_host_cam, (-1, 4, 4)),
            hosts.information, covariance,
        )  # fmt: skip

    def as_correction(self, revision: int) -> Correction:
        """Return where all keyframes are now."""
        return Correction(
            revision, np.array(self.stamps_ns, np.int64), np.reshape(self.poses, (-1, 4, 4)),
            self._chain.covariances, np.array(self.submaps, np.int32),
        )  # fmt: skip

    def correct(self, correction: Correction) -> NDArray[np.float64]:
        """Take corrected poses; return each keyframe's motion (K, 4, 4) in the world.

        Keyframes that the correction does not know move with the last one of their sub-map that it
        knows.
        """
        known = min(len(correction.T_world_cam), len(self))
        before = np.reshape(self.poses[:known], (-1, 4, 4))
        after = correction.T_world_cam[:known]
        motions = list(se3.orthonormalised(after @ se3.inverse(before)))
        newest = dict(zip(self.submaps, motions, strict=False))
        motions += [newest.get(submap, np.eye(4)) for submap in self.submaps[len(motions) :]]
        self.poses = [M @ T for M, T in zip(motions, self.poses, strict=True)]
        joined = dict(zip(self.submaps, correction.submaps.tolist(), strict=False))
        self.submaps = [joined.get(submap, submap) for submap in self.submaps]
        self._chain.correct(correction.covariances, np.array(motions))
        return np.array(motions)
