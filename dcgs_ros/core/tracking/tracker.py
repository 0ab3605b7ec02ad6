# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker: registers each frame against the map, and extends the map at keyframes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config, PriorsConfig
from ..errors import FrameError
from ..frame import RgbdFrame
from ..kernels import jit
from ..keyframe import Correction, Keyframe, MapUpdate, Odometry
from ..priors.fusion import ImagePose
from ..priors.motion_priors import MotionPriors
from ..priors.readings import Reading
from ..self_mask import without_robot
from .claims import Claim, Clocks, PoseClaims
from .estimator import Estimate, Memory, RegisteredFrame, estimate, to_grey
from .expectation import ExpectedPlace
from .gaussian_map import GaussianMap
from .growing_map import GrowingMap
from .hosting import Hosts
from .landmarks import Landmarks
from .motion import ColorDepthOffset, ConstantVelocity
from .observability import observability
from .registration import Registration
from .relocalization import Recogniser
from .result import Reference, TrackingState, TrackResult
from .search import Known, Search
from .standstill import Standstill
from .uncertainty import PoseUncertainty
from .verification import Evidence, Usual, is_repetition, repeats_depth, weigh
from .visited import UNKNOWN, Visited, origin

_MAX_LAG_S = 0.1  # between colour and depth of one frame
_REWOUND_S = 1.0  # a stamp farther back is of another clock, not disorder
_AGREEING_CHI2 = 9.0  # of landmarks that tell colour's offset: corners may move, or be noise
_CONFIRMATIONS = 5  # frames that must agree with the place where a lost camera was found
_LOST_COVARIANCE = np.eye(6)  # 1 m, 1 rad
# How far other sensors carry a pose: while turn and way are known, or on wheels for a time.
_CARRIED_RAD, _CARRIED_M, _CARRIED_NS = 0.1, 0.5, 3_000_000_000


class Tracker:
    """Frame-to-map tracking with sensor-derived covariances and KLT landmarks."""

    def __init__(
        self,
        camera: PinholeCamera,
        config: Config | None = None,
        T_world_first: NDArray[np.float64] | None = None,
        priors: MotionPriors | None = None,
    ) -> None:
        """Start with an empty map; the first frame is at `T_world_first`, identity by default.

        `priors` are what the robot's other sensors tell, and where those are; there are none by
        default, whatever `config` has of them.
        `config.threads` holds for the thread that makes the tracker, which is to call `track` too.
        """
        self.camera = camera
        self.config = config or Config()
        self._config = self.config.scaled_to(camera.width, camera.height)
        self._map = GrowingMap(camera, self._config)
        self._T_world_first = np.eye(4) if T_world_first is None else T_world_first
        self._begun = False
        self._first: RgbdFrame | None = None  # until the second frame tells its velocity
        self._stamp_ns: int | None = None  # of the last frame, lost or not
        self._received: RgbdFrame | None = None  # the last frame, lost or not
        self._depth_came_again = False  # with it
        self._offset = ColorDepthOffset(self._config.timing)
        self._memory = self._forgotten(ConstantVelocity.at_rest(self._T_world_first))
        self._T_uncorrected_world = np.eye(4)
        self._claims = PoseClaims(camera, self._config)
        self._standstill: Standstill | None = None  # while images repeat, and may
        self._held: list[Keyframe] = []  # made, but not handed over with a result yet
        self._search: Search | None = None  # while the camera's place is not known
        self._trial: Tracker | None = None  # in what may become a sub-map
        self._agreed = 0  # frames that were tracked well in it
        self.revision = 0  # of the last correction
        self.recogniser: Recogniser | None = None  # of places by appearance; may be set
        self.localize_only = False  # whether the map stays as it is, after `resume`; may be set
        self._unconfirmed = 0  # frames that must still agree with the place where it was found
        self._usual = Usual()
        self.priors = priors or MotionPriors(PriorsConfig())
        self._seen_ns = 0  # stamp of the last frame that was tracked
        self.threads = jit.set_threads(self._config.threads)

    def sense(self, reading: Reading) -> None:
        """Take what another sensor measured, before the frames that were taken later."""
        self.priors.sense(reading)

    def track(self, frame: RgbdFrame) -> TrackResult:
        """Register a frame, and make it a keyframe where the view has moved on.

        Raises `FrameError` for a frame that is not the camera's size or not newer than the last;
        the tracker is then as it was before.
        """
        self._check(frame)
        self._stamp_ns = frame.stamp_ns
        repeated = self._received is not None and is_repetition(frame, self._received)
        self._received = self._with_depths_instant(frame)
        frame = self.corrected(self._received)
        if not self._begun:
            return self._begin(frame)
        sensed = self.priors.since(self._memory.motion, frame.stamp_ns)
        self._memory = replace(self._memory, sensed=sensed)
        if repeated:
            return self._repeated(frame)
        self._standstill = None
        if self._search is None and self._memory.motion.is_gap(frame.stamp_ns):
            self._lose()
        if self._search is not None:
            return self._sought(frame, self._search)
        if self._first is not None:
            self._place_first(self._first, frame)
        found = estimate(frame, self._memory, self.gaussians, self.camera, self._config)
        guesses = [found.registered.T_world_cam]
        if not found.is_trusted(self._config):
            return self._sought(frame, self._lose(), guesses)
        uncertainty = self._claims.uncertainty(found.registration)
        measured = self._claims.measured(uncertainty, self._clocks)
        evidence = weigh(
            found, self._memory, self._usual, self._claims.in_doubt(measured),
            self.gaussians, self.camera, self._config,
        )  # fmt: skip
        if evidence.contradicts:
            return self._sought(frame, self._lose(), guesses)
        images, last = self._by_images(found, measured), self._memory.last
        if self._memory.sensed is not None:
            found = found.moved_to(
                self.priors.with_images(self._memory.sensed, images, self.T_world_cam)
            )
        self._accept(found, evidence)
        claim = self._claim(found, uncertainty)
        sure = not self._unconfirmed and not evidence.doubtful
        keyframe = (
            sure and not self.localize_only and self._map.wants_keyframe(found, self._memory)
        )
        if keyframe:
            self._held.append(self._extend_map(found.registered, last, claim))
        elif found.fresh and self._map.lacks_landmarks(self._memory):
            self._memory = self._map.with_landmarks(self._memory, found.registered)
        result = self._result(found, uncertainty, claim, keyframe)
        if sure and result.state is TrackingState.OK:
            self.priors.learn(frame.stamp_ns, images, result.T_world_cam)
        else:
            self.priors.forget()
        return result

    def _repeated(self, frame: RgbdFrame) -> TrackResult:
        """Keep the pose of a camera that may stand still; other repeated images are a fault."""
        limit = self._claims.limit
        if limit is None or self.searching:
            return self._lost(frame)
        motion, stamp_ns = self._memory.motion, frame.stamp_ns
        self._standstill = self._standstill or Standstill.begun(
            motion, limit, self._usual, stamp_ns
        )
        if self._standstill is None:
            return self._lost(frame)
        self._first = None  # at rest its depth is of colour's instant too
        limit = self._claims.limit = self._standstill.limit(limit, stamp_ns)
        T, covariance = self.T_world_cam, limit.covariance
        self._memory = replace(self._memory, motion=motion.advanced(T, stamp_ns))
        state = TrackingState.DEGENERATE if self._claims.exceeds(covariance) else TrackingState.OK
        in_world = self._map.in_world(T, covariance)
        return TrackResult(
            stamp_ns, T, np.eye(4), covariance, in_world,
            TrackingState.RELOCALISED if self._unconfirmed else state, None, 0, 0,
            len(self.landmarks), False, self.flush(), 1e3 * self._offset.seconds,
            self._reference(T), limit.motion_covariance,
        )  # fmt: skip

    def corrected(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame with its depth as the tracker believes it, without the robot itself."""
        return self._map.depth_bias.corrected(without_robot(frame, self.config.self_mask))

    def flush(self) -> tuple[Keyframe, ...]:
        """Hand over what no result has yet: the first keyframe, where no second frame came."""
        held, self._held = tuple(self._held), []
        return held

    def resume(
        self,
        gaussians: GaussianMap,
        poses: Sequence[NDArray[np.float64]],
        stamps_ns: Sequence[int],
        submaps: Sequence[int] = (),
        odometries: Sequence[Odometry | None] = (),
        usual: Usual | None = None,
        depth_bias: NDArray[np.float64] | None = None,
    ) -> None:
        """Go on in a map whose keyframes were at `poses` (4, 4), the last one the likeliest.

        Frames are lost until one fits the map near one of them. See `Visited.reset`; `usual` and
        `depth_bias` are those of the tracker that made the map.
        """
        self._usual = usual or self._usual
        if depth_bias is not None and depth_bias.any():
            self._map.depth_bias.correct_by(depth_bias)
        self._begun = True
        self._map.resume(gaussians, poses, stamps_ns, submaps, odometries)
        self._memory = self._forgotten(ConstantVelocity.at_rest(poses[-1]))
        self.interrupt()

    def apply(self, update: MapUpdate) -> None:
        """Take over what the mapper made of the Gaussians: their shape, and which were removed.

        Means stay as they were measured. The mapper's are within a fraction of sigma_z of them,
        and made the tracker slightly worse. Normals from before the last correction are of a world
        that is no more, and are ignored: newer ones follow.
        """
        self.gaussians.remove(update.removed)
        if update.revision >= self.revision:
            self.gaussians.reshape(update.ids, update.normals, update.flatness)

    def correct(self, correction: Correction) -> None:
        """Move the map, and all that is placed in it, to better poses of its keyframes.

        To be called between two frames.
        """
        motions = self._map.correct(correction)
        self.revision = correction.revision
        here = motions[self._map.host]
        self.priors.forget()
        self._T_uncorrected_world = self._T_uncorrected_world @ se3.inverse(here)
        self._held = [keyframe.moved(here) for keyframe in self._held]
        self._memory = self._memory.moved(motions, here)
        self._claims.move(here)
        if self._search is not None:
            self._search.move(self.T_world_cam, self.recogniser)

    def interrupt(self) -> None:
        """Forget what holds from frame to frame: stamps may start anew, the camera be elsewhere.

        It is looked for where it was last and at the keyframes.
        """
        self._first = self._stamp_ns = None
        if self._begun:
            self._memory = self._forgotten(ConstantVelocity.at_rest(self.T_world_cam))
            self._lose()

    def expect(self, place: ExpectedPlace) -> bool:
        """Look for the camera where somebody says that it is, before anywhere else.

        It is taken to be there only if it could be found there without. Return whether it is
        looked for: not where it is tracked within the place already, nor before there is a map.
        """
        tracked_there = self._search is None and place.admits(self.T_world_cam)
        if not self._begun or tracked_there:
            return False
        self.interrupt()
        self._lose(place)
        return True

    def reconfigure(self, config: Config) -> None:
        """Go on with other settings; sensor, ablation, threads and timing stay as they were."""
        kept = {
            name: getattr(self.config, name)
            for name in ('sensor', 'ablation', 'threads', 'timing')
        }
        self.config = replace(config, **kept)
        self._config = self._claims.config = self.config.scaled_to(
            self.camera.width, self.camera.height
        )
        self._map.reconfigure(self._config)

    @property
    def T_world_cam(self) -> NDArray[np.float64]:
        """(4, 4) last good pose."""
        return self._memory.motion.T_world_cam

    @property
    def gaussians(self) -> GaussianMap:
        """The Gaussians that frames are registered against."""
        return self._map.gaussians

    @property
    def usual(self) -> Usual:
        """How well frames fit the map that were tracked well."""
        return self._usual

    @property
    def depth_bias(self) -> NDArray[np.float64]:
        """(5,) theta of `DepthBias`, that depth is corrected by."""
        return self._map.depth_bias.theta

    @property
    def visited(self) -> Visited:
        """The keyframes; not to be changed."""
        return self._map.visited

    @property
    def corrected_poses(self) -> Correction:
        """The last correction as it was applied: of all keyframes, later ones too.

        It is what the mapper should get, so that both have one world.
        """
        return self.visited.as_correction(self.revision)

    @property
    def keyframes(self) -> int:
        """How many keyframes the map has."""
        return len(self.visited)

    @property
    def keyframe_poses(self) -> NDArray[np.float64]:
        """(K, 4, 4) T_world_cam of the keyframes, as corrected so far."""
        return np.array(self.visited.poses).reshape(-1, 4, 4)

    @property
    def keyframe_submaps(self) -> NDArray[np.int32]:
        """(K,) in which sub-map each keyframe is; those that were joined have one number."""
        return np.array(self.visited.submaps, np.int32)

    @property
    def searching(self) -> bool:
        """Whether the camera's place in the map is still looked for."""
        return self._search is not None

    @property
    def landmarks(self) -> Landmarks:
        """Landmarks alive, where they are in the last image and in the world."""
        return self._memory.landmarks

    def _lose(self, expected: ExpectedPlace | None = None) -> Search:
        """Forget what holds from frame to frame, and begin to look for the camera in the map."""
        self._first = self._trial = None
        self._agreed = 0
        self._memory = replace(self._forgotten(self._memory.motion), sensed=self._memory.sensed)
        self.priors.forget()
        self._search = Search(
            self.camera, self._memory.motion, self.visited, self._usual, self.recogniser,
            expected,
        )  # fmt: skip
        return self._search

    def _with_depths_instant(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame with the stamp of the last one's depth, where the image is that one.

        Taken for new it would say that a camera that goes on stands still. Where the image comes a
        third time, the camera does stand still, before a sensor without noise.
        """
        last, again = self._received, self._depth_came_again
        self._depth_came_again = last is not None and repeats_depth(frame, last)
        if last is None or again or not self._depth_came_again:
            return frame
        if frame.stamp_ns - last.depth_stamp_ns > _MAX_LAG_S * 1e9:
            return frame
        return replace(frame, depth_stamp_ns=last.depth_stamp_ns)

    def _check(self, frame: RgbdFrame) -> None:
        height, width = frame.depth_m.shape
        if (width, height) != (self.camera.width, self.camera.height):
            raise FrameError(
                f'image is {width}x{height}, the camera {self.camera.width}x{self.camera.height}'
            )
        lag_s = (frame.depth_stamp_ns - frame.stamp_ns) * 1e-9
        if abs(lag_s) > _MAX_LAG_S:
            raise FrameError(f'depth was taken {lag_s:+.3f} s from colour, limit {_MAX_LAG_S} s')
        if self._stamp_ns is None or frame.stamp_ns > self._stamp_ns:
            return
        late_s = (self._stamp_ns - frame.stamp_ns) * 1e-9
        if late_s <= _REWOUND_S:
            raise FrameError(f'stamp lies {late_s:.6f} s before the last frame')
        self.interrupt()

    def _forgotten(self, motion: ConstantVelocity) -> Memory:
        """Return a memory that knows of no frame but the last pose."""
        return Memory(motion, self._offset.seconds)

    def _begin(self, frame: RgbdFrame) -> TrackResult:
        """Begin the map, or try again while it holds too little to track against."""
        self._first = frame
        first = self._start_map(frame, to_grey(frame.color), self._T_world_first, np.zeros(6))
        begun = self._begun = len(first.ids) >= self._config.registration.min_pairs
        if begun:
            self._held = [first]
        covariance = np.zeros((6, 6)) if begun else _LOST_COVARIANCE
        return TrackResult(
            frame.stamp_ns, self._T_world_first, np.eye(4),
            covariance, covariance, TrackingState.OK if begun else TrackingState.LOST, None,
            len(first.ids), 0, len(self.landmarks), begun, (), 1e3 * self._offset.seconds,
            self._reference(self._T_world_first),
        )  # fmt: skip

    def _start_map(
        self,
        frame: RgbdFrame,
        grey: NDArray[np.uint8],
        T_world_cam: NDArray[np.float64],
        twist: NDArray[np.float64],
    ) -> Keyframe:
        """Start the map from one frame, of a camera that moves with `twist`."""
        self._map.begin()
        return self._start_submap(frame, grey, T_world_cam, twist, Claim.certain())

    def _start_submap(
        self,
        frame: RgbdFrame,
        grey: NDArray[np.uint8],
        T_world_cam: NDArray[np.float64],
        twist: NDArray[np.float64],
        claim: Claim,
    ) -> Keyframe:
        self._claims.begin(T_world_cam, frame.stamp_ns)
        self.priors.begin(T_world_cam)
        self._memory = self._forgotten(ConstantVelocity(T_world_cam, frame.stamp_ns, twist))
        motion = se3.exp(twist * self._memory.lag_s(frame))
        registered = RegisteredFrame(frame, T_world_cam, motion, grey, twist, twist)
        self._memory = replace(self._memory, last=registered, image=registered)
        return self._extend_map(registered, None, claim)

    def _place_first(self, first: RgbdFrame, second: RgbdFrame) -> None:
        """Start the map anew with the velocity that only the second frame tells.

        A first keyframe whose depth is left at its own instant would stay wrong by the way the
        camera went until the colour's. Its Gaussians keep their ids.
        """
        self._first = None
        sensor, memory = self._config.sensor, self._memory
        at_once = sensor.depth_readout_ms == sensor.color_readout_ms == 0.0
        if first.stamp_ns == first.depth_stamp_ns and self._offset.seconds == 0.0 and at_once:
            return
        # The landmarks are where the first frame's rows saw them: so should the second's be.
        config = replace(self._config, sensor=replace(sensor, color_readout_ms=0.0))
        found = estimate(second, memory, self.gaussians, self.camera, config)
        if memory.last is not None and found.is_trusted(config):
            motion = memory.motion.arriving(found.registered.T_world_cam, second.stamp_ns)
            grey = memory.last.grey
            self._held = [self._start_map(first, grey, self.T_world_cam, motion.twist)]

    def _sought(
        self, frame: RgbdFrame, search: Search, guesses: Sequence[NDArray[np.float64]] = ()
    ) -> TrackResult:
        """Look for the camera in the map; after a while in unknown surroundings begin a sub-map.

        It is not joined to the others: where they are from each other is not known.
        """
        config = self._config
        known = Known(
            self._memory, self.gaussians, self._claims, self._clocks, self.recogniser, config
        )
        sought = search.find(frame, known, guesses)
        found = sought.estimate
        if sought.uncertainty is not None:
            return self._found_again(found, sought.uncertainty)
        limit_s = None if self.localize_only else config.keyframes.new_submap_s
        enough = len(found.registration.depth.points) >= 2 * config.registration.min_pairs
        if limit_s is None or search.seconds < limit_s or not enough:
            return self._lost(frame, found.registration)
        twist = self._tried(frame)
        if twist is None:
            return self._lost(frame, found.registration)
        return self._begin_submap(frame, twist)

    def _tried(self, frame: RgbdFrame) -> NDArray[np.float64] | None:
        """Track the frame in a map of the last few alone; return its twist (6,) if all hold there.

        A sub-map of one frame might be of a covered lens, or of depth that is none.
        """
        trial = self._trial = self._trial or Tracker(self.camera, self.config)
        self._agreed += 1
        if trial.track(frame).state is not TrackingState.OK:
            self._trial, self._agreed = None, 0
        return trial._memory.motion.twist if self._agreed > _CONFIRMATIONS else None

    def _begin_submap(self, frame: RgbdFrame, twist: NDArray[np.float64]) -> TrackResult:
        """Begin a sub-map where the camera was last, for want of a better place."""
        submap = max(self.visited.submaps) + 1
        T = self.T_world_cam.copy()
        T[:3, 3] += origin(submap) - origin(self._map.submap)
        self._search, self._trial, self._usual = None, None, Usual()
        self._unconfirmed = 0
        claim = Claim(np.zeros((6, 6)), UNKNOWN, Hosts.none(), submap)
        keyframe = self._start_submap(frame, to_grey(frame.color), T, twist, claim)
        self._held.append(keyframe)
        return TrackResult(
            frame.stamp_ns, T, np.eye(4), claim.covariance, claim.in_world, TrackingState.OK, None,
            len(keyframe.ids), 0, len(self.landmarks), True, self.flush(),
            1e3 * self._offset.seconds, self._reference(T),
        )  # fmt: skip

    def _found_again(self, found: Estimate, uncertainty: PoseUncertainty) -> TrackResult:
        """Go on from where the camera was found, which the next frames have to confirm."""
        registered, best = found.registered, found.registration
        T, stamp_ns = registered.T_world_cam, registered.frame.stamp_ns
        self._search, self._trial, self._unconfirmed = None, None, _CONFIRMATIONS
        self._map.host = int(np.bincount(best.hosts).argmax())
        self._memory = replace(
            self._forgotten(ConstantVelocity.at_rest(T, stamp_ns)),
            last=registered, image=registered, overlap=best.overlap,
        )  # fmt: skip
        self._claims.forget()
        self._memory = self._map.with_landmarks(self._memory, registered)
        self._map.goes_on_at(registered, len(self.landmarks))
        return self._result(found, uncertainty, self._claim(found, uncertainty), False)

    def _lost(self, frame: RgbdFrame, found: Registration | None = None) -> TrackResult:
        """Report the last good pose, or where other sensors carry it; the next goes on from it."""
        points, inliers = (0, 0) if found is None else (len(found.depth.points), found.inliers)
        state, covariance, in_world = TrackingState.LOST, _LOST_COVARIANCE, _LOST_COVARIANCE
        carried = self._carries(frame.stamp_ns)
        if carried and self._claims.limit is not None:
            state, covariance = TrackingState.DEGENERATE, self._claims.limit.covariance
            in_world = self._map.in_world(self.T_world_cam, covariance)
        return TrackResult(
            frame.stamp_ns, self.T_world_cam, np.eye(4), covariance, in_world, state, None,
            points, inliers, 0, False, self.flush(), 1e3 * self._offset.seconds,
            self._reference(self.T_world_cam), carried=carried,
        )  # fmt: skip

    def _by_images(self, found: Estimate, measured: NDArray[np.float64]) -> ImagePose:
        """Return a pose as other sensors may believe it."""
        limits = self._config.registration
        return ImagePose(
            found.registered.T_world_cam, measured, (limits.degenerate_m, limits.degenerate_rad)
        )

    def _carries(self, stamp_ns: int) -> bool:
        """Move the last pose on by what other sensors tell, as long as that is worth something."""
        sensed, claims, motion = self._memory.sensed, self._claims, self._memory.motion
        if sensed is None or not sensed.spans or claims.limit is None:
            return False
        T = self._memory.prior(stamp_ns).T_world_cam
        covariance = claims.carry(T, stamp_ns, sensed.factors)
        self._memory = replace(self._memory, motion=motion.advanced(T, stamp_ns))
        way_m, turn_rad = (
            math.sqrt(np.linalg.eigvalsh(block)[-1])
            for block in (covariance[:3, :3], covariance[3:, 3:])
        )
        soon = self.priors.on_wheels and stamp_ns - self._seen_ns < _CARRIED_NS
        return turn_rad < _CARRIED_RAD and (soon or way_m < _CARRIED_M)

    def _accept(self, found: Estimate, evidence: Evidence) -> None:
        """Learn from an estimate: the motion, colour's offset to depth, which landmarks hold."""
        if not evidence.doubtful:
            if not self._unconfirmed:
                self._map.depth_bias.observe(found.registration)
            self._unconfirmed = max(self._unconfirmed - evidence.confirms, 0)
            self._map.observe(found.registered, keep=self.localize_only or bool(self._unconfirmed))
            if found.sees_depth(self._config):
                self._usual = self._usual.with_frame(found.registration)
        memory, registered, result = self._memory, found.registered, found.registration
        T, stamp_ns = registered.T_world_cam, registered.frame.stamp_ns
        if found.image is not None:  # depth and image, each alone, tell the offset between them
            agreeing = found.image[found.image_chi2 < _AGREEING_CHI2]
            image = agreeing.across_rays().normal_equations(T)
            dt_s = (stamp_ns - memory.motion.stamp_ns) * 1e-9
            self._offset.observe(result.sharp_depth, image, registered.twist_at_depth, dt_s)
        self._memory = Memory(
            memory.motion.advanced(T, stamp_ns), self._offset.seconds, registered,
            registered if found.fresh else memory.image,
            found.consistent_landmarks(self._config.landmarks.drop_chi2), memory.spread,
            result.overlap if found.sees_depth(self._config) else memory.overlap,
            memory.sensed,
        )  # fmt: skip

    def _extend_map(
        self, registered: RegisteredFrame, last: RegisteredFrame | None, claim: Claim
    ) -> Keyframe:
        self._offset.map_changes()
        keyframe, self._memory, agreement = self._map.extend(registered, last, claim, self._memory)
        if last is not None:  # else there was no map yet to agree with
            self._usual = self._usual.with_keyframe(agreement)
        return keyframe

    def _result(
        self,
        found: Estimate,
        uncertainty: PoseUncertainty,
        claim: Claim,
        keyframe: bool,
    ) -> TrackResult:
        registered, result = found.registered, found.registration
        self._seen_ns = registered.frame.stamp_ns
        spectrum = observability(result.equations.H, uncertainty.information)
        state = TrackingState.OK
        if self._unconfirmed:
            state = TrackingState.RELOCALISED
        elif self._claims.stays_degenerate(spectrum):
            state = TrackingState.DEGENERATE
        return TrackResult(
            registered.frame.stamp_ns, registered.T_world_cam, registered.T_cam_cam_at_depth,
            claim.covariance, claim.in_world, state, spectrum, len(result.depth.points),
            result.inliers, len(self.landmarks), keyframe, self.flush(),
            1e3 * self._offset.seconds, self._reference(registered.T_world_cam),
            self._claims.of_motion(self._clocks),
        )  # fmt: skip

    def _reference(self, T_world_cam: NDArray[np.float64]) -> Reference | None:
        visited, host = self.visited, self._map.host
        if not visited.poses:
            return None
        return Reference(
            host, self._map.relative_to_host(T_world_cam), self._map.submap,
            visited.stamps_ns[host], self.revision, self._T_uncorrected_world,
        )  # fmt: skip

    def _claim(self, found: Estimate, uncertainty: PoseUncertainty) -> Claim:
        """Return how sure the pose is, in the map around the camera and in the world."""
        T, stamp_ns = found.registered.T_world_cam, found.registered.frame.stamp_ns
        sensed = () if self._memory.sensed is None else self._memory.sensed.factors
        covariance = self._claims.advance(T, stamp_ns, uncertainty, self._clocks, sensed)
        return self._map.claim(found, uncertainty, covariance)

    @property
    def _clocks(self) -> Clocks:
        return Clocks(self._offset.sigma_s, self._memory.motion.twist)
