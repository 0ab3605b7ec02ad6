# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The back end in a thread of its own, which gives way to the tracker; no ROS in it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...core.backend.features import Features
from ...core.camera import PinholeCamera
from ...core.config.stages import Config
from ...core.frame import RgbdFrame
from ...core.kernels.workers import give_way
from ...core.keyframe import Correction, Keyframe
from ...core.tracking.relocalization import Recogniser, Recognition

_END_S = 5.0
_MOST_IMAGES = 50  # of keyframes that wait: 2 MB each at 640x480


@dataclass(frozen=True)
class KnownKeyframes:
    """The K keyframes of a map that a tracker goes on in."""

    stamps_ns: Sequence[int]
    T_world_cam: NDArray[np.float64]  # (K, 4, 4)
    submaps: Sequence[int]
    keyframes: Iterable[Keyframe] = ()  # those whose images are known, decoded one by one
    camera: PinholeCamera | None = None  # that made the images
    places: Recogniser | None = None  # knows them while the back end does not yet
    features: Mapping[int, Features] = field(default_factory=dict)  # those known, by index


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

    def restore(
        self,
        stamps_ns: Sequence[int],
        T_world_cam: NDArray[np.float64],
        submaps: Sequence[int],
        keyframes: Iterable[Keyframe],
        camera: PinholeCamera | None,
        features: Mapping[int, Features],
    ) -> None:
        """Begin with the keyframes of a map."""
        ...

    def add(self, keyframe: Keyframe) -> None:
        """Take the tracker's next keyframe."""
        ...

    def work(self) -> Correction | None:
        """Do what is due; return better poses where they matter."""
        ...


class Loops(Protocol):
    """What a session needs of the back ends of its maps, one after the other."""

    def begin(
        self, camera: PinholeCamera, config: Config, epoch: int, known: KnownKeyframes | None
    ) -> Recogniser | None:
        """Begin with a new map, or with one whose keyframes are `known`."""
        ...

    def leave(self) -> None:
        """Do nothing in the map that begins: it is not to change."""
        ...

    def add(self, keyframe: Keyframe) -> None:
        """Take the next keyframe of the map; return at once."""
        ...


class NoLoops:
    """Replaces the back end where it is not wanted."""

    def begin(
        self, camera: PinholeCamera, config: Config, epoch: int, known: KnownKeyframes | None
    ) -> None:
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
        self._queue: queue.SimpleQueue[Keyframe | _Map | None]
        self._queue = queue.SimpleQueue()
        self._map = _NO_MAP  # whose keyframes come
        self._bare = self._told = 0  # keyframes that came without their images; last warned of
        self._thread = threading.Thread(target=self._run, name='back end', daemon=True)
        self._thread.start()

    def begin(
        self, camera: PinholeCamera, config: Config, epoch: int, known: KnownKeyframes | None
    ) -> Recogniser:
        """Begin with a new map, or a `known` one; return what recognises its places.

        What is known is taken in by the thread: 1000 images take it seconds.
        """
        back_end = self._make(camera, config)
        begins = _Map(epoch, back_end, known)
        self._queue.put(begins)
        if known is None or known.places is None:
            return back_end.places
        return _Places(known.places, back_end.places, begins.restored)

    def leave(self) -> None:
        """Do nothing in the map that begins."""
        self._queue.put(_NO_MAP)

    def add(self, keyframe: Keyframe) -> None:
        """Queue the next keyframe; return at once.

        While too many wait it goes without its images: it is placed by its odometry alone.
        """
        if self._queue.qsize() >= _MOST_IMAGES:
            keyframe = keyframe.without_image()
            self._bare += 1
        self._queue.put(keyframe)

    def figures(self) -> dict[str, object]:
        """Return what diagnostics show."""
        back_end = self._map.back_end
        return {
            'loops': 0 if back_end is None else len(back_end.loops),
            'keyframes_unchecked': self._queue.qsize(),
            'keyframes_passed_over': self._bare,
        }

    def close(self) -> None:
        """End the thread, after what it is about."""
        self._queue.put(None)
        self._thread.join(_END_S)

    def _run(self) -> None:
        give_way()
        while (item := self._queue.get()) is not None:
            try:
                self._take(item)
            except Exception as error:  # the map goes on, as it would without loops
                self._map = _NO_MAP
                self._warn(f'no loops are looked for any more: {error}')

    def _take(self, item: Keyframe | _Map) -> None:
        """Begin with a map; or add a keyframe, and work once no other waits."""
        if isinstance(item, _Map):
            self._map = item.without_images()
            item.restore()
            return
        back_end = self._map.back_end
        if back_end is None:
            return
        back_end.add(item)
        if self._bare > self._told and self._queue.empty():
            self._warn(
                f'loops are looked for too slowly: {self._bare - self._told} keyframes were '
                f'passed over while {_MOST_IMAGES} waited'
            )
            self._told = self._bare
        correction = back_end.work() if self._queue.empty() else None
        if correction is not None:
            self._pass_on(correction, self._map.epoch)


@dataclass(frozen=True)
class _Map:
    epoch: int
    back_end: BackEnd | None
    known: KnownKeyframes | None = None
    restored: threading.Event = field(default_factory=threading.Event)

    def restore(self) -> None:
        """Have the back end begin with what is known."""
        known, back_end = self.known, self.back_end
        if known is not None and back_end is not None:
            back_end.restore(
                known.stamps_ns, known.T_world_cam, known.submaps, known.keyframes, known.camera,
                known.features,
            )  # fmt: skip
        self.restored.set()

    def without_images(self) -> _Map:
        """Return the same, which holds no images."""
        return _Map(self.epoch, self.back_end)


_NO_MAP = _Map(0, None)


class _Places:
    """The places of a map that is known: those of its file until the back end has them too."""

    def __init__(self, known: Recogniser, all_: Recogniser, restored: threading.Event) -> None:
        self._now, self._all, self._restored = known, all_, restored

    def knows(self, keyframe: int) -> bool:
        """Return whether a keyframe's place would be recognised."""
        return self._newest().knows(keyframe)

    def recognise(self, frame: RgbdFrame) -> list[Recognition]:
        """Return where a frame may have been taken, the likeliest first."""
        return self._newest().recognise(frame)

    def _newest(self) -> Recogniser:
        if self._restored.is_set():
            self._now = self._all
        return self._now
