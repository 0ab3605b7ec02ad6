# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""When the frames of a run arrive: as soon as they are asked for, or at their recorded pace."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass

from ...core.frame import RgbdFrame
from ...datasets.prefetch import prefetch
from ...datasets.source import BadFrame

_BACKLOG = 1000  # frames that may arrive while one is tracked


@dataclass(frozen=True)
class DroppedFrame:
    """A frame that was replaced by a newer one before the tracker was free."""

    stamp_ns: int


Arrival = RgbdFrame | BadFrame | DroppedFrame


def on_demand(items: Iterable[RgbdFrame | BadFrame]) -> Generator[Arrival, None, None]:
    """Yield every frame when it is asked for."""
    yield from items


def at_recorded_pace(items: Iterable[RgbdFrame | BadFrame]) -> Generator[Arrival, None, None]:
    """Yield each frame no earlier than its stamp, by the clock since the first frame.

    If several frames have become due since the last request, only the newest is yielded and the
    others as `DroppedFrame`. Delays of `items` itself drop nothing. Closing the generator ends
    the thread that waits for the frames; close `items` after it.
    """
    clock = _RecordedPace(items)
    with closing(prefetch(clock, _BACKLOG)) as arrived:
        try:
            for item in arrived:
                if isinstance(item, RgbdFrame) and item.stamp_ns < clock.newest_ns:
                    yield DroppedFrame(item.stamp_ns)
                else:
                    yield item
        finally:
            clock.stop.set()


class _RecordedPace:
    """Iterates over frames, waiting until each is due; runs in the prefetching thread."""

    def __init__(self, items: Iterable[RgbdFrame | BadFrame]) -> None:
        self._items = items
        self.newest_ns = 0  # stamp of the newest frame that was due so far
        self.stop = threading.Event()

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        first_ns, start_s = None, 0.0
        for item in self._items:
            if isinstance(item, RgbdFrame):
                if first_ns is None:
                    first_ns, start_s = item.stamp_ns, time.monotonic()
                due_s = start_s + 1e-9 * (item.stamp_ns - first_ns)
                if self.stop.wait(max(0.0, due_s - time.monotonic())):
                    return
                self.newest_ns = item.stamp_ns
            yield item
