# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The back end: finds places that the camera has seen before, and corrects the keyframes' poses.

There is no thread in it. Who drives it calls `add` with each keyframe, which costs nothing, and
`work` when there is time: between frames, or in a thread of its own.
"""

from __future__ import annotations

import queue
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config
from ..keyframe import Correction, Keyframe
from ..tracking.relocalization import Recogniser
from .closure import Closures
from .consistency import Consistency, Loop
from .features import Features
from .keyframe_graph import BackEndError, KeyframeGraph

# A Gaussian of the map is known to some 5 mm: its depth is, at a few metres, and a turn by 5 mrad
# moves it so far one metre away. Smaller corrections would not be seen in the map.
_SEEN_M, _SEEN_RAD = 5e-3, 5e-3
# Of what is claimed for a pose. Within that, the next loop is as likely to move it back, and each
# correction costs the tracker a swap of its whole map.
_NOTABLE_SIGMAS = 0.5


class LoopFinder(Protocol):
    """Recognises places and measures where keyframes are to each other."""

    @property
    def places(self) -> Recogniser:
        """Recognises the places of the keyframes; may be called from any thread."""
        ...

    def add(
        self,
        keyframe: Keyframe,
        camera: PinholeCamera | None = None,
        features: Features | None = None,
    ) -> None:
        """Keep what is needed of a keyframe.

        `camera` made its images, if it is another; its `features` are found if they are not known.
        """
        ...

    def close(self, keyframe: int) -> Sequence[Loop]:
        """Return what joins a keyframe with earlier ones."""
        ...


class BackEnd:
    """Places, loops, consistency and pose graph."""

    def __init__(
        self, camera: PinholeCamera, config: Config, finder: LoopFinder | None = None
    ) -> None:
        """Start without keyframes; by default `Closures` find the loops."""
        self._camera, self._config = camera, config
        self._finder: LoopFinder = finder or Closures(camera, config)
        self._graph = KeyframeGraph()
        self._consistency = Consistency()
        self._queue: queue.SimpleQueue[Keyframe] = queue.SimpleQueue()
        self._revision = 0
        self._moved = False  # since the last correction was considered
        self._told = np.empty((0, 4, 4))  # where the tracker has the keyframes
        self._told_submaps: list[int] = []

    def add(self, keyframe: Keyframe) -> None:
        """Take the tracker's next keyframe; nothing is done with it yet.

        One without an image (`Keyframe.without_image`) is placed by its odometry, and no loop is
        looked for with it.
        """
        self._queue.put(keyframe)

    def work(self) -> Correction | None:
        """Do all that is due; return better poses where they would be seen in the map.

        Raises `BackEndError` for a keyframe that is not the next one.
        """
        while not self._queue.empty():
            keyframe = self._queue.get()
            self._insert(keyframe)
            if keyframe.has_image:
                self._close(len(self._graph) - 1)
        if not self._moved:
            return None
        self._moved = False
        correction = self._graph.correction(self._revision + 1)
        if not self._is_worth_telling(correction):
            return None
        self._revision += 1
        self._told, self._told_submaps = correction.T_world_cam, list(self._graph.submaps)
        return correction

    def optimised(self) -> Correction:
        """Return the best poses of all keyframes that `work` has taken in.

        They agree best with odometry, loops, and what the keyframes see of the same corners. They
        are for the end of a run: each keyframe that moves would move the map a little.
        """
        self._graph.optimise()
        self._graph.adjust(self._camera, self._config)
        return self._graph.correction(self._revision + 1)

    def restore(
        self,
        stamps_ns: Sequence[int],
        T_world_cam: NDArray[np.float64],
        submaps: Sequence[int] = (),
        keyframes: Iterable[Keyframe] = (),
        camera: PinholeCamera | None = None,
        features: Mapping[int, Features] = MappingProxyType({}),
    ) -> None:
        """Begin with the keyframes (K, 4, 4) of a map, which stay where they are to each other.

        `submaps` (K,) are those that each is in, by default all in one; loops may still join them.
        The tracker's next keyframe is to have the index K. Loops are found with those that are
        among `keyframes`, whose images were made by `camera`, by default the tracker's, and whose
        `features`, by index, may be known. Raises `BackEndError` if there are keyframes already.
        """
        self._graph.restore(stamps_ns, T_world_cam, submaps or [0] * len(stamps_ns))
        for keyframe in keyframes:
            number = keyframe.odometry.keyframe if keyframe.odometry else -1
            self._finder.add(keyframe, camera, features.get(number))
        self._told, self._told_submaps = self._graph.poses.copy(), list(self._graph.submaps)

    @property
    def places(self) -> Recogniser:
        """Recognises the places of the keyframes; may be called from any thread."""
        return self._finder.places

    @property
    def keyframes(self) -> int:
        """How many keyframes `work` has taken in."""
        return len(self._graph)

    @property
    def poses(self) -> NDArray[np.float64]:
        """(K, 4, 4) T_world_cam of the keyframes as they are now."""
        return self._graph.poses.copy()

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Loops that are believed."""
        return tuple(self._graph.loops)

    @property
    def rejected(self) -> tuple[Loop, ...]:
        """Loops that were believed until others contradicted."""
        return tuple(self._graph.rejected)

    def _insert(self, keyframe: Keyframe) -> None:
        if keyframe.odometry is None:
            raise BackEndError(f'keyframe {len(self._graph)} comes without its odometry')
        odometry = keyframe.odometry
        T, stamp_ns = keyframe.T_world_cam, keyframe.frame.stamp_ns
        self._graph.add(stamp_ns, T, odometry, keyframe.sightings)
        if len(odometry.hosts):
            T = self._told[odometry.hosts[-1]] @ odometry.T_host_cam[-1]
        self._told = np.concatenate([self._told, [T]])
        host = int(odometry.hosts[-1]) if len(odometry.hosts) else -1
        self._told_submaps.append(self._told_submaps[host] if host >= 0 else odometry.submap)
        if keyframe.has_image:
            self._finder.add(keyframe)

    def _close(self, keyframe: int) -> None:
        """Look for loops of a keyframe, and optimise with those that are believed."""
        found = self._finder.close(keyframe)
        if not found:
            return
        steps = self._graph.steps()
        for loop in found:
            self._consistency.add(loop, self._graph.poses, steps)
        believed = self._consistency.decide(self._graph.poses)
        if not believed:
            return
        submaps = self._graph.submaps
        self._graph.believe(believed)
        joined = submaps != self._graph.submaps
        if joined or any(_is_seen(self._graph.gap(loop)) for loop in believed):
            self._graph.optimise()
            self._moved = True

    def _is_worth_telling(self, correction: Correction) -> bool:
        """Return whether a keyframe moves notably, or sub-maps were joined."""
        if self._told_submaps != self._graph.submaps:
            return True
        T = correction.T_world_cam
        xi = np.array([se3.log(m) for m in se3.inverse(self._told) @ T])
        Ad = se3.adjoint(se3.inverse(T))
        claimed = Ad @ correction.covariances @ Ad.transpose(0, 2, 1)
        for part, seen in ((slice(0, 3), _SEEN_M), (slice(3, 6), _SEEN_RAD)):
            sigmas = np.sqrt(np.linalg.eigvalsh(claimed[:, part, part])[:, -1])
            limit = np.maximum(seen, _NOTABLE_SIGMAS * sigmas)
            if (np.linalg.norm(xi[:, part], axis=1) > limit).any():
                return True
        return False


def _is_seen(xi: NDArray[np.float64]) -> bool:
    """Return whether a motion (6,) would be seen in the map."""
    return bool(np.linalg.norm(xi[:3]) > _SEEN_M or np.linalg.norm(xi[3:]) > _SEEN_RAD)
