# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames through tracker and mapper, one by one, into the record of the run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice

from ..core.errors import FrameError
from ..core.frame import RgbdFrame
from ..core.jit import set_kernel_threads
from ..core.slam import Mapping
from ..core.tracker import Tracker
from ..core.workers import give_way
from ..datasets.source import BadFrame, Source
from ..evaluation.report import RunRecord, SkippedFrame, TrackedFrame
from .pacing import LateFrame
from .progress import Progress

_OVERTAKEN = 'dropped: a newer frame came before the tracker was free'


def read(source: Source, total: int, quietly: bool) -> Iterator[RgbdFrame | BadFrame]:
    """Read in the background; `quietly` in a thread that gives way to all others.

    At equal priority decoding costs the tracker a third of its speed on two cores (measured). But
    it has to keep up with the clock online, where the mapper takes whatever is left of them. A
    synthetic source's kernels may not take all the cores either.
    """
    set_kernel_threads(None)
    if quietly:
        give_way()
    yield from islice(source, total)


def follow(
    items: Iterable[RgbdFrame | BadFrame | LateFrame],
    tracker: Tracker,
    mapping: Mapping,
    record: RunRecord,
    progress: Progress,
    stopped: Callable[[], bool],
) -> None:
    """Track and map frame by frame into `record`, until the last one or until `stopped`."""
    start = time.perf_counter()
    for index, item in enumerate(items):
        step = _step(index, item, tracker, mapping)
        if isinstance(step, TrackedFrame):
            record.tracked.append(step)
            progress.tracked(step)
        else:
            record.skipped.append(step)
            progress.skipped(step)
        before = time.perf_counter()
        mapping.advance()
        now = time.perf_counter()
        record.mapping_s += now - before
        record.wall_s = now - start
        if stopped():
            return
    record.interrupted = False


def refine(
    mapping: Mapping, record: RunRecord, progress: Progress, stopped: Callable[[], bool]
) -> None:
    """Optimise the map further, until it is done or `stopped`: then for one more step."""
    start = time.perf_counter()
    try:
        for left in mapping.finish():
            progress.refined(left)
            if left and stopped():
                record.interrupted = True
                return
    finally:
        record.mapping_s += time.perf_counter() - start


def _step(
    index: int, item: RgbdFrame | BadFrame | LateFrame, tracker: Tracker, mapping: Mapping
) -> TrackedFrame | SkippedFrame:
    """Track one frame and hand it to the mapper, timed, or say why not."""
    if isinstance(item, BadFrame):
        return SkippedFrame(index, None, item.name, item.reason)
    name = f'frame {index + 1}'
    if isinstance(item, LateFrame):
        return SkippedFrame(index, item.stamp_ns, name, _OVERTAKEN, dropped=True)
    start = time.perf_counter()
    try:
        result = tracker.track(item)
    except FrameError as error:
        return SkippedFrame(index, item.stamp_ns, name, str(error))
    mapping.after(item, result)
    return TrackedFrame(index, result, time.perf_counter() - start, len(tracker.gaussians))
