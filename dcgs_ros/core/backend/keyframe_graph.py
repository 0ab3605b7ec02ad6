# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The keyframes, what joins them, and where they are: what the back end optimises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config
from ..errors import DcgsError
from ..keyframe import Correction, Odometry, Sightings
from ..tracking.visited import UNKNOWN
from .adjustment import Tracks, adjust
from .certainty import Steps, bounds, steps
from .consistency import Loop
from .edges import Edge, information_of, odometry_edges
from .pose_graph import optimise

_DOUBTFUL = 0.1  # weight below which the others contradict a loop
# Beyond so many keyframes each is held by its oldest and its newest host only: the factors of the
# information matrix grow with the square of how many hold one.
_MANY, _FEW_HOSTS = 500, 2
_RIGID = 1e-10 * np.eye(6)  # 10 um and 10 urad between the keyframes of a map that was loaded


class BackEndError(DcgsError):
    """The back end was given what does not fit together."""


class KeyframeGraph:
    """Keyframes by their index, odometry between them, and the loops that are believed."""

    def __init__(self) -> None:
        """Start without keyframes."""
        self.stamps_ns: list[int] = []
        self.poses = np.empty((0, 4, 4))  # T_world_cam
        self.submaps: list[int] = []  # those that were joined have one number
        self.loops: list[Loop] = []
        self.rejected: list[Loop] = []  # once believed, then contradicted by the others
        self._restored = 0  # keyframes of a map that was loaded
        self._odometry: list[Odometry] = []
        self._edges: list[list[Edge]] = []  # of each keyframe to its hosts
        self._sightings: list[Sightings] = []

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.stamps_ns)

    def add(
        self,
        stamp_ns: int,
        T_world_cam: NDArray[np.float64],
        odometry: Odometry,
        sightings: Sightings | None = None,
    ) -> None:
        """Add the next keyframe.

        It is placed relative to its newest host. `T_world_cam` (4, 4), where the tracker says that
        it is, counts for one that begins a map only. Raises `BackEndError` if it is not the next.
        """
        if odometry.keyframe != len(self):
            raise BackEndError(f'keyframe {odometry.keyframe} follows {len(self)} others')
        if len(odometry.hosts):
            host = int(odometry.hosts[-1])
            T_world_cam = self.poses[host] @ odometry.T_host_cam[-1]
            submap = self.submaps[host]
        else:
            submap = odometry.submap
        self.stamps_ns.append(stamp_ns)
        self.poses = np.concatenate([self.poses, [se3.orthonormalised(T_world_cam)]])
        self.submaps.append(submap)
        self._odometry.append(odometry)
        self._edges.append(odometry_edges(odometry))
        self._sightings.append(sightings or Sightings.none())

    def restore(
        self, stamps_ns: Sequence[int], poses: NDArray[np.float64], submaps: Sequence[int]
    ) -> None:
        """Begin with keyframes of a map (K, 4, 4), which are certain: the world is theirs.

        Each is held by the one before it in its sub-map.
        """
        if len(self):
            raise BackEndError(f'there are {len(self)} keyframes already')
        poses = np.array(poses, np.float64).reshape(-1, 4, 4)
        newest: dict[int, int] = {}
        rows = zip(stamps_ns, poses, submaps, strict=True)
        for k, (stamp_ns, T, submap) in enumerate(rows):
            hosts = np.array([newest[submap]] if submap in newest else [], np.int32)
            relative = se3.inverse(poses[hosts]) @ T
            self.add(int(stamp_ns), T, _odometry(k, hosts, relative, _RIGID, int(submap)))
            newest[submap] = k
        self.poses = poses  # to the last bit
        self._restored = len(self)

    def believe(self, loops: Sequence[Loop]) -> None:
        """Add loops; the younger of two sub-maps moves into the world of the older one."""
        for loop in sorted(loops, key=lambda one: float(np.trace(one.covariance))):
            a, b = self.submaps[loop.a], self.submaps[loop.b]
            if a < b:
                self._join(b, a, self.poses[loop.a] @ loop.T_a_b @ se3.inverse(self.poses[loop.b]))
            elif b < a:
                T_b_a = se3.inverse(loop.T_a_b)
                self._join(a, b, self.poses[loop.b] @ T_b_a @ se3.inverse(self.poses[loop.a]))
        self.loops += loops

    def optimise(self) -> None:
        """Move the keyframes to where odometry and loops agree best; drop loops that do not."""
        edges, fixed = self._all_edges(), self._fixed()
        solution = optimise(self.poses, edges, fixed)
        free = np.setdiff1d(np.arange(len(self)), fixed)
        self.poses[free] = se3.orthonormalised(solution.T_world_cam[free])
        held = solution.weights[len(edges) - len(self.loops) :] >= _DOUBTFUL
        self.rejected += [loop for loop, good in zip(self.loops, held, strict=True) if not good]
        self.loops = [loop for loop, good in zip(self.loops, held, strict=True) if good]

    def adjust(self, camera: PinholeCamera, config: Config) -> None:
        """Move the keyframes to where they agree best with what they see, too."""
        tracks = Tracks.of(self._sightings)
        self.poses = adjust(self.poses, tracks, self._all_edges(), self._fixed(), camera, config)

    def _all_edges(self) -> list[Edge]:
        """Return odometry and then the loops."""
        edges = [edge for of_one in self._edges for edge in _thinned(of_one, len(self))]
        return edges + [
            Edge(loop.a, loop.b, loop.T_a_b, information_of(loop.covariance), loop=True)
            for loop in self.loops
        ]

    def steps(self) -> Steps:
        """Return the covariances of all edges."""
        loops = [(loop.a, loop.b, loop.covariance) for loop in self.loops]
        return steps(self.poses, self._odometry, loops)

    def correction(self, revision: int) -> Correction:
        """Return the poses of all keyframes, and bounds of their covariances.

        The first keyframe is certain: the world is its. Where other sub-maps are in it is unknown.
        """
        known = {}
        for k in self._fixed():
            Ad = se3.adjoint(self.poses[k])
            known[k] = Ad @ UNKNOWN @ Ad.T if self.submaps[k] else np.zeros((6, 6))
        return Correction(
            revision, np.array(self.stamps_ns, np.int64), self.poses.copy(),
            bounds(self.steps(), known), np.array(self.submaps, np.int32),
        )  # fmt: skip

    def gap(self, loop: Loop) -> NDArray[np.float64]:
        """Return the twist (6,) that a loop would move its later keyframe by, alone."""
        T_a_b = se3.inverse(self.poses[loop.a]) @ self.poses[loop.b]
        return se3.log(se3.inverse(T_a_b) @ loop.T_a_b)

    def _fixed(self) -> list[int]:
        """Return the first keyframe of each sub-map, and those of a map that was loaded."""
        first: dict[int, int] = {}
        for k, submap in enumerate(self.submaps):
            first.setdefault(submap, k)
        return sorted({*first.values(), *range(self._restored)})

    def _join(self, submap: int, older: int, motion: NDArray[np.float64]) -> None:
        """Move a sub-map as a whole by `motion` (4, 4), and make it part of an older one."""
        moving = np.array(self.submaps) == submap
        self.poses[moving] = motion @ self.poses[moving]
        self.submaps = [older if one == submap else one for one in self.submaps]


def _thinned(edges: list[Edge], keyframes: int) -> list[Edge]:
    """Return the edges of one keyframe, two of them only in a graph of many keyframes."""
    if keyframes <= _MANY or len(edges) <= _FEW_HOSTS:
        return edges
    *between, newest = edges[1:]
    whole = sum((edge.information for edge in between), start=newest.information)
    return [edges[0], replace(newest, information=whole)]


def _odometry(
    k: int,
    hosts: NDArray[np.int32],
    T_host_cam: NDArray[np.float64],
    covariance: NDArray[np.float64],
    submap: int = 0,
) -> Odometry:
    """Return that of keyframe `k` with one host at most."""
    information = np.tile(np.linalg.inv(covariance), (len(hosts), 1, 1))
    return Odometry(k, submap, hosts, T_host_cam, information, covariance)


def warm_up() -> None:
    """Optimise three keyframes with a wrong loop, so that every kernel has run."""
    graph = KeyframeGraph()
    for k in range(3):
        hosts = np.arange(min(k, 1), dtype=np.int32)
        T_host_cam = np.tile(np.eye(4), (len(hosts), 1, 1))
        graph.add(k, np.eye(4), _odometry(k, hosts, T_host_cam, 1e-6 * np.eye(6)))
    graph.believe([_FarOff()])
    graph.optimise()
    graph.correction(1)


@dataclass(frozen=True)
class _FarOff:
    """A loop that is contradicted."""

    a: int = 1
    b: int = 2
    T_a_b: NDArray[np.float64] = field(default_factory=lambda: se3.exp(np.ones(6)))
    covariance: NDArray[np.float64] = field(default_factory=lambda: 1e-6 * np.eye(6))
