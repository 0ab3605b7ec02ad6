# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The back end in a thread of its own, which gives way to the tracker; no ROS in it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from typing import Protocol

from ...core.camera import PinholeCamera
from ...core.config.stages import Config
from ...core.kernels.workers import give_way
from ...core.keyframe import Correction, Keyframe
from ...core.tracking.relocalization import Recogniser

_END_S = 5.0


class BackEnd(Protocol):
    """What finds loops among the keyframes of one map, and better poses."""

    @property
    def places(self) -> Recogniser:
        """Recognises the places of the keyframes; may be called from any thread."""
        ...

    @property
    def loops(self) -> Sequence[object]:
        """Loops that are believed."""
        ...

    def add(self, keyframe: Keyframe) -> None:
        """Take the tracker's next keyframe."""
        ...

    def work(self) -> Correction | None:
        """Do what is due; return better poses where they matter."""
        ...


class Loops(Protocol):
    """What a session needs of the back ends of its maps, one after the other."""

    def begin(self, camera: PinholeCamera, config: Config, epoch: int) -> Recogniser | None:
        """Begin with a new map."""
        ...

    def leave(self) -> None:
        """Do nothing in the map that begins: it has keyframes that are not known here."""
        ...

    def add(self, keyframe: Keyframe) -> None:
        """Take the next keyframe of the map; return at once."""
        ...


class NoLoops:
    """Replaces the back end where it is not wanted."""

    def begin(self, camera: PinholeCamera, config: Config, epoch: int) -> None:
        """Do nothing."""

    def leave(self) -> None:
        """Do nothing."""

    def add(self, keyframe: Keyframe) -> None:
        """Do nothing."""

    def figures(self) -> dict[str, object]:
        """Return nothing."""
        return {}

    def close(self) -> None:
        """Do nothing."""


class BackEndWorker:
    """Runs the back end of the current map; the tracker never waits for it."""

    def __init__(
        self,
        make: Callable[[PinholeCamera, Config], BackEnd],
        on_correction: Callable[[Correction, int], object],
        warn: Callable[[str], None],
    ) -> None:
        """Start the thread.

        `make` makes the back end of a map. `on_correction` gets a correction and the epoch of its
        map, from the thread. A back end that raises is left, with a warning.
        """
        self._make, self._pass_on, self._warn = make, on_correction, warn
        self._queue: queue.SimpleQueue[Keyframe | tuple[int, BackEnd | None] | None]
        self._queue = queue.SimpleQueue()
        self._epoch = 0
        self._back_end: BackEnd | None = None  # of the map whose keyframes come
        self._thread = threading.Thread(target=self._run, name='back end', daemon=True)
        self._thread.start()

    def begin(self, camera: PinholeCamera, config: Config, epoch: int) -> Recogniser:
        """Begin with a new map; return what recognises its places."""
        back_end = self._make(camera, config)
        self._queue.put((epoch, back_end))
        return back_end.places

    def leave(self) -> None:
        """Do nothing in the map that begins."""
        self._queue.put((0, None))

    def add(self, keyframe: Keyframe) -> None:
        """Queue the next keyframe; return at once."""
        self._queue.put(keyframe)

    def figures(self) -> dict[str, object]:
        """Return what diagnostics show."""
        back_end = self._back_end
        return {
            'loops': 0 if back_end is None else len(back_end.loops),
            'keyframes_unchecked': self._queue.qsize(),
        }

    def close(self) -> None:
        """End the thread, after what it is about."""
        self._queue.put(None)
        self._thread.join(_END_S)

    def _run(self) -> None:
        give_way()
        while (item := self._queue.get()) is not None:
            if isinstance(item, tuple):
                self._epoch, self._back_end = item
            else:
                self._take(item)

    def _take(self, keyframe: Keyframe) -> None:
        """Add a keyframe, and work once no other waits."""
        back_end = self._back_end
        if back_end is None:
            return
        try:
            back_end.add(keyframe)
            correction = back_end.work() if self._queue.empty() else None
        except Exception as error:  # the map goes on, as it would without loops
            self._back_end = None
            self._warn(f'no loops are looked for any more: {error}')
            return
        if correction is not None:
            self._pass_on(correction, self._epoch)
