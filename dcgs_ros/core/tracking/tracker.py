# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker: registers each frame against the map, and grows the map at keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config
from ..errors import FrameError
from ..frame import RgbdFrame
from ..kernels import jit
from .cloud import FrameCloud, sample_cloud
from .factors import PointFactors, PosePrior
from .gaussian_map import GaussianMap
from .keyframes import KeyframePolicy, confirmed, spawn, thinned
from .landmarks import Landmarks, detect
from .motion import ColorDepthOffset, ConstantVelocity
from .observability import Observability, observability, pose_covariance
from .registration import DepthTerm, Registration, register, start_from_landmarks
from .relocalization import Relocalizer

_SEEDS = 1 << 31  # the sampling's jitter follows from the stamp
_MAX_LAG_S = 0.1  # between colour and depth of one frame
_SUSPICIOUS = 0.6  # of the last frame's overlap
_LOST_COVARIANCE = np.eye(6)  # 1 m, 1 rad


class TrackingState(Enum):
    """What a pose is worth."""

    OK = 'ok'
    DEGENERATE = 'degenerate'  # tracked, but one direction is badly constrained
    LOST = 'lost'  # the pose is the last good one


@dataclass(frozen=True)
class TrackResult:
    """One tracked frame."""

    stamp_ns: int  # of the colour image
    T_world_cam: NDArray[np.float64]  # (4, 4)
    T_cam_cam_at_depth: NDArray[
        np.float64
    ]  # (4, 4) motion from the depth's instant to the colour's
    covariance: NDArray[np.floating]  # (6, 6) of xi in T_world_cam exp(xi), translation first
    state: TrackingState
    observability: Observability | None  # None: first frame, or lost
    points: int
    inliers: int  # depth pairs
    landmarks: int
    keyframe: bool
    spawned: NDArray[np.int64]  # ids of the Gaussians a keyframe added
    colour_depth_offset_ms: float


@dataclass(frozen=True)
class _Seen:
    """What the next frame needs of this one."""

    grey: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    T_cam_cam_at_depth: NDArray[np.float64]
    T_world_cam: NDArray[np.float64]


class Tracker:
    """Frame-to-map tracking with sensor-derived covariances and KLT landmarks."""

    def __init__(
        self,
        camera: PinholeCamera,
        config: Config | None = None,
        T_world_first: NDArray[np.float64] | None = None,
    ) -> None:
        """Start with an empty map; the first frame is at `T_world_first`, identity by default.

        `config.threads` holds for the thread that makes the tracker, which is to call `track` too.
        """
        self.camera = camera
        self.config = config or Config()
        self.gaussians = GaussianMap(2.0 * self.config.registration.radius_m)
        self.keyframes = 0
        self.opening_motion = np.eye(4)  # T_cam_cam_at_depth of the first keyframe
        self._begun = False
        self._T_world_first = np.eye(4) if T_world_first is None else T_world_first
        self._uses_landmarks = self.config.ablation in ('full', 'shared_klt')
        self._policy = KeyframePolicy(self.config.keyframes)
        self._motion = ConstantVelocity()
        self._motion.start(self._T_world_first, 0, np.zeros(6))
        self._offset = ColorDepthOffset(self.config.timing)
        self._landmarks = Landmarks.none()
        self._seen: _Seen | None = None
        self._opening: RgbdFrame | None = None  # first frame, until the second tells its velocity
        self._search: Relocalizer | None = None  # while it is not known where the camera is
        self._visited: list[NDArray[np.float64]] = []  # poses of the keyframes
        self._stamp_ns: int | None = None  # of the last frame, lost or not
        self._overlap = 0.0  # of the last frame
        self.threads = jit.set_threads(self.config.threads)

    def track(self, frame: RgbdFrame) -> TrackResult:
        """Register a frame, and make it a keyframe where the view has moved on.

        Raises `FrameError` for a frame that is not the camera's size or not newer than the last;
        the tracker is then as it was before.
        """
        self._check(frame)
        self._stamp_ns = frame.stamp_ns
        grey = _grey(frame.color)
        if not self._begun:
            return self._first(frame, grey)
        if self._search is not None:
            return self._look(frame, grey, self._search)
        if self._opening is not None:
            self._reopen(self._opening, frame, grey)
        landmarks = self._landmarks
        result = self._register(frame, grey)
        if not self._trusted(result):
            self._landmarks = landmarks
            return self._lost(frame, result)
        T = result.T_world_cam
        seen = _Seen(grey, frame.depth_m, self._depth_motion(frame, T), T)
        self._learn(frame, result)
        self._overlap = result.overlap
        turn_rad_s = float(np.linalg.norm(self._motion.twist[3:]))
        keyframe = self._policy.wants(
            T, frame.stamp_ns, turn_rad_s, result.overlap, len(self._landmarks)
        )
        spawned = self._keyframe(frame, seen) if keyframe else np.empty(0, np.int64)
        self._seen = seen
        return self._result(frame, seen, result, keyframe, spawned)

    def resume(self, gaussians: GaussianMap, poses: Sequence[NDArray[np.float64]]) -> None:
        """Go on in a map whose keyframes were at `poses` (4, 4), the last one the likeliest.

        Frames are lost until one fits the map near one of them.
        """
        self.gaussians, self.keyframes = gaussians, len(poses)
        self._visited = list(poses)
        self._begun = True
        self._motion.start(poses[-1], 0, np.zeros(6))
        self.interrupt()

    def interrupt(self) -> None:
        """Forget what holds from frame to frame: stamps may start anew, the camera be elsewhere.

        It is looked for where it was last and at the keyframes.
        """
        self._opening, self._seen, self._stamp_ns = None, None, None
        self._landmarks, self._overlap = Landmarks.none(), 0.0
        self._search = (
            Relocalizer(self._motion.T_world_cam, self._visited) if self._begun else None
        )

    def reconfigure(self, config: Config) -> None:
        """Go on with other settings; sensor, ablation, threads and timing stay as they were."""
        kept = {name: getattr(self.config, name) for name in ('sensor', 'ablation', 'threads')}
        self.config = replace(config, timing=self.config.timing, **kept)
        self._policy.config = config.keyframes

    @property
    def T_world_cam(self) -> NDArray[np.float64]:
        """(4, 4) last good pose."""
        return self._motion.T_world_cam

    @property
    def searching(self) -> bool:
        """Tell whether the camera's place in the map is still looked for."""
        return self._search is not None

    @property
    def landmarks(self) -> Landmarks:
        """Landmarks alive, where they are in the last image and in the world."""
        return self._landmarks

    def _check(self, frame: RgbdFrame) -> None:
        height, width = frame.depth_m.shape
        if (width, height) != (self.camera.width, self.camera.height):
            raise FrameError(
                f'image is {width}x{height}, the camera {self.camera.width}x{self.camera.height}'
            )
        lag_s = (frame.depth_stamp_ns - frame.stamp_ns) * 1e-9
        if abs(lag_s) > _MAX_LAG_S:
            raise FrameError(f'depth was taken {lag_s:+.3f} s from colour, limit {_MAX_LAG_S} s')
        if self._stamp_ns is not None and frame.stamp_ns <= self._stamp_ns:
            late = (self._stamp_ns - frame.stamp_ns) * 1e-9
            raise FrameError(f'stamp lies {late:.6f} s before the last frame')

    def _sample(self, frame: RgbdFrame, stride_px: int) -> FrameCloud:
        return sample_cloud(
            frame.depth_m, self.camera.undistortion_map, self.config.cloud, self.config.sensor,
            stride_px, frame.stamp_ns % _SEEDS,
        )  # fmt: skip

    def _first(self, frame: RgbdFrame, grey: NDArray) -> TrackResult:
        """Begin the map, or try again while it holds too little to track against."""
        self._opening, T_world_cam = frame, self._T_world_first
        spawned = self._open(frame, grey, T_world_cam, np.zeros(6))
        begun = self._begun = len(spawned) >= self.config.registration.min_pairs
        return TrackResult(
            frame.stamp_ns, T_world_cam, np.eye(4),
            np.zeros((6, 6)) if begun else _LOST_COVARIANCE,
            TrackingState.OK if begun else TrackingState.LOST, None, len(spawned), 0,
            len(self._landmarks), begun, spawned, 1e3 * self._offset.seconds,
        )  # fmt: skip

    def _open(
        self, frame: RgbdFrame, grey: NDArray, T_world_cam: NDArray, twist: NDArray
    ) -> NDArray[np.int64]:
        """Start the map from one frame, of a camera that moves with `twist`."""
        self.gaussians = GaussianMap(2.0 * self.config.registration.radius_m)
        self._landmarks, self._seen, self.keyframes = Landmarks.none(), None, 0
        self._visited.clear()
        self._motion.start(T_world_cam, frame.stamp_ns, twist)
        self.opening_motion = se3.exp(twist * self._lag_s(frame))
        seen = _Seen(grey, frame.depth_m, self.opening_motion, T_world_cam)
        spawned = self._keyframe(frame, seen)
        self._seen = seen
        return spawned

    def _reopen(self, first: RgbdFrame, second: RgbdFrame, grey: NDArray) -> None:
        """Start the map anew with the velocity that only the second frame tells.

        A first keyframe whose depth is left at its own instant would stay wrong by the way the
        camera went until the colour's. Its Gaussians keep their ids.
        """
        self._opening = None
        if first.stamp_ns == first.depth_stamp_ns and self._offset.seconds == 0.0:
            return
        landmarks = self._landmarks
        result = self._register(second, grey)
        if not self._trusted(result):
            self._landmarks = landmarks
        elif self._seen is not None:
            motion = self._motion.arriving(result.T_world_cam, second.stamp_ns)
            self._open(first, self._seen.grey, self._motion.T_world_cam, motion.twist)

    def _look(self, frame: RgbdFrame, grey: NDArray, search: Relocalizer) -> TrackResult:
        """Try a few of the places where the camera may be; go on from one that explains enough."""
        cloud = self._sample(frame, self.config.cloud.stride_px)
        depth = DepthTerm(cloud, self.gaussians, self.camera.focal, self.config, None)
        result = search.best(depth, self.config)
        T = result.T_world_cam
        agreement = self.gaussians.agreement(T, frame.depth_m, self.camera, self.config.sensor)
        if not (self._trusted(result) and search.found(result, agreement)):
            return self._lost(frame, result)
        seen = _Seen(grey, frame.depth_m, np.eye(4), T)
        found = self._result(frame, seen, result, False, np.empty(0, np.int64))
        if found.state is TrackingState.DEGENERATE:  # it may be anywhere along that direction
            return self._lost(frame, result)
        self._search, self._seen, self._overlap = None, seen, result.overlap
        self._motion.start(T, frame.stamp_ns, np.zeros(6))
        self._anchor(frame, seen)
        return replace(found, landmarks=len(self._landmarks))

    def _register(self, frame: RgbdFrame, grey: NDArray) -> Registration:
        """Predict, follow the landmarks, start from them, and solve for the pose jointly.

        Where that explains far less of the frame than of the last one, the prediction is tried as
        a start too.
        """
        prior = self._motion.prior(frame.stamp_ns)
        cloud = self._sample(frame, self.config.cloud.stride_px)
        self._follow(grey, prior.T_world_cam)
        T_start, image = self._start(frame, prior)
        cloud = cloud.moved(self._depth_motion(frame, T_start))
        guessed = T_start is prior.T_world_cam  # too few landmarks to start from
        Q = None
        if not guessed:
            Q = self._motion.passage_covariance(frame.stamp_ns, self._lag_s(frame))
        depth = DepthTerm(cloud, self.gaussians, self.camera.focal, self.config, Q)
        settings = self.config.registration
        search_m = settings.guess_radius_m if guessed else settings.radius_m
        result = register(T_start, depth, image, self.config, search_m)
        if result.overlap < _SUSPICIOUS * self._overlap and not guessed:
            other = register(prior.T_world_cam, depth, image, self.config, settings.guess_radius_m)
            return max(result, other, key=lambda r: r.overlap)
        return result

    def _follow(self, grey: NDArray, T_predicted: NDArray) -> None:
        """KLT from the last image."""
        if self._seen is not None and self._uses_landmarks:
            self._landmarks = self._landmarks.followed(
                self._seen.grey, grey, self._seen.T_world_cam, T_predicted, self.camera,
                self.config.landmarks,
            )  # fmt: skip

    def _start(self, frame: RgbdFrame, prior: PosePrior) -> tuple[NDArray, PointFactors | None]:
        """Pose to start from, by the landmarks alone where there are enough, and their pairs."""
        T_predicted = prior.T_world_cam
        if not len(self._landmarks):
            return T_predicted, None
        weighted = self.config.ablation == 'shared_klt'
        self._landmarks, image = self._landmarks.measured(
            frame.depth_m, T_predicted, self._depth_motion(frame, T_predicted), self.camera,
            self.config.sensor, self.config.landmarks,
            self.config.shared_klt_weight if weighted else 1.0,
        )  # fmt: skip
        if len(self._landmarks) < self.config.landmarks.min_start:
            return T_predicted, image if len(self._landmarks) else None
        return start_from_landmarks(prior, image), image

    def _depth_motion(self, frame: RgbdFrame, T_world_cam: NDArray) -> NDArray[np.float64]:
        """T_cam_cam_at_depth: where the camera was at the depth's instant, seen from the colour's."""
        motion = self._motion.arriving(T_world_cam, frame.stamp_ns)
        return motion.pose_after(self._lag_s(frame))

    def _lag_s(self, frame: RgbdFrame) -> float:
        """Depth's instant after the colour's, seconds."""
        return (frame.depth_stamp_ns - frame.stamp_ns) * 1e-9 + self._offset.seconds

    def _trusted(self, result: Registration) -> bool:
        """Tell a pose from a guess: enough pairs of one kind, and a finite system."""
        enough = result.inliers >= self.config.registration.min_pairs or (
            result.image is not None and len(self._landmarks) >= self.config.landmarks.min_start
        )
        return enough and bool(np.isfinite(result.equations.H).all())

    def _lost(self, frame: RgbdFrame, result: Registration) -> TrackResult:
        """Report the last good pose; the next frame goes on from the last good one too."""
        return TrackResult(
            frame.stamp_ns, self._motion.T_world_cam, np.eye(4), _LOST_COVARIANCE,
            TrackingState.LOST, None, len(result.depth.points), result.inliers, 0,
            False, np.empty(0, np.int64), 1e3 * self._offset.seconds,
        )  # fmt: skip

    def _learn(self, frame: RgbdFrame, result: Registration) -> None:
        """Update motion and offset; drop the landmarks that contradict the pose."""
        dt_s = (frame.stamp_ns - self._motion.stamp_ns) * 1e-9
        motion = self._motion.arriving(result.T_world_cam, frame.stamp_ns)
        self._motion.advance(result.T_world_cam, frame.stamp_ns)
        if result.image is None:
            return
        image = result.image.across_rays().normal_equations(result.T_world_cam)
        twist = motion.twist_after(self._lag_s(frame))
        self._offset.observe(result.sharp_depth, image, twist, dt_s)
        chi2 = result.image.chi2(result.T_world_cam)
        self._landmarks = self._landmarks[chi2 < self.config.landmarks.drop_chi2]

    def _keyframe(self, frame: RgbdFrame, seen: _Seen) -> NDArray[np.int64]:
        """Refresh Sigma_t of the Gaussians in view, spawn new ones, anchor new landmarks."""
        config, T = self.config, seen.T_world_cam
        self._offset.map_changes()
        self.gaussians.refresh(T, frame.depth_m, self.camera, config.sensor)
        cloud = self._sample(frame, config.keyframes.spawn_stride_px)
        cloud = thinned(cloud, config.keyframes.spawn_min_m)
        if self._seen is not None:
            last = self._seen
            T_last_now = se3.inverse(last.T_world_cam @ last.T_cam_cam_at_depth) @ (
                T @ seen.T_cam_cam_at_depth
            )
            cloud = confirmed(cloud, T_last_now, last.depth_m, self.camera, config.sensor)
        spawned = spawn(
            cloud.moved(seen.T_cam_cam_at_depth), T, self.gaussians, self.keyframes,
            self.camera.focal, config.sensor, config.keyframes, config.registration.radius_m,
        )  # fmt: skip
        self._anchor(frame, seen)
        self.keyframes += 1
        self._visited.append(T)
        return spawned

    def _anchor(self, frame: RgbdFrame, seen: _Seen) -> None:
        """Anchor new landmarks in the map; the next keyframe is due when this view is left."""
        if self._uses_landmarks:
            new = detect(
                seen.grey, frame.depth_m, self._landmarks, seen.T_world_cam, seen.T_cam_cam_at_depth,
                self.gaussians, self.camera, self.config.sensor, self.config.landmarks,
                self.config.registration.anchor_px,
            )  # fmt: skip
            self._landmarks = self._landmarks.joined(new)
        self._policy.took(seen.T_world_cam, frame.stamp_ns, len(self._landmarks))

    def _result(
        self, frame: RgbdFrame, seen: _Seen, result: Registration, keyframe: bool, spawned: NDArray
    ) -> TrackResult:
        spectrum = observability(result.equations.H, result.sharp.H)
        variance = 1.0
        if self.config.ablation in ('shared', 'shared_klt'):  # not metric: scaled by the residual
            variance = result.equations.cost / max(3 * result.inliers - 6, 1)
        degenerate = spectrum.block_ratio > self.config.registration.degenerate_ratio
        return TrackResult(
            frame.stamp_ns, result.T_world_cam, seen.T_cam_cam_at_depth,
            pose_covariance(result.sharp.H, variance),
            TrackingState.DEGENERATE if degenerate else TrackingState.OK, spectrum,
            len(result.depth.points), result.inliers, len(self._landmarks), keyframe, spawned,
            1e3 * self._offset.seconds,
        )  # fmt: skip


def _grey(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return color if color.ndim == 2 else cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
