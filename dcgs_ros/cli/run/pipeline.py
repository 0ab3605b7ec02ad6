# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames through tracker and mapper, and what came of each into the record of the run."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from ...core.backend.warmup import warm_up as warm_up_back_end
from ...core.camera import PinholeCamera
from ...core.config.stages import Config
from ...core.errors import FrameError
from ...core.frame import RgbdFrame
from ...core.kernels.workers import Workers
from ...core.keyframe import Correction
from ...core.loop_closing import ClosingInLockstep, ClosingMode, ClosingOnline, NoClosing
from ...core.mapping.mapper import Mapper
from ...core.mapping.warmup import warm_up_with_mapper
from ...core.priors.motion_priors import MotionPriors
from ...core.slam import Lockstep, MappingMode, Online
from ...core.tracking.result import TrackResult
from ...core.tracking.tracker import Tracker
from ...core.tracking.warmup import warm_up
from ...datasets.readings import Readings
from ...datasets.source import BadFrame
from ...evaluation.report import FinalMap, RunRecord, SkippedFrame, TrackedFrame
from ...io.known_places import KnownView, features_of, keyframes_of, places_of
from ...io.map_archive import SavedMap
from ...io.sessions import SavedSession
from ...io.snapshot import restore_mapper
from .pacing import Arrival, DroppedFrame
from .progress import Progress

_DROPPED = 'dropped: a newer frame came before the tracker was free'
_SLOW_S = 2.0  # a start that takes longer is explained


def start(
    camera: PinholeCamera,
    config: Config,
    mapping: bool,
    online: bool,
    workers: Workers,
    known: SavedMap | None = None,
    localize: bool = False,
    priors: MotionPriors | None = None,
    readings: Readings | None = None,
) -> Pipeline:
    """Create tracker and mapper, with all their kernels compiled, in the `known` map if any.

    With `localize` the tracker leaves that map as it is; `priors` take the `readings`. Raises
    `MapFileError` for a map without keyframes, or of another camera than the mapper's.
    """
    with _explained_if_slow('dcgs: compiling kernels (once)'):
        (warm_up_with_mapper if mapping else warm_up)(camera, config)
    tracker = Tracker(camera, config, priors=priors)
    if known is not None:
        known.tracker.resume(tracker, known.camera)
        tracker.localize_only = localize
    mapper = Mapper(camera, config, workers=workers) if mapping else None
    mode: MappingMode = NoMapping()
    if mapper is not None:
        if known is not None:
            restore_mapper(mapper, known)
        mode = (Online if online else Lockstep)(tracker, mapper)
    sessions = known.sessions if known is not None else ()
    closing = _closing(tracker, mode, online, known)
    return Pipeline(tracker, mode, closing, mapper, online, sessions, readings)


def _closing(
    tracker: Tracker, mapping: MappingMode, online: bool, known: SavedMap | None
) -> ClosingMode:
    """Create the back end, with what is known of the `known` map's places; or only those."""
    camera, config = tracker.camera, tracker.config
    views = [
        KnownView(view.keyframe, view.color_jpeg, view.depth_png, view.features)
        for view in (() if known is None else known.keyframes)
        if view.keyframe >= 0
    ]
    if tracker.localize_only or not config.backend.loops:
        if known is not None:
            features = features_of(views, known.camera, known.config.sensor)
            tracker.recogniser = places_of(features, camera, config)
        return NoClosing()
    with _explained_if_slow('dcgs: compiling kernels (once)'):
        warm_up_back_end(camera)
    closing = (ClosingOnline if online else ClosingInLockstep)(tracker, mapping)
    if known is not None:
        saved, undistorted = known.tracker, replace(known.camera, distortion=())
        closing.restore(
            saved.stamps_ns.tolist(), saved.poses, saved.submaps.tolist(),
            keyframes_of(views, saved), undistorted,
            {view.keyframe: view.features for view in views if view.features is not None},
        )  # fmt: skip
    return closing


@dataclass(frozen=True)
class Pipeline:
    """Tracker and mapper of a run."""

    tracker: Tracker
    mapping: MappingMode
    closing: ClosingMode
    mapper: Mapper | None  # None: the run only tracks
    online: bool  # frames arrive at their recorded pace
    sessions: tuple[SavedSession, ...] = ()  # before this one, of the map that it extends
    readings: Readings | None = None  # of other sensors

    def process(
        self,
        items: Iterable[Arrival],
        record: RunRecord,
        progress: Progress,
        stopped: Callable[[], bool],
    ) -> None:
        """Track and map frame by frame into `record`, until the last one or until `stopped`."""
        start = time.perf_counter()
        for index, item in enumerate(items):
            if isinstance(item, RgbdFrame):
                record.depth.add(item)
            outcome = self._track(index, item)
            if isinstance(outcome, TrackedFrame):
                record.tracked.append(outcome)
                progress.tracked(outcome)
            else:
                record.skipped.append(outcome)
                progress.skipped(outcome)
            before = time.perf_counter()
            self.mapping.advance()
            mapped = time.perf_counter()
            self.closing.advance()
            now = time.perf_counter()
            record.mapping_s += mapped - before
            record.closing_s += now - mapped
            record.frames_s = now - start
            if stopped():
                return
        record.interrupted = False

    def _track(self, index: int, item: Arrival) -> TrackedFrame | SkippedFrame:
        """Track one frame and pass it to the mapper, timed; or say why it is skipped."""
        if isinstance(item, BadFrame):
            return SkippedFrame(index, None, item.name, item.reason)
        name = f'frame {index + 1}'
        if isinstance(item, DroppedFrame):
            return SkippedFrame(index, item.stamp_ns, name, _DROPPED, dropped=True)
        start = time.perf_counter()
        for reading in () if self.readings is None else self.readings.until(item.stamp_ns):
            self.tracker.sense(reading)
        try:
            result = self.tracker.track(item)
        except FrameError as error:
            return SkippedFrame(index, item.stamp_ns, name, str(error))
        self.mapping.after(item, result)
        self.closing.after(result)
        seconds = time.perf_counter() - start
        kept = replace(result, keyframes=())  # their images would fill the memory of a long run
        return TrackedFrame(index, kept, seconds, len(self.tracker.gaussians))

    def refine(self, record: RunRecord, progress: Progress, stopped: Callable[[], bool]) -> None:
        """Close the last loops, then optimise the map; once `stopped`, at most one more step."""
        start = time.perf_counter()
        try:
            poses, tracker = self.closing.finish(), self.tracker
            if poses is not None:
                mapped = tracker.keyframe_poses  # one may never have been handed over
                poses = np.concatenate([poses, mapped[len(poses) :]])
                record.final = FinalMap(
                    poses, mapped, tracker.keyframe_submaps, self.closing.loops
                )
        finally:
            record.closing_s += time.perf_counter() - start
            self._refine_map(record, progress, stopped)

    def _refine_map(
        self, record: RunRecord, progress: Progress, stopped: Callable[[], bool]
    ) -> None:
        start = time.perf_counter()
        try:
            for left in self.mapping.finish():
                progress.refined(left)
                if left and stopped():
                    record.interrupted = True
                    return
        finally:
            record.mapping_s += time.perf_counter() - start


class NoMapping:
    """A `MappingMode` that does nothing, for runs that only track."""

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Ignore the frame."""

    def correct(self, correction: Correction) -> None:
        """Ignore the correction."""

    def advance(self) -> None:
        """Do nothing."""

    def between_steps(self, work: Callable[[Mapper], None]) -> None:
        """Never call `work`: there is no mapper."""

    def finish(self) -> Iterator[int]:
        """Return no steps."""
        return iter(())


@contextmanager
def _explained_if_slow(text: str) -> Iterator[None]:
    timer = threading.Timer(_SLOW_S, print, (text,), {'file': sys.stderr, 'flush': True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
