# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A tracker whose camera may reconnect, change, or play its recording again; no ROS in it."""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.config.stages import Config
from ...core.errors import FrameError
from ...core.frame import RgbdFrame
from ...core.keyframe import MapUpdate, PosedFrame
from ...core.tracking.selector import KeyframeSelector
from ...core.tracking.tracker import Tracker, TrackResult
from ..messages.ids import EPOCHS
from .map_mirror import Resumable

_GAP_NS = 500_000_000  # over a longer one nobody knows how the camera moved
_REWOUND_NS = 1_000_000_000  # a stamp so far back is another clock; less is disorder


def new_epoch() -> int:
    """Draw a number for a new map: ids of two maps never meet."""
    return 1 + secrets.randbelow(EPOCHS - 1)


class Tracking:
    """Frames in, poses and keyframes out, over everything that may happen to a camera.

    All but `alive` belongs to one thread, since a tracker's threads do.
    """

    def __init__(
        self, config: Config, T_world_first: NDArray[np.float64], say: Callable[[str], None]
    ) -> None:
        """Wait for the first camera; `say` is told what a user should know."""
        self.config, self.epoch = config, new_epoch()
        self.counts: Counter[str] = Counter()  # of frames, by what became of them
        self.tracker: Tracker | None = None
        self.T_world_first, self._say = T_world_first, say
        self._selector = KeyframeSelector(config.mapping.view_interval)
        self._resumable: Resumable | None = None
        self._stamp_ns = 0
        self._names: set[int] = set()  # stamps of keyframes

    def resume(self, resumable: Resumable) -> None:
        """Go on in a map that somebody else kept; to be called before the first frame."""
        self._resumable = resumable
        self._names |= resumable.stamps_ns

    def reset(self) -> None:
        """Begin a new map, at the place and with the camera of the first frame to come."""
        self.tracker, self._resumable = None, None
        self.epoch, self._stamp_ns = new_epoch(), 0

    def reconfigure(self, config: Config) -> None:
        """Take other settings over, those that may change at run time."""
        self.config = config
        if self.tracker is not None:
            self.tracker.reconfigure(config)
        self._selector.interval = config.mapping.view_interval

    def track(self, frame: RgbdFrame, camera: PinholeCamera) -> TrackResult | None:
        """Track a frame; None, counted and said, where it is of no use."""
        if self.tracker is None or camera != self.tracker.camera:
            self._begin(camera)
        tracker = self.tracker
        assert tracker is not None
        if frame.stamp_ns < self._stamp_ns - _REWOUND_NS:
            back_s = (self._stamp_ns - frame.stamp_ns) * 1e-9
            self._say(f'stamps went back by {back_s:.1f} s: looking for the camera in the map')
            tracker.interrupt()
        elif self._stamp_ns and frame.stamp_ns > self._stamp_ns + _GAP_NS:
            gap_s = (frame.stamp_ns - self._stamp_ns) * 1e-9
            self._say(f'no frame for {gap_s:.1f} s: looking for the camera in the map')
            tracker.interrupt()
        try:
            result = tracker.track(frame)
        except FrameError as error:
            self.counts['refused'] += 1
            self._say(f'frame refused: {error}')
            return None
        self._stamp_ns = frame.stamp_ns
        self.counts[result.state.value] += 1
        return result

    def _begin(self, camera: PinholeCamera) -> None:
        """Make the tracker of this camera: the first one, or another one at the last pose."""
        T_world_first, last = self.T_world_first, self.tracker
        if last is not None:
            before, now = last.camera, camera
            self._say(
                f'the camera changed from {before.width}x{before.height}, fx {before.fx:.1f}, to '
                f'{now.width}x{now.height}, fx {now.fx:.1f}: a new map begins at the last pose'
            )
            T_world_first = last.T_world_cam
            self.reset()
        self.tracker = Tracker(camera, self.config, T_world_first)
        if self._resumable is not None:
            self.epoch = self._resumable.epoch
            self.tracker.resume(self._resumable.gaussians(self.config), self._resumable.poses)
        self._selector = KeyframeSelector(self.config.mapping.view_interval)

    def selected(self, frame: RgbdFrame, result: TrackResult) -> list[PosedFrame]:
        """Return the keyframes and views that the mapper should get now.

        Their stamps are their names: where a recording is played again the later ones are moved
        on by a nanosecond or more.
        """
        chosen = self._selector.select(frame, result)
        return [replace(posed, frame=self._named(posed.frame)) for posed in chosen]

    def _named(self, frame: RgbdFrame) -> RgbdFrame:
        stamp_ns = frame.stamp_ns
        while stamp_ns in self._names:
            stamp_ns += 1
        self._names.add(stamp_ns)
        return replace(frame, stamp_ns=stamp_ns)

    def answer(self, update: MapUpdate, epoch: int) -> None:
        """Take what the mapper made of the Gaussians, if it is of this map."""
        if self.tracker is not None and epoch == self.epoch:
            self.tracker.apply(update)

    def alive(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which Gaussians there still are; any thread may ask."""
        tracker = self.tracker
        return np.zeros(len(ids), np.bool_) if tracker is None else tracker.gaussians.alive(ids)
