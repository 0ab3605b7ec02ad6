# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Readings of other sensors on their way to the thread that tracks; no ROS in it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from heapq import merge

from ...core.priors.readings import Reading

_WAIT_S = 0.02  # at most, of a frame for readings of its time: they are smaller than images
_LIVELY_S = 0.1  # since its last reading: a sensor that is silent for longer is not waited for
_NEAR_NS = 200_000_000  # that readings lag: waiting for those that lag more is of no use
_KEPT = 2000  # while no frame comes: ten seconds at 200 Hz


class ReadingQueue:
    """Keeps the readings of several kinds until a frame of their time is tracked."""

    def __init__(self, reach_ns: Mapping[str, int]) -> None:
        """Take for each kind how long after the last reading a frame can do without another."""
        self._reach_ns = dict(reach_ns)
        self._waiting = {kind: deque[Reading](maxlen=_KEPT) for kind in reach_ns}
        self._newest_ns: dict[str, int] = {}
        self._came_s: dict[str, float] = {}  # monotonic
        self._changed = threading.Condition()

    def put(self, kind: str, reading: Reading) -> None:
        """Add a reading; return at once."""
        with self._changed:
            self._waiting[kind].append(reading)
            self._newest_ns[kind] = reading.stamp_ns
            self._came_s[kind] = time.monotonic()
            self._changed.notify()

    def take(self, stamp_ns: int) -> list[Reading]:
        """Return what has come, of each kind as it came, merged by stamp.

        Before that, wait a moment for the readings up to a frame's stamp.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._awaits(stamp_ns), _WAIT_S)
            readings = list(merge(*self._waiting.values(), key=lambda one: one.stamp_ns))
            for waiting in self._waiting.values():
                waiting.clear()
        return readings

    def _awaits(self, stamp_ns: int) -> bool:
        """Return whether readings up to a stamp are still to come, and soon."""
        now = time.monotonic()
        lag_ns = {
            kind: stamp_ns - self._reach_ns[kind] - newest_ns
            for kind, newest_ns in self._newest_ns.items()
            if now - self._came_s[kind] < _LIVELY_S
        }
        return any(0 < lag < _NEAR_NS for lag in lag_ns.values())
