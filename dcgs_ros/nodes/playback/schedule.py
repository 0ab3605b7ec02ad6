# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""When each item of a recording is due, and the clock then; no ROS in it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from ...datasets.source import SourceError

Item = TypeVar('Item')

_LOOP_GAP_NS = 33_333_333  # from the last frame to the first
_TICK_S = 0.025  # the clock's interval where no frame comes


@dataclass(frozen=True)
class ScheduledItem(Generic[Item]):
    """An item with the time when it is due."""

    elapsed_ns: int  # since the playback began, in the recording's time
    clock_ns: int  # time of the clock when it is due
    shift_ns: int  # to be added to the item's own stamps
    item: Item


def schedule(
    begin: Callable[[], Iterable[tuple[int, Item]]],
    start_s: float = 0.0,
    duration_s: float = 0.0,
    loop: bool = False,
    continuous_stamps: bool = False,
) -> Iterator[ScheduledItem[Item]]:
    """Yield the items, (stamp in ns, item) each, of a recording, which `begin` reads anew.

    The order is kept; an item with an earlier stamp than the one before is due together with it.
    `start_s` counts from the first stamp; a duration of 0 lasts to the end. In a loop the stamps
    jump back each time, or are shifted to go on. Raises `SourceError` where nothing is to be
    played.
    """
    elapsed_ns = 0
    while True:
        began_ns, first_ns = elapsed_ns, None
        for stamp_ns, item in _cut(begin(), round(1e9 * start_s), round(1e9 * duration_s)):
            if first_ns is None:
                first_ns = stamp_ns
            elapsed_ns = max(elapsed_ns, began_ns + stamp_ns - first_ns)
            shift_ns = began_ns if continuous_stamps else 0
            yield ScheduledItem(
                elapsed_ns, first_ns + elapsed_ns - began_ns + shift_ns, shift_ns, item
            )
        if first_ns is None:
            raise SourceError(f'nothing to replay: no frame from {start_s:g} s on')
        if not loop:
            return
        elapsed_ns += _LOOP_GAP_NS


class Pacer:
    """Waits until items are due, `rate` times as fast as they were recorded; 0: never waits."""

    def __init__(self, rate: float, tick: Callable[[int], None], stop: threading.Event) -> None:
        """`tick` gets the clock with each item, and between items; `stop` ends a wait."""
        self._rate = rate
        self._tick = tick
        self._stop = stop
        self._start_s: float | None = None
        self._elapsed_ns = 0

    def wait(self, scheduled: ScheduledItem[Any]) -> bool:
        """Return True when an item is due, False as soon as stopped."""
        if self._start_s is None:
            self._start_s = time.monotonic()
        if self._rate:
            due_s = self._start_s + 1e-9 * scheduled.elapsed_ns / self._rate
            while (left_s := due_s - time.monotonic()) > 0:
                left_ns = min(
                    round(1e9 * left_s * self._rate), scheduled.elapsed_ns - self._elapsed_ns
                )
                self._tick(scheduled.clock_ns - left_ns)
                if self._stop.wait(min(left_s, _TICK_S)):
                    return False
        self._elapsed_ns = scheduled.elapsed_ns
        self._tick(scheduled.clock_ns)
        return not self._stop.is_set()


def _cut(
    items: Iterable[tuple[int, Item]], start_ns: int, duration_ns: int
) -> Iterator[tuple[int, Item]]:
    """Yield from the first item that is not before the start to the last within the duration."""
    first_ns, begun = None, False
    for stamp_ns, item in items:
        if first_ns is None:
            first_ns = stamp_ns
        since_ns = stamp_ns - first_ns - start_ns
        if duration_ns and since_ns >= duration_ns:
            return
        begun = begun or since_ns >= 0
        if begun:
            yield stamp_ns, item
