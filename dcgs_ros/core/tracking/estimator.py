# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""One step of the paper's method (section III): a frame, the map and the memory give a pose.

Nothing is stored on the way: an estimate that is not believed is dropped as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config
from ..frame import RgbdFrame
from ..keyframe import PosedFrame
from ..priors.fusion import Sensed
from .cloud import FrameCloud, sample_cloud
from .factors import PointFactors, PosePrior
from .gaussian_map import GaussianMap
from .landmarks import Landmarks
from .motion import ConstantVelocity, LocalMotion
from .registration import DepthTerm, Registration, register, start_from_landmarks

_SEEDS = 1 << 31  # the sampling's jitter follows from the stamp
_SUSPICIOUS = 0.6  # of the last frame's overlap: below, the landmarks may have misled the pose
_FAR_SIGMAS = 3.0  # of a hand's acceleration: beyond, likewise
_FEWEST = 4  # landmarks: three determine a pose, one more shows a contradiction
_CLEARLY = 1.1  # by which depth alone must fit better


@dataclass(frozen=True)
class RegisteredFrame(PosedFrame):
    """A frame with its pose, its grey image, where KLT goes on from, and its motion."""

    grey: NDArray[np.uint8]  # (H, W)
    twist: NDArray[np.float64]  # (6,) per second, camera frame, at colour's instant
    twist_at_depth: NDArray[np.float64]  # (6,) the same at depth's


@dataclass(frozen=True)
class Memory:
    """What one frame's estimate needs of the frames before; replaced as a whole."""

    motion: ConstantVelocity
    offset_s: float  # depth's true time less its stamp
    last: RegisteredFrame | None = None
    image: RegisteredFrame | None = None  # the last one whose colour was new: KLT goes on from it
    landmarks: Landmarks = field(default_factory=Landmarks.none)  # pixels in that image
    spread: NDArray[np.int64] | None = None  # landmarks in each cell at the last detection
    overlap: float = 0.0  # of the last frame
    sensed: Sensed | None = None  # by other sensors, from the last pose to the frame at hand

    def prior(self, stamp_ns: int) -> PosePrior:
        """Return the pose at the next frame's stamp by all that is known without the frame."""
        hand, motion = self.motion.prior(stamp_ns), self.motion
        if self.sensed is None:
            return hand
        return self.sensed.fused(hand, motion.T_world_cam, motion.twist)

    def arriving(self, T_world_cam: NDArray[np.float64], stamp_ns: int) -> LocalMotion:
        """Return the motion on arrival at a pose (4, 4); the gyro, if any, tells how it turns."""
        motion = self.motion.arriving(T_world_cam, stamp_ns)
        turn = None if self.sensed is None else self.sensed.turn
        if turn is None:
            return motion
        return LocalMotion(
            np.concatenate([motion.twist[:3], turn.end_rate]),
            np.concatenate([motion.acceleration[:3], turn.end_acceleration]),
        )

    def is_gap(self, stamp_ns: int) -> bool:
        """Return whether the motion since the last pose is unknown."""
        spanned = self.sensed is not None and self.sensed.spans
        return self.motion.is_gap(stamp_ns) and not spanned

    def moved(self, motions: NDArray[np.float64], T: NDArray[np.float64]) -> Memory:
        """Return it after keyframes moved by `motions` (K, 4, 4), and the camera by T (4, 4)."""
        last, image = (
            frame and replace(frame, T_world_cam=T @ frame.T_world_cam)
            for frame in (self.last, self.image)
        )
        motion = replace(self.motion, T_world_cam=T @ self.motion.T_world_cam)
        landmarks = self.landmarks.moved(motions, T)
        return replace(self, motion=motion, last=last, image=image, landmarks=landmarks)

    def lag_s(self, frame: RgbdFrame) -> float:
        """Return how long after the colour's the depth's instant is, seconds."""
        return (frame.depth_stamp_ns - frame.stamp_ns) * 1e-9 + self.offset_s

    def depth_motion(
        self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return T_cam_cam_at_depth (4, 4) of a frame whose colour was taken at `T_world_cam`."""
        motion = self.arriving(T_world_cam, frame.stamp_ns)
        return motion.pose_after(self.lag_s(frame))

    def depth_twist(
        self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the camera's twist (6,) per second at the depth's instant of such a frame."""
        motion = self.arriving(T_world_cam, frame.stamp_ns)
        return motion.twist_after(self.lag_s(frame))


@dataclass(frozen=True)
class Estimate:
    """Where a frame was taken, and what that rests on."""

    registered: RegisteredFrame
    registration: Registration
    landmarks: Landmarks  # those followed into the frame
    image: PointFactors | None  # their measurements, though they be too few for the pose
    fresh: bool  # whether its colour image is another than the last one's

    def moved_to(self, T_world_cam: NDArray[np.float64]) -> Estimate:
        """Return it at another pose (4, 4) near by."""
        registered = replace(self.registered, T_world_cam=T_world_cam)
        registration = replace(self.registration, T_world_cam=T_world_cam)
        return replace(self, registered=registered, registration=registration)

    def is_trusted(self, config: Config) -> bool:
        """Return whether it has enough factors of one kind, and a finite system."""
        found = self.registration
        enough = found.inliers >= config.registration.min_pairs or (
            found.image is not None and len(self.landmarks) >= config.landmarks.min_start
        )
        return enough and bool(np.isfinite(found.equations.H).all())

    def sees_depth(self, config: Config) -> bool:
        """Return whether depth has points enough to speak for or against the pose."""
        return len(self.registration.depth.points) >= config.registration.min_pairs

    def consistent_landmarks(self, max_chi2: float) -> Landmarks:
        """Return the landmarks that do not contradict the pose: a moving corner does."""
        if self.image is None:
            return self.landmarks
        return self.landmarks[self.image.chi2(self.registered.T_world_cam) < max_chi2]


def estimate(
    frame: RgbdFrame, memory: Memory, gaussians: GaussianMap, camera: PinholeCamera, config: Config
) -> Estimate:
    """Register a frame against the map; reads its arguments and changes none of them."""
    grey = to_grey(frame.color)
    fresh = memory.image is None or not np.array_equal(grey, memory.image.grey)

    # The motion so far, continued at constant velocity, or as other sensors say.
    prior = memory.prior(frame.stamp_ns)

    # III-D, image residual: landmarks followed by KLT and measured at their depth, a_l and S_l.
    landmarks = _followed(grey, memory, prior, camera, config) if fresh else memory.landmarks
    T = prior.T_world_cam
    measured = _measured(landmarks, frame, memory, T, camera, config) if fresh else None
    image = measured if len(landmarks) >= config.landmarks.min_factors else None

    # The landmarks alone give a start, where there are enough, and the motion within the frame.
    start = _start(frame, memory, prior, image, config)
    if image is not None and config.sensor.color_readout_ms > 0.0:
        T = start.T_world_cam
        measured = image = _measured(landmarks, frame, memory, T, camera, config)

    # III-B, III-C and III-E: the depth residual, and joint Levenberg-Marquardt with the landmarks.
    def registered_from(start: _Start, image: PointFactors | None) -> Registration:
        depth = _depth_term(frame, memory, gaussians, camera, config, start)
        moved = None if config.shares_covariance else prior  # a metric term among others
        return register(start.T_world_cam, depth, image, config, start.search_m, moved)

    found = registered_from(start, image)
    if image is not None and _misled(found, prior, memory):
        alone = registered_from(_start(frame, memory, prior, None, config), None)
        fits = alone.overlap > _CLEARLY * found.overlap  # on a plane depth fits anywhere
        if fits and _jump(alone, prior) < _jump(found, prior):
            found = replace(alone, image=image)

    T = found.T_world_cam
    motion, lag_s = memory.arriving(T, frame.stamp_ns), memory.lag_s(frame)
    registered = RegisteredFrame(
        frame, T, motion.pose_after(lag_s), grey, motion.twist, motion.twist_after(lag_s)
    )
    return Estimate(registered, found, landmarks, measured, fresh)


def _jump(found: Registration, prior: PosePrior) -> float:
    """Return how far a pose is from the predicted one, standard deviations of a hand's motion."""
    xi = se3.log(se3.inverse(prior.T_world_cam) @ found.T_world_cam)
    sigmas = np.linalg.norm(xi[:3]) / prior.sigma_m, np.linalg.norm(xi[3:]) / prior.sigma_rad
    return float(max(sigmas))


def _misled(found: Registration, prior: PosePrior, memory: Memory) -> bool:
    """Return whether landmarks may have pulled the pose away from what depth says."""
    return found.overlap < _SUSPICIOUS * memory.overlap or _jump(found, prior) > _FAR_SIGMAS


def to_grey(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an RGB image (H, W, 3), or one that is grey already, as grey (H, W)."""
    return color if color.ndim == 2 else np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))


def sample(
    frame: RgbdFrame,
    camera: PinholeCamera,
    config: Config,
    stride_px: int,
    twist: NDArray[np.float64],
) -> FrameCloud:
    """Sample the depth image in cells of `stride_px`; the same stamp gives the same pixels.

    `twist` (6,) is the camera's per second, in its frame, at the depth's instant.
    """
    return sample_cloud(
        frame.depth_m, camera.undistortion_map, config.cloud, config.sensor, stride_px,
        frame.stamp_ns % _SEEDS, twist,
    )  # fmt: skip


def _followed(
    grey: NDArray[np.uint8],
    memory: Memory,
    prior: PosePrior,
    camera: PinholeCamera,
    config: Config,
) -> Landmarks:
    """Follow the landmarks from the last image."""
    last = memory.image
    if last is None or not config.uses_landmarks:
        return memory.landmarks
    return memory.landmarks.followed(
        last.grey, grey, last.T_world_cam, prior.T_world_cam, camera, config.landmarks
    )


def _measured(
    landmarks: Landmarks,
    frame: RgbdFrame,
    memory: Memory,
    T_world_cam: NDArray[np.float64],  # (4, 4) roughly
    camera: PinholeCamera,
    config: Config,
) -> PointFactors | None:
    """Return the factors of the landmarks, if there are enough to tell anything."""
    if len(landmarks) < _FEWEST:
        return None
    T, twist = T_world_cam, memory.arriving(T_world_cam, frame.stamp_ns).twist
    weight = config.shared_klt_weight if config.ablation == 'shared_klt' else 1.0
    return landmarks.measured(
        frame.depth_m, T, memory.depth_motion(frame, T), twist, camera, config.sensor,
        config.landmarks, weight,
    )  # fmt: skip


def _depth_term(
    frame: RgbdFrame,
    memory: Memory,
    gaussians: GaussianMap,
    camera: PinholeCamera,
    config: Config,
    start: _Start,
) -> DepthTerm:
    """Sample a_i, n_i and D_i at colour's instant, as the start says that the camera moves."""
    T = start.T_world_cam
    cloud = sample(
        frame, camera, config, config.cloud.stride_px, memory.depth_twist(frame, T)
    ).moved(memory.depth_motion(frame, T))
    return DepthTerm(cloud, gaussians, camera.focal, config, start.Q)


@dataclass(frozen=True)
class _Start:
    """Where the joint registration begins."""

    T_world_cam: NDArray[np.float64]  # (4, 4)
    search_m: float  # how far the first association looks
    Q: NDArray[np.float64] | None  # (6, 6) of the motion between depth's and colour's instants


def _start(
    frame: RgbdFrame,
    memory: Memory,
    prior: PosePrior,
    image: PointFactors | None,
    config: Config,
) -> _Start:
    """Start from enough landmarks, or else from the prediction.

    The motion between the two instants is uncertain, which limits what all the depth says. A mere
    prediction is no better: there the depth has to find the pose by itself, without that limit.
    """
    settings = config.registration
    if image is None or len(image.points) < config.landmarks.min_start:
        return _Start(prior.T_world_cam, settings.guess_radius_m, None)
    Q = memory.motion.passage_covariance(frame.stamp_ns, memory.lag_s(frame))
    return _Start(start_from_landmarks(prior, image), settings.radius_m, Q)
