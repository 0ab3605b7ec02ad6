# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Pairs colour and depth images by their stamps."""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...datasets.images.association import associate_stamps

_JUMP_NS = 1_000_000_000  # a stamp farther back is of another clock, not disorder
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

    A pair is certain when no nearer partner can still come for either image, provided that each
    stream is in order: at once for equal stamps, and for a distance below half the stream's
    interval. Pairs leave in the order of both stamps; images older than one that left are dropped.
    """

    def __init__(self, slop_ns: int, capacity: int = 8) -> None:
        """Pair images within `slop_ns`; let at most `capacity` images of a stream wait."""
        self._slop_ns = slop_ns
        self._color: _Stream[C] = _Stream(capacity)
        self._depth: _Stream[D] = _Stream(capacity)
        self.paired = 0
        self.jumped_back = 0  # times that the clock jumped back by more than a second

    @property
    def unpaired_color(self) -> int:
        """Number of colour images that were dropped."""
        return self._color.dropped

    @property
    def unpaired_depth(self) -> int:
        """Number of depth images that were dropped."""
        return self._depth.dropped

    @property
    def disorder(self) -> int:
        """Number of images that came after one of their stream with the same or a later stamp."""
        return self._color.disorder + self._depth.disorder

    @property
    def apart_s(self) -> float:
        """Seconds from the newest stamp of depth to that of colour; 0 without either."""
        color_ns, depth_ns = self._color.latest_ns, self._depth.latest_ns
        return 0.0 if color_ns is None or depth_ns is None else 1e-9 * (color_ns - depth_ns)

    def color(self, stamp_ns: int, item: C) -> list[ImagePair[C, D]]:
        """Take a colour image; return the pairs that are certain now."""
        return self._added(self._color, stamp_ns, item)

    def depth(self, stamp_ns: int, item: D) -> list[ImagePair[C, D]]:
        """Take a depth image; return the pairs that are certain now."""
        return self._added(self._depth, stamp_ns, item)

    def clear(self) -> None:
        """Drop the images that wait and forget the clock."""
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
        """Take the pairs that no later image can change, oldest first."""
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
        """Queue an image by its stamp; return False where it comes too late."""
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
        """Return whether no image nearer to `stamp_ns` than `gap_ns` can still come."""
        if self.latest_ns is not None and self.latest_ns >= stamp_ns:
            return True
        return bool(self._intervals_ns) and 2 * gap_ns < statistics.median(self._intervals_ns)

    def take(self, index: int) -> tuple[int, T]:
        """Take an image, and drop the older ones."""
        taken = self.waiting[index]
        self._taken_ns = taken[0]
        self.dropped += index
        del self.waiting[: index + 1]
        return taken
