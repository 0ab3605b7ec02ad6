# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Repeated images: of a camera that stands still before a sensor without noise, or of a fault.

A real sensor's noise never repeats, so that an image which comes again, bit by bit, is a fault of
the driver. Rendered images have no noise, and a camera that stands still gets the same again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .motion import ConstantVelocity
from .propagation import MotionLimit
from .verification import JUMP_SIGMAS, Usual

_ANY = np.eye(6)  # 1 m, 1 rad: what nothing is known of


@dataclass(frozen=True)
class Standstill:
    """A camera whose images repeat, since the last ones that were new."""

    stamp_ns: int  # of the last new images
    twist: NDArray[np.float64]  # (6,) per second, camera frame, with which it arrived
    covariance: NDArray[np.float64]  # (6, 6) of the pose, with the last new images
    measured: bool  # whether the images are known to have no noise, and so tell that it stands

    @classmethod
    def begun(
        cls, motion: ConstantVelocity, limit: MotionLimit, usual: Usual, stamp_ns: int
    ) -> Standstill | None:
        """Return that of a first repetition at `stamp_ns`; None: it is a fault.

        It is one where images have noise, and where the camera cannot have stopped so soon.
        Before any frame was tracked it is not known whether they have.
        """
        known = usual.frames > 0
        stop = motion.prior(stamp_ns).sigmas_to(motion.T_world_cam, limit.covariance)
        if (known and not usual.is_noise_free) or stop > JUMP_SIGMAS:
            return None
        return cls(limit.stamp_ns, motion.twist, limit.covariance, known)

    def limit(self, before: MotionLimit, stamp_ns: int) -> MotionLimit:
        """Return how far the camera can have gone at a later stamp; `before`: at the last one.

        It stands still, or its images hang while it goes on as it arrived: the way between the two
        is part of the covariance. Where the images may have noise nothing is measured.
        """
        T = before.T_world_cam
        if not self.measured:
            return before.updated(_ANY, T, stamp_ns)
        way = self.twist * (stamp_ns - self.stamp_ns) * 1e-9
        return MotionLimit.begun(self.covariance + np.outer(way, way), T, stamp_ns)
