# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The back end beside tracker and mapper: in lockstep, or in a thread of its own.

A closing mode gets each result of the tracker and never makes it wait: `after` hands keyframes
over and takes a correction that is ready, `advance` does the work where there is no thread.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .backend.back_end import BackEnd
from .backend.features import Features
from .camera import PinholeCamera
from .kernels.workers import give_way
from .keyframe import Correction, Keyframe
from .slam import MappingMode
from .tracking.result import TrackResult
from .tracking.tracker import Tracker


class ClosingMode(Protocol):
    """How the back end runs beside the tracker."""

    @property
    def loops(self) -> list[tuple[int, int]]:
        """The pairs of keyframes between which a loop is closed."""
        ...

    def after(self, result: TrackResult) -> None:
        """Hand the keyframes of a result over; apply a correction if there is one."""
        ...

    def advance(self) -> None:
        """Do the back end's work that is due, if it has no thread."""
        ...

    def finish(self) -> NDArray[np.float64] | None:
        """Do all that is left after the last frame, and end the thread if there is one.

        Return the best poses (K, 4, 4) of the keyframes, None without a back end. Tracker and
        mapper keep the ones that the map was made with.
        """
        ...


class NoClosing:
    """A `ClosingMode` that does nothing: the paper's system."""

    loops: list[tuple[int, int]] = []  # noqa: RUF012  never written

    def after(self, result: TrackResult) -> None:
        """Ignore the result."""

    def advance(self) -> None:
        """Do nothing."""

    def finish(self) -> None:
        """Return None."""


class _Mode:
    """What both modes have in common."""

    def __init__(self, tracker: Tracker, mapping: MappingMode) -> None:
        self._back_end = BackEnd(tracker.camera, tracker.config)
        self._tracker, self._mapping = tracker, mapping
        tracker.recogniser = self._back_end.places

    def restore(
        self,
        stamps_ns: Sequence[int],
        T_world_cam: NDArray[np.float64],  # (K, 4, 4)
        submaps: Sequence[int],
        keyframes: Iterable[Keyframe],
        camera: PinholeCamera,
        features: Mapping[int, Features],
    ) -> None:
        """Begin with the keyframes of a map that the tracker goes on in, as `BackEnd.restore`."""
        self._back_end.restore(stamps_ns, T_world_cam, submaps, keyframes, camera, features)

    @property
    def loops(self) -> list[tuple[int, int]]:
        """The pairs of keyframes between which a loop is closed."""
        return [(loop.a, loop.b) for loop in self._back_end.loops]

    def _last(self) -> NDArray[np.float64]:
        """Close the last loops, and return the best poses."""
        self._apply(self._back_end.work())
        return self._back_end.optimised().T_world_cam

    def _apply(self, correction: Correction | None) -> None:
        if correction is not None:
            self._tracker.correct(correction)
            self._mapping.correct(self._tracker.corrected_poses)


class ClosingInLockstep(_Mode):
    """The back end is done with a keyframe before the next frame: same input, same bytes."""

    def after(self, result: TrackResult) -> None:
        """Hand the keyframes over."""
        for keyframe in result.keyframes:
            self._back_end.add(keyframe)

    def advance(self) -> None:
        """Work, and correct tracker and mapper."""
        self._apply(self._back_end.work())

    def finish(self) -> NDArray[np.float64]:
        """Work on the keyframes that came last; return the best poses (K, 4, 4)."""
        return self._last()


class ClosingOnline(_Mode):
    """The back end works in its own thread; a correction is applied after the next frame."""

    def __init__(self, tracker: Tracker, mapping: MappingMode) -> None:
        """Start the thread; it ends with `finish`, or with the process."""
        super().__init__(tracker, mapping)
        self._ready: queue.SimpleQueue[Correction] = queue.SimpleQueue()
        self._news = threading.Event()
        self._stop = False
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name='back end', daemon=True)
        self._thread.start()

    def after(self, result: TrackResult) -> None:
        """Hand the keyframes over, take a correction. Raises what the back end raised."""
        if self._failure is not None:
            raise self._failure
        for keyframe in result.keyframes:
            self._back_end.add(keyframe)
            self._news.set()
        self._take()

    def _take(self) -> None:
        while not self._ready.empty():
            self._apply(self._ready.get())

    def advance(self) -> None:
        """Do nothing: the back end is at work."""

    def _run(self) -> None:
        try:
            give_way()
            while not self._stop:
                self._news.wait()
                self._news.clear()
                correction = self._back_end.work()
                if correction is not None:
                    self._ready.put(correction)
        except BaseException as error:  # shown by the thread that can
            self._failure = error

    def finish(self) -> NDArray[np.float64]:
        """End the thread, and do what it did not get to; return the best poses (K, 4, 4)."""
        self._stop = True
        self._news.set()
        self._thread.join()
        if self._failure is not None:
            raise self._failure
        self._take()
        return self._last()
