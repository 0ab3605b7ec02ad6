# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""When what is replayed, and what the clock says then; no ROS here."""

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
    """When an item is due."""

    elapsed_ns: int  # of the recording's time since the playback began
    clock_ns: int  # what the clock says then
    shift_ns: int  # to be added to the item's own stamps
    item: Item


def schedule(
    begin: Callable[[], Iterable[tuple[int, Item]]],
    start_s: float = 0.0,
    duration_s: float = 0.0,
    loop: bool = False,
    continuous_stamps: bool = False,
) -> Iterator[ScheduledItem[Item]]:
    """Time the items of a recording, (stamp in ns, item) each, that `begin` reads from the first.

    They come in their order, one whose stamp is before its predecessor's together with that. 0 s
    is the first item's stamp; a duration of 0 lasts to the end. In a loop the stamps jump back
    each time, or are shifted to go on. Raises `SourceError` where there is nothing to play.
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
    """Waits until cues are due, `rate` times as fast as they were recorded; 0: does not wait."""

    def __init__(self, rate: float, tick: Callable[[int], None], stop: threading.Event) -> None:
        """`tick` gets the clock with each cue, and while there is none; `stop` ends a wait."""
        self._rate = rate
        self._tick = tick
        self._stop = stop
        self._start_s: float | None = None
        self._elapsed_ns = 0

    def wait(self, cue: ScheduledItem[Any]) -> bool:
        """Return when it is due: True; or at once when stopped: False."""
        if self._start_s is None:
            self._start_s = time.monotonic()
        if self._rate:
            due_s = self._start_s + 1e-9 * cue.elapsed_ns / self._rate
            while (left_s := due_s - time.monotonic()) > 0:
                left_ns = min(round(1e9 * left_s * self._rate), cue.elapsed_ns - self._elapsed_ns)
                self._tick(cue.clock_ns - left_ns)
                if self._stop.wait(min(left_s, _TICK_S)):
                    return False
        self._elapsed_ns = cue.elapsed_ns
        self._tick(cue.clock_ns)
        return not self._stop.is_set()


def _cut(
    items: Iterable[tuple[int, Item]], start_ns: int, duration_ns: int
) -> Iterator[tuple[int, Item]]:
    """Begin with the first that is not before the start, end with the last in the duration."""
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
