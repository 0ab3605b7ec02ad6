# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What belongs together by its stamps: colour with depth, and the parts of a keyframe."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...datasets.images.association import associate_stamps

_JUMP_NS = 1_000_000_000  # a stamp farther back is another time, not disorder
_INTERVALS = 15  # of a stream, for their median

C = TypeVar('C')
D = TypeVar('D')
T = TypeVar('T')


@dataclass(frozen=True)
class ImagePair(Generic[C, D]):
    """A colour image and the depth image nearest to it in time."""

    color_ns: int
    color: C
    depth_ns: int
    depth: D


class ImagePairing(Generic[C, D]):
    """Pairs two streams of images one to one, the closest first, as soon as a pair is certain.

    It is when no nearer partner can still come to either side, if each stream comes in order: at
    once for equal stamps, and for a distance below half the stream's interval. Pairs leave in the
    order of both stamps; what came before one that left is dropped.
    """

    def __init__(self, slop_ns: int, capacity: int = 8) -> None:
        """Pair what is within `slop_ns`; keep at most `capacity` images of a stream waiting."""
        self._slop_ns = slop_ns
        self._color: _Stream[C] = _Stream(capacity)
        self._depth: _Stream[D] = _Stream(capacity)
        self.paired = 0
        self.jumped_back = 0  # times that the clock did, by more than a second

    @property
    def unpaired_color(self) -> int:
        """Colour images that were dropped."""
        return self._color.dropped

    @property
    def unpaired_depth(self) -> int:
        """Depth images that were dropped."""
        return self._depth.dropped

    @property
    def disorder(self) -> int:
        """Images of either stream that came after one with the same or a later stamp."""
        return self._color.disorder + self._depth.disorder

    def color(self, stamp_ns: int, item: C) -> list[ImagePair[C, D]]:
        """Take a colour image; return the pairs that are certain now."""
        return self._added(self._color, stamp_ns, item)

    def depth(self, stamp_ns: int, item: D) -> list[ImagePair[C, D]]:
        """Take a depth image; return the pairs that are certain now."""
        return self._added(self._depth, stamp_ns, item)

    def clear(self) -> None:
        """Drop what waits and forget the clock."""
        self._color.clear()
        self._depth.clear()

    def _added(self, stream: _Stream[T], stamp_ns: int, item: T) -> list[ImagePair[C, D]]:
        if stream.latest_ns is not None and stamp_ns < stream.latest_ns - _JUMP_NS:
            self.jumped_back += 1
            self.clear()
        if not stream.add(stamp_ns, item):
            return []
        pairs = self._certain()
        self.paired += len(pairs)
        return pairs

    def _certain(self) -> list[ImagePair[C, D]]:
        """Take the pairs that nothing to come can change, oldest first."""
        color, depth = self._color, self._depth
        pairs: list[ImagePair[C, D]] = []
        while True:
            matched = associate_stamps(color.stamps(), depth.stamps(), self._slop_ns)
            certain = [m for m in matched if self._is_certain(*m)]
            if not certain:
                return pairs
            i, j = certain[0]
            color_ns, color_item = color.take(i)
            depth_ns, depth_item = depth.take(j)
            pairs.append(ImagePair(color_ns, color_item, depth_ns, depth_item))

    def _is_certain(self, i: int, j: int) -> bool:
        color_ns, depth_ns = self._color.waiting[i][0], self._depth.waiting[j][0]
        gap_ns = abs(color_ns - depth_ns)
        return self._depth.is_past(color_ns, gap_ns) and self._color.is_past(depth_ns, gap_ns)


class Joiner:
    """Joins messages of several topics that carry one stamp, in whatever order they arrive."""

    def __init__(self, names: Sequence[str], capacity: int = 8) -> None:
        """Join one message of each of `names`; keep at most `capacity` stamps incomplete."""
        self._names = frozenset(names)
        self._capacity = capacity
        self._parts: dict[int, dict[str, Any]] = {}
        self.dropped = 0  # stamps that stayed incomplete

    def add(self, name: str, stamp_ns: int, item: Any) -> dict[str, Any] | None:
        """Take a message; return all of its stamp, by name, once they are there."""
        parts = self._parts.setdefault(stamp_ns, {})
        parts[name] = item
        if parts.keys() >= self._names:
            return self._parts.pop(stamp_ns)
        if len(self._parts) > self._capacity:
            del self._parts[next(iter(self._parts))]  # the first to arrive
            self.dropped += 1
        return None


class _Stream(Generic[T]):
    """Images of one topic that wait for a partner."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self.dropped = 0
        self.disorder = 0
        self.waiting: list[tuple[int, T]] = []
        self.clear()

    def clear(self) -> None:
        self.dropped += len(self.waiting)
        self.waiting = []
        self.latest_ns: int | None = None
        self._taken_ns: int | None = None
        self._intervals_ns: deque[int] = deque(maxlen=_INTERVALS)

    def add(self, stamp_ns: int, item: T) -> bool:
        """Queue an image by its stamp; False where it comes too late."""
        if self.latest_ns is not None and stamp_ns <= self.latest_ns:
            self.disorder += 1
            late = self._taken_ns is not None and stamp_ns <= self._taken_ns
            if late or stamp_ns in self.stamps():
                self.dropped += 1
                return False
        else:
            if self.latest_ns is not None:
                self._intervals_ns.append(stamp_ns - self.latest_ns)
            self.latest_ns = stamp_ns
        self.waiting.append((stamp_ns, item))
        self.waiting.sort(key=lambda entry: entry[0])
        if len(self.waiting) > self._capacity:
            del self.waiting[0]
            self.dropped += 1
        return True

    def stamps(self) -> NDArray[np.int64]:
        return np.array([stamp_ns for stamp_ns, _ in self.waiting], np.int64)

    def is_past(self, stamp_ns: int, gap_ns: int) -> bool:
        """Nothing nearer to `stamp_ns` than `gap_ns` can still come."""
        if self.latest_ns is not None and self.latest_ns >= stamp_ns:
            return True
        return bool(self._intervals_ns) and 2 * gap_ns < statistics.median(self._intervals_ns)

    def take(self, index: int) -> tuple[int, T]:
        """Take an image and drop the older ones."""
        taken = self.waiting[index]
        self._taken_ns = taken[0]
        self.dropped += index
        del self.waiting[: index + 1]
        return taken
