# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""One step of the paper's method (section III): a frame, the map and the memory give a pose.

Nothing is stored on the way: an estimate that is not believed is dropped as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..config.stages import Config
from ..frame import RgbdFrame
from ..keyframe import PosedFrame
from ..priors.fusion import Sensed
from ..self_mask import covered, seen_beside
from .cloud import FrameCloud, sample_cloud
from .consensus import Corners, standing
from .factors import PointFactors, PosePrior
from .gaussian_map import GaussianMap
from .landmarks import Landmarks
from .motion import ConstantVelocity, LocalMotion
from .registration import DepthTerm, Registration, register, start_from_landmarks

_SEEDS = 1 << 31  # the sampling's jitter follows from the stamp
_SUSPICIOUS = 0.6  # of the last frame's overlap: below, the landmarks may have misled the pose
_FAR_SIGMAS = 3.0  # of a hand's acceleration: beyond, likewise
_ALONE = 20  # landmarks that are believed without depth
_FEWEST = 4  # landmarks: three determine a pose, one more shows a contradiction
_CLEARLY = 1.1  # by which depth alone must fit better


@dataclass(frozen=True)
class RegisteredFrame(PosedFrame):
    """A frame with its pose, its grey image, where KLT goes on from, and its motion."""

    grey: NDArray[np.uint8]  # (H, W)
    twist: NDArray[np.float64]  # (6,) per second, camera frame, at colour's instant
    twist_at_depth: NDArray[np.float64]  # (6,) the same at depth's
    corners: Corners = field(default_factory=Corners.none)


@dataclass(frozen=True)
class Arrival:
    """A pose at which a frame may have been taken, and the motion there."""

    T_world_cam: NDArray[np.float64]  # (4, 4)
    T_cam_cam_at_depth: NDArray[np.float64]  # (4, 4) camera at the depth's instant to colour's
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

    def arrival(self, frame: RgbdFrame, T_world_cam: NDArray[np.float64]) -> Arrival:
        """Return the motion within a frame whose colour was taken at `T_world_cam` (4, 4)."""
        motion, lag_s = self.arriving(T_world_cam, frame.stamp_ns), self.lag_s(frame)
        return Arrival(
            T_world_cam, motion.pose_after(lag_s), motion.twist, motion.twist_after(lag_s)
        )


@dataclass(frozen=True)
class Estimate:
    """Where a frame was taken, and what that rests on."""

    registered: RegisteredFrame
    registration: Registration
    landmarks: Landmarks  # those followed into the frame
    image: PointFactors | None  # their measurements, though they be too few for the pose
    fresh: bool  # whether its colour image is another than the last one's
    prior: PosePrior  # where it was expected, by a hand's motion

    def moved_to(self, T_world_cam: NDArray[np.float64]) -> Estimate:
        """Return it at another pose (4, 4) near by."""
        registered = replace(self.registered, T_world_cam=T_world_cam)
        registration = replace(self.registration, T_world_cam=T_world_cam)
        return replace(self, registered=registered, registration=registration)

    def is_trusted(self, config: Config) -> bool:
        """Return whether it has enough factors of one kind, and a finite system."""
        found = self.registration
        enough = found.inliers >= config.registration.min_pairs or (
            found.image is not None and len(self.landmarks) >= _ALONE
        )
        return enough and bool(np.isfinite(found.equations.H).all())

    def sees_depth(self, config: Config) -> bool:
        """Return whether depth has points enough to speak for or against the pose."""
        return len(self.registration.depth.points) >= config.registration.min_pairs

    @cached_property
    def image_chi2(self) -> NDArray[np.float64]:
        """(L,) squared Mahalanobis distances of the measured landmarks, at the pose."""
        if self.image is None:
            return np.empty(0)
        return self.image.chi2(self.registered.T_world_cam)

    def consistent_landmarks(self, max_chi2: float) -> Landmarks:
        """Return the landmarks that do not contradict the pose: a moving corner does."""
        if self.image is None:
            return self.landmarks
        return self.landmarks[self.image_chi2 < max_chi2]


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
    expected = memory.arrival(frame, prior.T_world_cam)
    measured = _measured(landmarks, frame, expected, camera, config) if fresh else None
    image = measured if len(landmarks) >= config.landmarks.min_factors else None

    # The landmarks alone give a start, where there are enough, and the motion within the frame.
    known = not fresh and len(landmarks) >= config.landmarks.min_factors
    start = _start(frame, memory, expected, prior, image, config, known)
    # What moves by itself is left out, of landmarks and of depth.
    seen = Corners.none()
    if image is not None:
        T, stands = standing(start.arrival.T_world_cam, prior, image)
        all_stand = bool(stands.all())
        if not all_stand:
            start = replace(start, arrival=memory.arrival(frame, T))
        if config.sensor.color_readout_ms > 0.0:
            measured = _measured(landmarks, frame, start.arrival, camera, config)
            image = measured or image
        seen = Corners(image.points, ~stands)
        image = image if all_stand else image[stands]

    # III-B, III-C and III-E: the depth residual, and joint Levenberg-Marquardt with the landmarks.
    def registered_from(start: _Start, image: PointFactors | None) -> Registration:
        depth = _depth_term(frame, gaussians, camera, config, start, seen)
        moved = None if config.shares_covariance else prior  # a metric term among others
        T = start.arrival.T_world_cam
        return register(T, depth, image, config, start.search_m, moved)

    found = registered_from(start, image)
    if image is not None and _misled(found, prior, memory):
        alone = registered_from(_start(frame, memory, expected, prior, None, config), None)
        fits = alone.overlap > _CLEARLY * found.overlap  # on a plane depth fits anywhere
        jumps = [prior.sigmas_to(one.T_world_cam) for one in (alone, found)]
        if fits and jumps[0] < jumps[1]:
            found = alone.beside(image)

    there = memory.arrival(frame, found.T_world_cam)
    registered = RegisteredFrame(
        frame, there.T_world_cam, there.T_cam_cam_at_depth, grey, there.twist,
        there.twist_at_depth, seen,
    )  # fmt: skip
    # Images are verified against a hand's motion alone: a sensor that errs must not lose them.
    hand = prior if memory.sensed is None else memory.motion.prior(frame.stamp_ns)
    return Estimate(registered, found, landmarks, measured, fresh, hand)


def _misled(found: Registration, prior: PosePrior, memory: Memory) -> bool:
    """Return whether landmarks may have pulled the pose away from what depth says."""
    if found.overlap < _SUSPICIOUS * memory.overlap:
        return True
    return prior.sigmas_to(found.T_world_cam) > _FAR_SIGMAS


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
    followed = memory.landmarks.followed(
        last.grey, grey, last.T_world_cam, prior.T_world_cam, camera, config.landmarks
    )
    mask = covered(config.self_mask, camera.width, camera.height)
    return followed if mask is None else followed[seen_beside(followed.pixels, mask)]


def _measured(
    landmarks: Landmarks,
    frame: RgbdFrame,
    roughly: Arrival,
    camera: PinholeCamera,
    config: Config,
) -> PointFactors | None:
    """Return the factors of the landmarks, if there are enough to tell anything."""
    if len(landmarks) < _FEWEST:
        return None
    weight = config.shared_klt_weight if config.ablation == 'shared_klt' else 1.0
    return landmarks.measured(
        frame.depth_m, roughly.T_world_cam, roughly.T_cam_cam_at_depth, roughly.twist, camera,
        config.sensor, config.landmarks, weight,
    )  # fmt: skip


def _depth_term(
    frame: RgbdFrame,
    gaussians: GaussianMap,
    camera: PinholeCamera,
    config: Config,
    start: _Start,
    corners: Corners,
) -> DepthTerm:
    """Sample a_i, n_i and D_i at colour's instant, as the start says that the camera moves."""
    there = start.arrival
    cloud = sample(frame, camera, config, config.cloud.stride_px, there.twist_at_depth).moved(
        there.T_cam_cam_at_depth
    )
    return DepthTerm(corners.standing(cloud), gaussians, camera.focal, config, start.Q)


@dataclass(frozen=True)
class _Start:
    """Where the joint registration begins."""

    arrival: Arrival
    search_m: float  # how far the first association looks
    Q: NDArray[np.float64] | None  # (6, 6) of the motion between depth's and colour's instants


def _start(
    frame: RgbdFrame,
    memory: Memory,
    expected: Arrival,
    prior: PosePrior,
    image: PointFactors | None,
    config: Config,
    known: bool = False,
) -> _Start:
    """Start from the landmarks, or else from the prediction.

    Along a surface the nearest Gaussians hold the points where the association finds them, and
    with more weight than a few landmarks have: from the prediction a camera in a bare corridor
    would coast past all that its landmarks say.

    The motion between the two instants is uncertain, which limits what all the depth says. A mere
    prediction is no better: there the depth has to find the pose by itself, without that limit. It
    has to look far only where the motion is not `known` from landmarks up to the last frame: what
    lies ahead of the map's border is then matched with the border, which holds a camera back.
    """
    settings = config.registration
    if image is None:
        search_m = settings.radius_m if known else settings.guess_radius_m
        return _Start(expected, search_m, None)
    Q = memory.motion.passage_covariance(frame.stamp_ns, memory.lag_s(frame))
    T = start_from_landmarks(prior, image)
    return _Start(memory.arrival(frame, T), settings.radius_m, Q)
