# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What speaks against an estimate: the motion before, the map, and landmarks against depth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..config.stages import Config
from ..frame import RgbdFrame
from .estimator import Estimate, Memory
from .factors import PosePrior
from .gaussian_map import GaussianMap
from .registration import Registration

JUMP_SIGMAS = 6.0  # of a hand's acceleration; 4.2 in the fastest real turns measured
_DOUBTFUL_SIGMAS = 3.0
_OVERLAP_DROP = 0.85  # of the last frame's overlap: below, the agreement tells why
_DISAGREEMENT = 0.8  # of the usual agreement
_CHI2_RISE = 3.0  # of the usual median of depth's residuals; at most 2.4 there
_DOUBTFUL_RISE = 1.8
_CHI2_OF_NOISE = 0.2  # less than any real sensor's
_DISSENT = 0.25  # share of consistent landmarks; at least 0.3 there
_DOUBTFUL_DISSENT = 0.6
_SOME = 20  # landmarks; fewer may be noise
_APART = 1.0  # of the limits of a degenerate pose and what is claimed; at most 0.65 there
_DOUBTFUL_APART = 2.0 / 3.0
_CONFIRMING_APART = 0.5  # at most; a camera that was found by depth has new landmarks
_VANISHED = 0.2  # share of many landmarks that are found again; at least 0.36 there
_SUPPORT, _MANY = 0.8, 50  # share and number of consistent landmarks
_ROWS_APART = 16  # these rows tell most images apart, before all are compared
_SETTLING = 0.1  # share by which a frame changes what is usual


@dataclass(frozen=True)
class Usual:
    """How well frames fit the map that were tracked well: an average over a third of a second."""

    overlap: float = 0.82
    chi2: float = 1.0  # median of the depth factors
    agreement: float = 1.0  # of the map with keyframes
    frames: int = 0  # that the average is over; what it begins with counts as none

    @property
    def expected_chi2(self) -> float:
        """`chi2`, or what noise would make of it if that is more: rendered depth has none."""
        return max(self.chi2, _CHI2_OF_NOISE)

    @property
    def is_noise_free(self) -> bool:
        """Whether depth fits better than that of any real sensor: it is rendered."""
        return self.chi2 < _CHI2_OF_NOISE

    def with_frame(self, found: Registration) -> Usual:
        """Return the average with one more frame."""
        frames = self.frames + 1
        share = max(_SETTLING, 1.0 / frames)
        return replace(
            self,
            overlap=self.overlap + share * (found.overlap - self.overlap),
            chi2=self.chi2 + share * (found.median_chi2 - self.chi2),
            frames=frames,
        )

    def with_keyframe(self, agreement: float) -> Usual:
        """Return the average with one more keyframe."""
        return replace(self, agreement=0.5 * (self.agreement + agreement))


@dataclass(frozen=True)
class Evidence:
    """How far an estimate is from what was to be expected."""

    jump_sigmas: float  # from the predicted pose, translation or rotation
    overlap_ratio: float  # to the last frame's
    agreement_ratio: float  # of the map with the frame, to the usual one; 1 if overlap is kept
    chi2_ratio: float  # median of the depth factors, to the usual one
    consistent: float  # share of the landmarks that agree with the pose; 1: there are none
    landmarks: int  # followed into the frame
    kept: float = 1.0  # share of the last image's landmarks that were found in this one
    apart: float = 0.0  # of depth and landmarks, each alone: share of what is allowed

    @property
    def misfits(self) -> bool:
        """Whether the map explains less of the frame without having less to explain.

        Where the view turns to what is not mapped yet, the overlap falls, but the frame sees all
        that it should see of the map.
        """
        return self.overlap_ratio < _OVERLAP_DROP and self.agreement_ratio < _DISAGREEMENT

    @property
    def contradicts(self) -> bool:
        """Whether the estimate is wrong: a jump or a misfit that cannot be, or two doubts.

        Landmarks alone do not make it wrong, as things move and turn in front of a camera; many
        that agree outweigh a doubt, and a knock is a jump that they confirm. They agree with the
        pose wherever they pull it: if depth by itself says another one, colour and depth are not
        of one camera at one instant.
        """
        jumps = self.jump_sigmas > _DOUBTFUL_SIGMAS
        dissent = self.consistent < _DISSENT and self.landmarks >= _SOME
        other_view = dissent or self.kept < _VANISHED
        support = self.consistent > _SUPPORT and self.landmarks >= _MANY
        return (
            (self.jump_sigmas > JUMP_SIGMAS and not support)
            or self.chi2_ratio > _CHI2_RISE
            or self.apart > _APART
            or jumps + other_view + self.misfits - support >= 2
        )

    @property
    def doubtful(self) -> bool:
        """Whether the map should not be extended by this frame."""
        return (
            self.jump_sigmas > _DOUBTFUL_SIGMAS
            or self.misfits
            or self.consistent < _DOUBTFUL_DISSENT
            or self.chi2_ratio > _DOUBTFUL_RISE
            or self.apart > _DOUBTFUL_APART
        )

    @property
    def confirms(self) -> bool:
        """Whether the frame agrees with the place where a lost camera was found."""
        return not self.doubtful and self.apart < _CONFIRMING_APART


def weigh(
    found: Estimate,
    memory: Memory,
    usual: Usual,
    uncertain: NDArray[np.float64],
    gaussians: GaussianMap,
    camera: PinholeCamera,
    config: Config,
) -> Evidence:
    """Return what speaks against an estimate of the frame after those in `memory`.

    `uncertain` (6, 6) is the covariance of its pose and of the one before, together.
    """
    registered, result = found.registered, found.registration
    T, frame = registered.T_world_cam, registered.frame
    overlap = agreement = chi2 = consistent = 1.0
    if found.sees_depth(config):
        overlap = result.overlap / max(memory.overlap, 1e-9)
        chi2 = result.median_chi2 / usual.expected_chi2
        if overlap < _OVERLAP_DROP:
            T_depth = T @ registered.T_cam_cam_at_depth
            share = gaussians.agreement(T_depth, frame.depth_m, camera, config.sensor)
            agreement = share / usual.agreement
    if result.image is not None:
        consistent = float(np.mean(found.image_chi2 < config.landmarks.drop_chi2))
    jump = found.prior.sigmas_to(T, uncertain)
    kept, before = 1.0, len(memory.landmarks)
    if found.fresh and before >= _MANY:
        kept = len(found.landmarks) / before
    apart = _apart(result, found.prior, uncertain, config)
    return Evidence(jump, overlap, agreement, chi2, consistent, len(found.landmarks), kept, apart)


def _apart(
    found: Registration,
    prior: PosePrior,
    uncertain: NDArray[np.float64],  # (6, 6) as in `weigh`
    config: Config,
) -> float:
    """Return how far depth and landmarks, each alone, place the camera from each other.

    It is a share of the limits of a degenerate pose, of what a bias of depth moves it besides, and
    of what is claimed to be open. Along what one of them hardly holds the offset counts the less:
    as if known to be 0 as well as the predicted pose is known.
    """
    if found.image is None or found.image_equations is None:
        return 0.0
    limits, offset = config.registration, found.sharp_depth.apart_from(found.image_equations)
    known = np.repeat([prior.sigma_m**-2, prior.sigma_rad**-2], 3)
    delta = np.linalg.solve(offset.H + np.diag(known), offset.g)
    bias_m = config.sensor.depth_bias * float(np.mean(found.image.points[:, 2]))
    allowed = ((slice(3), limits.degenerate_m + bias_m), (slice(3, 6), limits.degenerate_rad))
    return max(
        math.sqrt(delta[k] @ np.linalg.solve(limit**2 * np.eye(3) + uncertain[k, k], delta[k]))
        for k, limit in allowed
    )


def is_repetition(frame: RgbdFrame, last: RgbdFrame) -> bool:
    """Return whether both images are the last ones again, bit by bit: they say nothing new."""
    return _same(frame.color, last.color) and repeats_depth(frame, last)


def repeats_depth(frame: RgbdFrame, last: RgbdFrame) -> bool:
    """Return whether the depth image is the last one again, bit by bit."""
    return _same(frame.depth_m.view(np.uint32), last.depth_m.view(np.uint32))


def _same(image: NDArray[np.generic], last: NDArray[np.generic]) -> bool:
    some = slice(None, None, _ROWS_APART)
    return np.array_equal(image[some], last[some]) and np.array_equal(image, last)
