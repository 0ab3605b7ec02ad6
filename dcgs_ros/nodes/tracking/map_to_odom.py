# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""map -> odom where another node, such as wheel odometry, broadcasts odom -> base; no ROS in it.

As rtabmap has it: the latest one is broadcast at a rate of its own, post-dated, lost or not.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core import se3

_PATIENCE_NS = 1_000_000_000  # that odom -> base may come later than the image's pose
_SAME_CLOCK_NS = 5_000_000_000  # between a stamp and the node's time; else a recording is played
_REWOUND_NS = 1_000_000_000  # as the tracker: farther back it is another clock


@dataclass(frozen=True)
class PlacedBase:
    """The base in the map at an image, and the keyframe that it moves with when that is corrected.

    A keyframe of -1 is none.
    """

    stamp_ns: int
    T_map_base: NDArray[np.float64]  # (4, 4)
    keyframe: int

    def moved(self, motions: NDArray[np.float64]) -> PlacedBase:
        """Return it after the keyframes moved by `motions` (K, 4, 4)."""
        if self.keyframe < 0:
            return self
        T = se3.orthonormalised(motions[self.keyframe] @ self.T_map_base)
        return replace(self, T_map_base=T)


@dataclass(frozen=True)
class OdomInMap:
    """What to broadcast."""

    stamp_ns: int
    T_map_odom: NDArray[np.float64]  # (4, 4)


class MapToOdom:
    """Pairs each pose of the base in the map with the other node's in odom at the same instant.

    Paired with the latest instead, every turn would show in map -> odom: 5.7 degrees at 1 rad/s
    and 100 ms. Poses wait for theirs in odom and hold up nobody. One thread tells of poses,
    another calls `at`.
    """

    def __init__(
        self,
        lookup: Callable[[int], NDArray[np.float64] | None],
        pair: str,
        warn: Callable[[str], None],
    ) -> None:
        """`lookup` returns T_odom_base (4, 4) at a stamp, or None; `pair` names it for `warn`."""
        self._lookup, self._pair, self._warn = lookup, pair, warn
        self._lock = threading.Lock()
        self._offset_ns = 0  # of the stamps to the node's time
        self._sent_ns: int | None = None
        self.forget()

    def forget(self) -> None:
        """Take note that a new map begins."""
        with self._lock:
            self._waiting: deque[PlacedBase] = deque()
            self._placed: PlacedBase | None = None
            self._T_odom_base = np.eye(4)  # at the same instant
            self.doubt: str | None = None  # why map -> odom is not renewed, if it is not

    def place(self, base: PlacedBase, now_ns: int) -> None:
        """Take where the base is in the map, at the node's time `now_ns`."""
        apart_ns = base.stamp_ns - now_ns
        with self._lock:
            self._offset_ns = apart_ns if abs(apart_ns) > _SAME_CLOCK_NS else 0
            if self._waiting and base.stamp_ns < self._waiting[-1].stamp_ns:
                self._waiting.clear()  # a recording begins again
            self._waiting.append(base)

    def correct(self, motions: NDArray[np.float64]) -> None:
        """Move with the keyframes, which moved by `motions` (K, 4, 4)."""
        with self._lock:
            self._waiting = deque(base.moved(motions) for base in self._waiting)
            if self._placed is not None:
                self._placed = self._placed.moved(motions)

    def at(self, now_ns: int, tolerance_ns: int) -> OdomInMap | None:
        """Return what to broadcast at the node's time `now_ns`.

        The stamp is that of now, in the clock of the images, and `tolerance_ns` more. It goes on
        without images, and back only with the clock. None: not known yet, or already sent.
        """
        with self._lock:
            self._pair_up()
            if self._placed is None:
                return None
            stamp_ns = now_ns + self._offset_ns + tolerance_ns
            if self._sent_ns is not None and 0 <= self._sent_ns - stamp_ns < _REWOUND_NS:
                return None
            self._sent_ns = stamp_ns
            T_map_odom = self._placed.T_map_base @ se3.inverse(self._T_odom_base)
            return OdomInMap(stamp_ns, T_map_odom)

    def _pair_up(self) -> None:
        """Pair the poses whose partner in odom has come; give up those that waited too long."""
        while self._waiting:
            T_odom_base = self._lookup(self._waiting[0].stamp_ns)
            if T_odom_base is not None:
                self._placed, self._T_odom_base = self._waiting.popleft(), T_odom_base
                self.doubt = None
            elif self._waiting[-1].stamp_ns - self._waiting[0].stamp_ns > _PATIENCE_NS:
                self._waiting.popleft()
                self._give_up()
            else:
                break

    def _give_up(self) -> None:
        if self.doubt is None:
            self.doubt = (
                f'TF has no {self._pair} at the stamps of the images, and map -> odom stays as it '
                'is: is its publisher running, with the clock of the images?'
            )
            self._warn(self.doubt)
