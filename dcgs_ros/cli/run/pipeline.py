# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The frames of a run: at their pace, through tracker and mapper, into the record."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass

from ...core.camera import PinholeCamera
from ...core.config.stages import Config
from ...core.errors import FrameError
from ...core.frame import RgbdFrame
from ...core.kernels.workers import Workers, cores
from ...core.mapping.mapper import Mapper
from ...core.mapping.warmup import warm_up_with_mapper
from ...core.render import make_renderer
from ...core.slam import Lockstep, MappingMode, Online
from ...core.tracking.tracker import Tracker, TrackResult
from ...core.tracking.warmup import warm_up
from ...datasets.prefetch import prefetch
from ...datasets.source import BadFrame
from ...evaluation.report import RunRecord, SkippedFrame, TrackedFrame
from .progress import Progress

_OVERTAKEN = 'dropped: a newer frame came before the tracker was free'


def follow(
    items: Iterable[RgbdFrame | BadFrame | LateFrame],
    tracker: Tracker,
    mapping: MappingMode,
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
    mapping: MappingMode, record: RunRecord, progress: Progress, stopped: Callable[[], bool]
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
    index: int, item: RgbdFrame | BadFrame | LateFrame, tracker: Tracker, mapping: MappingMode
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


_SLOW_S = 2.0  # a start that takes longer is explained


@dataclass(frozen=True)
class Slam:
    """What follows the frames."""

    tracker: Tracker
    mapping: MappingMode
    mapper: Mapper | None  # None: the run only tracks
    online: bool  # the clock counts


class NoMapping:
    """A `MappingMode` for runs that only track."""

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Hand nothing over."""

    def advance(self) -> None:
        """Do nothing."""

    def finish(self) -> Iterator[int]:
        """Leave nothing to do."""
        return iter(())


def threads_of_mapper(config: Config, online: bool) -> int:
    """Count the mapper's threads: as configured, else all cores, by turns with the tracker.

    Online both work at once, and the tracker has a core for itself.
    """
    return config.threads or max(1, cores() - online)


def start(
    camera: PinholeCamera, config: Config, mapping: bool, online: bool, workers: Workers
) -> Slam:
    """Make them, with all their kernels compiled."""
    with _explained_if_slow('dcgs: compiling kernels (once)'):
        (warm_up_with_mapper if mapping else warm_up)(camera, config)
    tracker = Tracker(camera, config)
    if not mapping:
        return Slam(tracker, NoMapping(), None, online)
    mapper = Mapper(camera, config, make_renderer(workers), workers)
    return Slam(tracker, (Online if online else Lockstep)(tracker, mapper), mapper, online)


@contextmanager
def _explained_if_slow(text: str) -> Iterator[None]:
    timer = threading.Timer(_SLOW_S, print, (text,), {'file': sys.stderr, 'flush': True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
