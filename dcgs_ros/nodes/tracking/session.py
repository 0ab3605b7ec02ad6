# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A tracker whose camera may reconnect, change, or play its recording again; no ROS in it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.camera import PinholeCamera
from ...core.config.stages import Config
from ...core.errors import DcgsError, FrameError
from ...core.frame import RgbdFrame
from ...core.keyframe import Correction, Keyframe, MapUpdate, PosedFrame
from ...core.priors.motion_priors import MotionPriors
from ...core.tracking.expectation import ExpectedPlace
from ...core.tracking.result import TrackingState, TrackResult
from ...core.tracking.selector import KeyframeSelector
from ...core.tracking.tracker import Tracker
from ..messages.ids import first_epoch, next_epoch
from ..messages.packet import KeyframePacket
from .back_end_worker import Loops, NoLoops
from .corrected import Corrected
from .health import numbers
from .known_map import Known, KnownMap

_OTHER_CAMERA = 'the map was made with another camera: it can be tracked in, but not extended'
_LOOKING = 'looking for the camera in the map'
AFTER_RESET = 'the next frame begins a new map'
_STILL = 1e-6  # m and rad that rounding may move a keyframe which stays where it is


class TrackingSession:
    """Frames in, poses and keyframes out, whatever happens to the camera.

    All but `alive` and `figures` belongs to one thread, since a tracker's threads do.
    """

    def __init__(
        self,
        config: Config,
        T_world_first: NDArray[np.float64],
        warn: Callable[[str], None],
        loops: Loops | None = None,
        localize_only: bool = False,
        priors: MotionPriors | None = None,
    ) -> None:
        """Wait for the first camera; `warn` gets the lines for the log, `loops` the keyframes.

        `priors` are what other sensors tell, in all of its maps. With `localize_only` the map of
        `resume` stays as it is, and is never left.
        """
        self._own_epoch = first_epoch()  # of the last map that is not another tracker's
        self.config, self.epoch = config, self._own_epoch
        self.counts: Counter[str] = Counter()  # of frames, by state, or 'refused'
        self.result: TrackResult | None = None  # of the last frame; None where it was refused
        self.refusal = ''  # why the last frame was refused
        self.ms = 0.0  # time that the last frame took
        self.ever_tracked = False  # in this map
        self.tracker: Tracker | None = None
        self.T_world_first, self._warn = T_world_first, warn
        self._selector = KeyframeSelector(config.mapping.view_interval)
        self._resumable: Known | None = None
        self._localize_only = localize_only
        self._expected: ExpectedPlace | None = None  # until there is a tracker
        self._stamp_ns: int | None = None  # of the last frame
        self._held = False  # whether the camera's place was known then
        self._keyframe_stamps: set[int] = set()
        self._names: dict[int, int] = {}  # stamps of this tracker's keyframes, by their index
        self._others: dict[int, int] = {}  # the same of the tracker before, in whose map it is
        self._loops = loops or NoLoops()
        self._priors = priors

    def resume(self, resumable: Known) -> None:
        """Go on in the map of another tracker; to be called before the first frame."""
        self._resumable = resumable
        self._keyframe_stamps.update(resumable.stamps_ns)

    @property
    def known(self) -> Known | None:
        """The map that it goes on in."""
        return self._resumable

    def load(self, known: Known) -> None:
        """Go on in another map, from the next frame on."""
        self.reset()
        self.resume(known)

    def reset(self) -> str:
        """Begin a new map, at the place and with the camera of the next frame.

        Where it only localises, begin anew in the same one. Return what comes of it.
        """
        self.tracker = None
        if not self._localize_only:
            self._resumable = None
        self.epoch = self._own_epoch = next_epoch(self._own_epoch)
        self._stamp_ns, self._held, self.ever_tracked = None, False, False
        self._expected = None
        return _LOOKING if self._localize_only else AFTER_RESET

    def remount(self, T_base_cam: NDArray[np.float64], frame: RgbdFrame) -> None:
        """Take the pose (4, 4) of the camera on the base; where another was assumed, begin anew.

        The new map's world is the base where tracking began, as the old one's was meant to be. In
        the map of another tracker the world stays. `frame` is the next one to be tracked.
        """
        assumed, self.T_world_first = self.T_world_first, T_base_cam
        last = self.tracker
        if last is None or self._resumable is not None:
            return
        with suppress(FrameError):
            last.track(frame)  # so that the new map begins where the camera is by now
        T_world_cam = T_base_cam @ se3.inverse(assumed) @ last.T_world_cam
        self._warn('the camera is elsewhere on the base than assumed: a new map begins')
        self.reset()
        self._begin(last.camera, T_world_cam)

    def expect(self, place: ExpectedPlace) -> None:
        """Look for the camera first where somebody says that it is, from the next frame on."""
        position = ', '.join(f'{x:.2f}' for x in place.T_world_cam[:3, 3])
        if self.tracker is None and self._resumable is not None:
            self._expected = place
        elif self.tracker is None or not self.tracker.keyframes:
            self._warn(f'the camera is said to be at {position} m, but there is no map yet')
        elif self.tracker.expect(place):
            self._held = False
            self._warn(f'the camera is looked for around {position} m, where it is said to be')

    def reconfigure(self, config: Config) -> None:
        """Apply settings that may change at run time."""
        self.config = config
        if self.tracker is not None:
            self.tracker.reconfigure(config)
        self._selector.interval = config.mapping.view_interval

    def track(self, frame: RgbdFrame, camera: PinholeCamera) -> TrackResult | None:
        """Track a frame; return None where it is refused, with a warning."""
        start = time.perf_counter()
        tracker = self._tracker_of(camera)
        try:
            result = tracker.track(frame)
        except FrameError as error:
            self.refuse(error)
            return None
        self._warn_of_loss(result)
        self.counts[result.state.value] += 1
        self.ever_tracked |= result.state is not TrackingState.LOST
        self.result, self.ms = result, 1e3 * (time.perf_counter() - start)
        return result

    def refuse(self, error: DcgsError) -> None:
        """Count a frame that cannot be used, and warn."""
        self.result, self.refusal = None, str(error)
        self.counts['refused'] += 1
        self._warn(f'frame refused: {error}')

    def _warn_of_loss(self, result: TrackResult) -> None:
        """Warn where the tracker took a stamp for another clock's, or begins to be lost."""
        last_ns = result.stamp_ns if self._stamp_ns is None else self._stamp_ns
        passed_s = (result.stamp_ns - last_ns) * 1e-9
        lost = self.searching or result.state is TrackingState.RELOCALISED
        if passed_s < 0.0:
            self._warn(f'stamps went back by {-passed_s:.1f} s: {_LOOKING}')
        elif lost and self._held:
            self._warn(f'lost, {passed_s:.1f} s after the last frame: {_LOOKING}')
        self._stamp_ns = result.stamp_ns
        if lost or result.state is not TrackingState.LOST:  # a repeated frame tells nothing
            self._held = not lost

    def _tracker_of(self, camera: PinholeCamera) -> Tracker:
        """Return the tracker; a new one for the first camera, or for another at the last pose."""
        T_world_first, last = self.T_world_first, self.tracker
        if last is not None and last.camera == camera:
            return last
        if last is not None:
            before, now = last.camera, camera
            self._warn(
                f'the camera changed from {before.width}x{before.height}, fx {before.fx:.1f}, to '
                f'{now.width}x{now.height}, fx {now.fx:.1f}: {self._goes_on}'
            )
            T_world_first = last.T_world_cam
            self.reset()
        return self._begin(camera, T_world_first)

    @property
    def _goes_on(self) -> str:
        return _LOOKING if self._localize_only else 'a new map begins at the last pose'

    def _begin(self, camera: PinholeCamera, T_world_first: NDArray[np.float64]) -> Tracker:
        """Return a new tracker, in the map of another one if that is wanted."""
        self.tracker = Tracker(camera, self.config, T_world_first, self._priors)
        if self._resumable is not None:
            self.epoch = self._resumable.epoch
            self._resumable.resume(self.tracker)
            self.tracker.localize_only = self._localize_only
            if self._expected is not None:
                self.tracker.expect(self._expected)
            if isinstance(self._resumable, KnownMap) and self._resumable.camera != camera:
                self._warn(_OTHER_CAMERA)
        self._expected = None
        self._begin_loops(self.tracker)
        self._names.clear()
        self._others = _unique(self.tracker.visited.stamps_ns)
        self._selector = KeyframeSelector(self.config.mapping.view_interval)
        return self.tracker

    def _begin_loops(self, tracker: Tracker) -> None:
        """Begin to look for loops, with the keyframes of the map that is gone on in."""
        resumed, known = self._resumable, None
        if resumed is not None:
            known = resumed.keyframes(tracker)
            self._resumable = resumed.without_images()
        if self._localize_only:
            self._loops.leave()
            return
        places = self._loops.begin(tracker.camera, self.config, self.epoch, known)
        tracker.recogniser = places or tracker.recogniser

    def packets(
        self, frame: RgbdFrame, result: TrackResult, camera_frame: str
    ) -> list[KeyframePacket]:
        """Return the keyframes and views that the mapper should get now, oldest first.

        The mapper knows them by their stamps. Where a recording is played again, stamps that were
        used are moved on by a nanosecond or more.
        """
        assert self.tracker is not None
        if self._localize_only:
            return []
        camera, frame = self.tracker.camera, self.tracker.corrected(frame)
        chosen = self._selector.select(frame, result)
        renamed = [self._with_new_stamp(posed) for posed in chosen]
        referring = [self._with_reference(posed, result) for posed in renamed]
        return [KeyframePacket(self.epoch, camera, posed, camera_frame) for posed in referring]

    def _with_new_stamp(self, posed: PosedFrame) -> PosedFrame:
        stamp_ns = posed.frame.stamp_ns
        while stamp_ns in self._keyframe_stamps:
            stamp_ns += 1
        self._keyframe_stamps.add(stamp_ns)
        posed = replace(posed, frame=replace(posed.frame, stamp_ns=stamp_ns))
        if isinstance(posed, Keyframe) and posed.odometry is not None:
            self._names[posed.odometry.keyframe] = stamp_ns
            self._loops.add(posed)
        return posed

    def _with_reference(self, posed: PosedFrame, result: TrackResult) -> PosedFrame:
        """Return a view with the name under which the mapper has the keyframe that it refers to.

        Keyframes of another tracker have none unless they have moved.
        """
        if posed.reference is None or result.reference is None:
            return posed
        name = self._names.get(result.reference.keyframe)
        reference = None if name is None else replace(posed.reference, stamp_ns=name)
        return replace(posed, reference=reference)

    def correct(self, correction: Correction, epoch: int) -> Corrected | None:
        """Move the tracker's map, between two frames; None where it is not that map any more."""
        tracker = self.tracker
        if tracker is None or epoch != self.epoch:
            return None
        before, camera = list(tracker.visited.poses), tracker.T_world_cam
        tracker.correct(correction)
        applied = tracker.corrected_poses
        motions = applied.T_world_cam @ se3.inverse(np.reshape(before, (-1, 4, 4)))
        here = tracker.T_world_cam @ se3.inverse(camera)
        self._names |= {
            k: stamp_ns
            for k, stamp_ns in self._others.items()
            if np.abs(motions[k] - np.eye(4)).max() > _STILL
        }
        return Corrected(applied, self._named(applied), motions, here)

    def _named(self, applied: Correction) -> Correction:
        """Return the poses of the keyframes that the mapper may have, with their names.

        They are those that were handed over, and those of the tracker before that have moved.
        """
        rows = sorted(self._names)
        names = np.array([self._names[row] for row in rows], np.int64)
        return Correction(
            applied.revision, names, applied.T_world_cam[rows], applied.covariances[rows],
            applied.submaps[rows],
        )  # fmt: skip

    def apply(self, update: MapUpdate, epoch: int) -> None:
        """Apply the mapper's answer, if it is of this map."""
        if self.tracker is not None and epoch == self.epoch:
            self.tracker.apply(update)

    def alive(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which of the Gaussians `ids` (N,) still exist; safe from any thread."""
        tracker = self.tracker
        return np.zeros(len(ids), np.bool_) if tracker is None else tracker.gaussians.alive(ids)

    @property
    def searching(self) -> bool:
        """Return whether the camera is looked for in the map."""
        tracker = self.tracker
        return tracker is not None and tracker.searching

    def figures(self) -> dict[str, Any]:
        """Return the sizes of the map and the figures of the last frame, for diagnostics."""
        tracker, result = self.tracker, self.result
        shown: dict[str, Any] = {}
        if tracker is not None:
            shown |= {
                'gaussians': len(tracker.gaussians),
                'keyframes': tracker.keyframes,
                'revision': tracker.revision,
            }
        return shown if result is None else shown | numbers(result)


def _unique(stamps_ns: Sequence[int]) -> dict[int, int]:
    """Return the stamps that only one keyframe has, by its index: they name it."""
    counts = Counter(stamps_ns)
    return {k: stamp for k, stamp in enumerate(stamps_ns) if counts[stamp] == 1}
