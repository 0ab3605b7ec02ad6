# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracker and mapper in one process: in lockstep, or the mapper in a thread of its own.

A mapping is called with each frame after the tracker, which it never makes wait: `after` hands
over and takes what is ready, `advance` does work that belongs to the mapper.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from .config.stages import Config
from .frame import RgbdFrame
from .kernels.workers import give_way
from .keyframe import Keyframe, MapUpdate
from .mapping.mapper import Mapper
from .tracking.tracker import Tracker, TrackingState, TrackResult


class Mapping(Protocol):
    """How mapping goes along with tracking."""

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Hand a tracked frame over, and give the tracker what the mapper has for it."""
        ...

    def advance(self) -> None:
        """Let the mapper work, where it does so only when told."""
        ...

    def finish(self) -> Iterator[int]:
        """Complete the map after the last frame; yields how many steps are left.

        It may be abandoned at any step.
        """
        ...


class KeyframeSelector:
    """Chooses the frames that the mapper gets, and makes keyframes of them."""

    def __init__(self, tracker: Tracker, config: Config) -> None:
        """Hand nothing over yet."""
        self._tracker = tracker
        self.interval = config.mapping.view_interval  # frames; may change at any time
        self._since = 0
        self._first: tuple[RgbdFrame, TrackResult] | None = None

    def after(self, frame: RgbdFrame, result: TrackResult) -> list[Keyframe]:
        """Make keyframes of what the mapper should see of this frame.

        Each of the tracker's, and others in between. The first one waits for the second frame,
        with which the tracker places its Gaussians once more.
        """
        if result.state is TrackingState.LOST:
            return []
        if self._tracker.keyframes == 1 and result.keyframe:
            self._first = frame, result
            return []
        chosen = self._opening()
        self._since += 1
        if result.keyframe or self._since >= self.interval:
            chosen.append((frame, result))
        if chosen:
            self._since, self._first = 0, None
        return [self._keyframe(*pair) for pair in chosen]

    def rest(self) -> list[Keyframe]:
        """Make a keyframe of the first frame, where no second one came."""
        chosen, self._first = self._opening(), None
        return [self._keyframe(*pair) for pair in chosen]

    def _opening(self) -> list[tuple[RgbdFrame, TrackResult]]:
        """Take the first frame, if it still waits, with the motion that is known by now."""
        if self._first is None:
            return []
        frame, result = self._first
        return [(frame, replace(result, T_cam_cam_at_depth=self._tracker.opening_motion))]

    def _keyframe(self, frame: RgbdFrame, result: TrackResult) -> Keyframe:
        gaussians = self._tracker.gaussians
        ids = result.spawned[gaussians.alive(result.spawned)]
        return Keyframe(
            frame, result.T_world_cam, result.T_cam_cam_at_depth, ids, *gaussians.of(ids)
        )


class Lockstep:
    """Mapper steps counted by frames, never by the clock: the same input gives the same bytes."""

    def __init__(self, tracker: Tracker, mapper: Mapper) -> None:
        """Go along with a tracker that has not tracked anything yet."""
        self._tracker, self._mapper = tracker, mapper
        self._handover = KeyframeSelector(tracker, mapper.config)
        self._arrived: list[Keyframe] = []
        self._due = 0.0

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Hand a frame over."""
        self._arrived += self._handover.after(frame, result)

    def advance(self) -> None:
        """Insert what arrived, take the steps that are due, and answer each keyframe."""
        answer = bool(self._arrived)
        for keyframe in self._arrived:
            self._mapper.insert(keyframe)
        self._arrived.clear()
        if not self._mapper.views:
            return
        self._due += self._mapper.config.mapping.steps_per_frame
        while self._due >= 1.0:
            self._due -= 1.0
            self._mapper.step()
        if answer:
            apply(self._mapper.update(), self._tracker)

    def finish(self) -> Iterator[int]:
        """Take the final steps over all views, with falling rates."""
        mapper, config = self._mapper, self._mapper.config
        for keyframe in self._handover.rest():
            mapper.insert(keyframe)
        left = config.mapping.final_steps if mapper.views else 0
        for rate in np.linspace(1.0, config.rates.final, left):
            mapper.step(float(rate), replay=True)
            left -= 1
            yield left


class Online:
    """The mapper runs free in its own thread, as in the node."""

    def __init__(self, tracker: Tracker, mapper: Mapper) -> None:
        """Start the thread; it ends with `finish`, or with the process."""
        self._tracker, self._mapper = tracker, mapper
        self._handover = KeyframeSelector(tracker, mapper.config)
        self._arrived: queue.SimpleQueue[Keyframe] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[MapUpdate] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name='mapper', daemon=True)
        self._thread.start()

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Hand a frame over; take the mapper's newest answer. Raises what the mapper raised."""
        if self._failure is not None:
            raise self._failure
        for keyframe in self._handover.after(frame, result):
            self._arrived.put(keyframe)
        if not self._answers.empty():
            apply(self._answers.get(), self._tracker)

    def advance(self) -> None:
        """Do nothing: the mapper is at work."""

    def _run(self) -> None:
        """Insert what arrived; otherwise optimise.

        Threads at equal priority made the tracker twice as slow at its 95th percentile.
        """
        try:
            give_way()
            while not self._stop.is_set():
                if not self._arrived.empty():
                    self._mapper.insert(self._arrived.get())
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
        for keyframe in self._handover.rest():
            self._arrived.put(keyframe)
        while not self._arrived.empty():
            self._mapper.insert(self._arrived.get())
        return iter(())


def apply(update: MapUpdate, tracker: Tracker) -> None:
    """Give the tracker what the mapper made of its Gaussians: their shape, and who is gone.

    Means stay as they were measured. The mapper's are within a fraction of sigma_z of them, and
    made the tracker slightly worse.
    """
    tracker.gaussians.remove(update.removed)
    tracker.gaussians.reshape(update.ids, update.normals, update.flatness)
