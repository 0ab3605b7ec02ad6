# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames of a file at the pace of the camera that took them."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass

from ..core.frame import RgbdFrame
from ..datasets.prefetch import prefetch
from ..datasets.source import BadFrame

_BACKLOG = 1000  # frames that may come while one is tracked


@dataclass(frozen=True)
class LateFrame:
    """A frame that a newer one overtook before anybody asked for it."""

    stamp_ns: int


def as_they_come(
    items: Iterable[RgbdFrame | BadFrame],
) -> Generator[RgbdFrame | BadFrame | LateFrame, None, None]:
    """Hand over every frame when it is asked for."""
    yield from items


def paced(
    items: Iterable[RgbdFrame | BadFrame],
) -> Generator[RgbdFrame | BadFrame | LateFrame, None, None]:
    """Hand over no frame before its time since the first one has passed on the clock.

    Of several that came due since the last was asked for only the newest is handed over; the
    others come as `LateFrame`. A frame that `items` brings late is late for all: it drops none.
    The thread that waits for the frames ends with this generator; `items` is to be closed then.
    """
    camera = _Camera(items)
    with closing(prefetch(camera, _BACKLOG)) as arrived:
        try:
            for item in arrived:
                if isinstance(item, RgbdFrame) and item.stamp_ns < camera.newest_ns:
                    yield LateFrame(item.stamp_ns)
                else:
                    yield item
        finally:
            camera.off.set()


class _Camera:
    """Yields each frame when it is due, and tells which is the newest."""

    def __init__(self, items: Iterable[RgbdFrame | BadFrame]) -> None:
        self._items = items
        self.newest_ns = 0
        self.off = threading.Event()

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        first_ns, start_s = None, 0.0
        for item in self._items:
            if isinstance(item, RgbdFrame):
                if first_ns is None:
                    first_ns, start_s = item.stamp_ns, time.monotonic()
                due_s = start_s + 1e-9 * (item.stamp_ns - first_ns)
                if self.off.wait(max(0.0, due_s - time.monotonic())):
                    return
                self.newest_ns = item.stamp_ns
            yield item
