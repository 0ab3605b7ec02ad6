# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What speaks against an estimate: the motion before, the map, and landmarks against depth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..config.stages import Config
from ..frame import RgbdFrame
from .estimator import Estimate, Memory
from .registration import Registration

_JUMP_SIGMAS = 6.0  # of a hand's acceleration; 4.2 in the fastest real turns measured
_DOUBTFUL_SIGMAS = 3.0
_OVERLAP_DROP = 0.6  # of the last frame's overlap; at least 0.77 there
_DOUBTFUL_DROP = 0.85
_CHI2_RISE = 3.0  # of the usual median of depth's residuals; at most 2.4 there
_DISSENT = 0.25  # share of consistent landmarks; at least 0.3 there
_DOUBTFUL_DISSENT = 0.6
_SETTLING = 0.1  # share by which a frame changes what is usual


@dataclass(frozen=True)
class Usual:
    """How well frames fit the map that were tracked well: an average over a third of a second."""

    overlap: float = 0.9
    chi2: float = 1.0  # median of the depth factors
    agreement: float = 1.0  # of the map with keyframes

    def with_frame(self, found: Registration) -> Usual:
        """Return the average with one more frame."""
        return replace(
            self,
            overlap=self.overlap + _SETTLING * (found.overlap - self.overlap),
            chi2=self.chi2 + _SETTLING * (median_chi2(found) - self.chi2),
        )

    def with_keyframe(self, agreement: float) -> Usual:
        """Return the average with one more keyframe."""
        return replace(self, agreement=0.5 * (self.agreement + agreement))


@dataclass(frozen=True)
class Evidence:
    """How far an estimate is from what was to be expected."""

    jump_sigmas: float  # from the predicted pose, translation or rotation
    overlap_ratio: float  # to the last frame's
    chi2_ratio: float  # median of the depth factors, to the usual one
    consistent: float  # share of the landmarks that agree with the pose; 1: there are none

    @classmethod
    def of(cls, found: Estimate, memory: Memory, usual: Usual, config: Config) -> Evidence:
        """Weigh an estimate of the frame after those in `memory`."""
        registered, result = found.registered, found.registration
        prior = memory.motion.prior(registered.frame.stamp_ns)
        jump = se3.log(se3.inverse(prior.T_world_cam) @ registered.T_world_cam)
        consistent = 1.0
        if result.image is not None:
            chi2 = result.image.chi2(registered.T_world_cam)
            consistent = float(np.mean(chi2 < config.landmarks.drop_chi2))
        depth = (1.0, 1.0)
        if found.sees_depth(config):
            overlap = result.overlap / max(memory.overlap, 1e-9)
            depth = (overlap, median_chi2(result) / usual.chi2)
        return cls(
            max(
                float(np.linalg.norm(jump[:3])) / prior.sigma_m,
                float(np.linalg.norm(jump[3:])) / prior.sigma_rad,
            ),
            *depth,
            consistent,
        )

    @property
    def contradicts(self) -> bool:
        """Whether the estimate is wrong: one jump or misfit that cannot be, or several doubts.

        Landmarks alone do not make it wrong, as things move and turn in front of a camera.
        """
        if self.jump_sigmas > _JUMP_SIGMAS or self.overlap_ratio < _OVERLAP_DROP:
            return True
        doubts = self.jump_sigmas > _DOUBTFUL_SIGMAS or self.overlap_ratio < _DOUBTFUL_DROP
        return self.chi2_ratio > _CHI2_RISE or (self.consistent < _DISSENT and doubts)

    @property
    def doubtful(self) -> bool:
        """Whether the map should not be extended by this frame."""
        return (
            self.jump_sigmas > _DOUBTFUL_SIGMAS
            or self.overlap_ratio < _DOUBTFUL_DROP
            or self.consistent < _DOUBTFUL_DISSENT
            or self.chi2_ratio > 0.6 * _CHI2_RISE
        )


def is_repetition(frame: RgbdFrame, last: RgbdFrame) -> bool:
    """Return whether both images are the last ones again, bit by bit: they say nothing new."""
    same_depth = np.array_equal(frame.depth_m, last.depth_m, equal_nan=True)
    return same_depth and np.array_equal(frame.color, last.color)


def median_chi2(found: Registration) -> float:
    """Return the median of the depth factors' chi2; infinite where none has a match."""
    chi2: NDArray[np.float64] = found.depth.chi2(found.T_world_cam)
    matched = chi2[np.isfinite(chi2)]
    return float(np.median(matched)) if len(matched) else np.inf
