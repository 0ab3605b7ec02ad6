# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which keyframes odometry links, and where they are to each other."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..keyframe import Odometry
from ..tracking.hosting import VAGUE

# Edges of odometry over which the relative pose is good to some millimetres still.
_REACHED = 2
_HELD_M = 0.05  # standard deviation along the weakest direction
_SAME_RAD = 0.12  # a tenth of what a camera sees across


class Neighbourhood:
    """Links between keyframes by their index.

    A keyframe with the view of an earlier one can be left out. What is linked with it later is
    linked with the earlier one instead, so that the links of a place that is seen again and again
    do not grow.
    """

    def __init__(self) -> None:
        """Start without keyframes."""
        self._hosts: dict[int, dict[int, NDArray[np.float64]]] = {}  # T_host_cam of a keyframe
        self._links: defaultdict[int, set[int]] = defaultdict(set)  # both ways
        self._left_out: dict[int, tuple[int, NDArray[np.float64]]] = {}  # other, T_other_keyframe

    def add(self, odometry: Odometry) -> None:
        """Link a keyframe with its newest host, and with those that hold it in all directions.

        Back where the walls of a corridor were seen before it may be anywhere along them.
        """
        k = odometry.keyframe
        hosts = self._hosts[k] = {}
        for n in _holding(odometry.information):
            host, T_host_cam = int(odometry.hosts[n]), odometry.T_host_cam[n]
            other, T_other_host = self._left_out.get(host, (host, np.eye(4)))
            hosts.setdefault(other, T_other_host @ T_host_cam)
        self._links[k].update(hosts)
        for host in hosts:
            self._links[host].add(k)

    def same_view(self, keyframe: int, apart_m: float, among: Container[int]) -> int | None:
        """Return one of some others that is no farther apart and not turned; None if none is."""
        for other, T in self.around(keyframe, _REACHED).items():
            xi = se3.log(T)
            near = np.linalg.norm(xi[:3]) < apart_m and np.linalg.norm(xi[3:]) < _SAME_RAD
            if near and other in among:
                return other
        return None

    def leave_out(self, keyframe: int, other: int) -> None:
        """Leave out a keyframe; an earlier one with its view takes its place."""
        self._left_out[keyframe] = other, se3.inverse(self.around(keyframe, _REACHED)[other])
        for linked in self._links.pop(keyframe):
            self._links[linked].discard(keyframe)
        del self._hosts[keyframe]

    def around(self, keyframe: int, edges: int) -> dict[int, NDArray[np.float64]]:
        """Return T_keyframe_other (4, 4) of those within some edges, the fewest first."""
        found, frontier = {keyframe: np.eye(4)}, [keyframe]
        for _ in range(edges):
            reached = [(k, other) for k in frontier for other in sorted(self._links[k])]
            frontier = []
            for k, other in reached:
                if other not in found:
                    found[other] = found[k] @ self._step(k, other)
                    frontier.append(other)
        return found

    def _step(self, k: int, other: int) -> NDArray[np.float64]:
        """Return T_k_other of two that are linked."""
        T = self._hosts[k].get(other) if k in self._hosts else None
        return self._hosts[other][k] if T is None else se3.inverse(T)


def _holding(information: NDArray[np.float64]) -> list[int]:
    """Return which hosts, by their information (H, 6, 6), hold all of a position, and the last."""
    if not len(information):
        return []
    covariances = np.linalg.inv(information + VAGUE)[:, :3, :3]
    held = np.linalg.eigvalsh(covariances)[:, -1] < _HELD_M**2
    return [*np.flatnonzero(held[:-1]).tolist(), len(information) - 1]
