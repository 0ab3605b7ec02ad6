# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracker and mapper in one process: in lockstep, or the mapper in a thread of its own.

A mapping mode is called with each frame after the tracker and never makes it wait: `after`
exchanges keyframes and updates, `advance` does the mapper's work.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from .frame import RgbdFrame
from .kernels.workers import give_way
from .keyframe import Correction, MapUpdate, PosedFrame
from .mapping.mapper import Mapper
from .tracking.result import TrackResult
from .tracking.selector import KeyframeSelector
from .tracking.tracker import Tracker


class MappingMode(Protocol):
    """How the mapper runs beside the tracker."""

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Hand a tracked frame over, and give the tracker the mapper's update if there is one."""
        ...

    def correct(self, correction: Correction) -> None:
        """Move the map with its keyframes, once what was handed over before is in it."""
        ...

    def advance(self) -> None:
        """Do the mapper's work that is due, if it has no thread."""
        ...

    def between_steps(self, work: Callable[[Mapper], None]) -> None:
        """Have `work` called once, soon, where the mapper is at rest; it must not change it."""
        ...

    def finish(self) -> Iterator[int]:
        """Complete the map after the last frame; yield how many steps are left.

        The caller may stop at any step.
        """
        ...


class _Mode:
    """What both modes have in common."""

    def __init__(self, tracker: Tracker, mapper: Mapper) -> None:
        self._tracker, self._mapper = tracker, mapper
        self._selector = KeyframeSelector(mapper.config.mapping.view_interval)
        self._asked: queue.SimpleQueue[Callable[[Mapper], None]] = queue.SimpleQueue()

    def between_steps(self, work: Callable[[Mapper], None]) -> None:
        """Have `work` called once, soon, by the thread that drives the mapper."""
        self._asked.put(work)

    def _take(self, news: PosedFrame | Correction) -> None:
        if isinstance(news, Correction):
            self._mapper.correct(news)
        else:
            self._mapper.insert(news)

    def _answer(self) -> None:
        while not self._asked.empty():
            self._asked.get()(self._mapper)


class Lockstep(_Mode):
    """Mapper steps counted by frames, never by the clock: the same input gives the same bytes."""

    def __init__(self, tracker: Tracker, mapper: Mapper) -> None:
        """Take a tracker that has not tracked anything yet."""
        super().__init__(tracker, mapper)
        self._arrived: list[PosedFrame | Correction] = []
        self._due = 0.0

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Hand a frame over."""
        self._arrived += self._selector.select(self._tracker.corrected(frame), result)

    def correct(self, correction: Correction) -> None:
        """Take a correction."""
        self._arrived.append(correction)

    def advance(self) -> None:
        """Insert what arrived, take the steps that are due, and update the tracker."""
        self._answer()
        answer = bool(self._arrived)
        for news in self._arrived:
            self._take(news)
        self._arrived.clear()
        if not self._mapper.views:
            return
        self._due += self._mapper.config.mapping.steps_per_frame
        while self._due >= 1.0:
            self._due -= 1.0
            self._mapper.step()
        if answer:
            self._tracker.apply(self._mapper.update())

    def finish(self) -> Iterator[int]:
        """Take the final steps over all views, with falling rates."""
        mapper, config = self._mapper, self._mapper.config
        for news in [*self._arrived, *self._tracker.flush()]:
            self._take(news)
        left = config.mapping.final_steps if mapper.views else 0
        for rate in np.linspace(1.0, config.rates.final, left):
            mapper.step(float(rate), replay=True)
            self._answer()
            left -= 1
            yield left


class Online(_Mode):
    """The mapper runs free in its own thread, as in the node."""

    def __init__(self, tracker: Tracker, mapper: Mapper) -> None:
        """Start the thread; it ends with `finish`, or with the process."""
        super().__init__(tracker, mapper)
        self._arrived: queue.SimpleQueue[PosedFrame | Correction] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[MapUpdate] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name='mapper', daemon=True)
        self._thread.start()

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Hand a frame over; take the mapper's newest answer. Raises what the mapper raised."""
        if self._failure is not None:
            raise self._failure
        for posed in self._selector.select(self._tracker.corrected(frame), result):
            self._arrived.put(posed)
        if not self._answers.empty():
            self._tracker.apply(self._answers.get())

    def correct(self, correction: Correction) -> None:
        """Hand a correction over."""
        self._arrived.put(correction)

    def advance(self) -> None:
        """Do nothing: the mapper is at work."""

    def _run(self) -> None:
        """Insert what arrived; otherwise optimise.

        Threads at equal priority made the tracker twice as slow at its 95th percentile.
        """
        try:
            give_way()
            while not self._stop.is_set():
                self._answer()
                if not self._arrived.empty():
                    self._take(self._arrived.get())
                    self._answers.put(self._mapper.update())
                elif self._mapper.views:
                    self._mapper.step()
                else:
                    self._stop.wait(0.002)
        except BaseException as error:  # shown by the thread that can
            self._failure = error

    def finish(self) -> Iterator[int]:
        """Stop the thread; what it did not get to is inserted. Nothing follows the last frame."""
        self._stop.set()
        self._thread.join()
        if self._failure is not None:
            raise self._failure
        for posed in self._tracker.flush():
            self._arrived.put(posed)
        while not self._arrived.empty():
            self._take(self._arrived.get())
        return iter(())
