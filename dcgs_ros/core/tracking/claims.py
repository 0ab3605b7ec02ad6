# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How sure a pose is: what residuals, clocks and the motion so far leave open of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..config.stages import Config
from ..priors.readings import MotionFactor
from .hosting import Hosts
from .observability import Observability
from .propagation import BiasVariance, MotionLimit
from .registration import Registration
from .uncertainty import PoseUncertainty, pose_uncertainty

_LEAST_VARIANCE = 1e-10  # of shared covariances' residuals: perfect depth leaves none
_HELD_AGAIN = 2.0 / 3.0  # of the limits of a degenerate pose


@dataclass(frozen=True)
class Claim:
    """How sure a pose is."""

    covariance: NDArray[np.float64]  # (6, 6) in the map around the camera
    in_world: NDArray[np.float64]  # (6, 6)
    hosts: Hosts
    submap: int

    @classmethod
    def certain(cls) -> Claim:
        """Return that of the frame that begins a map: the world is its."""
        return cls(np.zeros((6, 6)), np.zeros((6, 6)), Hosts.none(), 0)


@dataclass(frozen=True)
class Clocks:
    """What time leaves open of a frame's pose."""

    lag_sigma_s: float  # standard deviation of colour's offset to depth
    twist: NDArray[np.float64]  # (6,) of the camera, per second, in its frame


class PoseClaims:
    """The covariances of poses in the map around the camera, from frame to frame."""

    def __init__(self, camera: PinholeCamera, config: Config) -> None:
        """Start before the first pose."""
        self._camera, self.config = camera, config
        self.limit: MotionLimit | None = None  # of the last frame that was tracked
        self._bias = BiasVariance()
        self._degenerate = False  # the last frame

    def begin(self, T_world_cam: NDArray[np.float64], stamp_ns: int) -> None:
        """Begin at a certain pose (4, 4)."""
        self.forget()
        self.limit = MotionLimit.begun(np.zeros((6, 6)), T_world_cam, stamp_ns)

    def forget(self) -> None:
        """Forget the last frame, where the next one is placed without it."""
        self.limit, self._degenerate = None, False

    def move(self, motion: NDArray[np.float64]) -> None:
        """Go on where a correction moves the camera by `motion` (4, 4) in the world."""
        if self.limit is not None:
            self.limit = replace(self.limit, T_world_cam=motion @ self.limit.T_world_cam)

    def uncertainty(self, found: Registration) -> PoseUncertainty:
        """Return what the residuals of a registration leave open."""
        variance = 1.0
        if self.config.shares_covariance:  # not metric: scaled by the residual
            variance = max(found.sharp_depth.cost / max(found.inliers - 6, 1), _LEAST_VARIANCE)
        return pose_uncertainty(found, self._camera, variance)

    def measured(self, uncertainty: PoseUncertainty, clocks: Clocks) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of a pose from its own frame alone."""
        return uncertainty.covariance(self._bias.beta2, clocks.lag_sigma_s, clocks.twist)

    def in_doubt(self, measured: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of a `measured` pose and of the one before, together."""
        before = np.zeros((6, 6)) if self.limit is None else self.limit.covariance
        return before + measured

    def advance(
        self,
        T_world_cam: NDArray[np.float64],
        stamp_ns: int,
        uncertainty: PoseUncertainty,
        clocks: Clocks,
        sensed: Sequence[MotionFactor] = (),
    ) -> NDArray[np.float64]:
        """Take the pose (4, 4) of a tracked frame; return its covariance (6, 6).

        `sensed` is the motion since the last one by other sensors.
        """
        self._bias = self._bias.observed(uncertainty.bias_evidence)
        measured = self.measured(uncertainty, clocks)
        if self.limit is None:
            self.limit = MotionLimit.begun(measured, T_world_cam, stamp_ns)
        else:
            self.limit = self.limit.updated(measured, T_world_cam, stamp_ns, sensed)
        return self.limit.covariance + self._late(clocks)

    def of_motion(self, clocks: Clocks) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of the motion that ended with the last `advance`.

        In the camera frame there; both stamps are uncertain.
        """
        assert self.limit is not None
        return self.limit.motion_covariance + 2.0 * self._late(clocks)

    def _late(self, clocks: Clocks) -> NDArray[np.float64]:
        """Return what an uncertain stamp adds to the covariance (6, 6) of a pose."""
        late = 1e-3 * self.config.sensor.stamp_ms * clocks.twist
        return np.outer(late, late)

    def carry(
        self, T_world_cam: NDArray[np.float64], stamp_ns: int, sensed: Sequence[MotionFactor]
    ) -> NDArray[np.float64]:
        """Take a pose (4, 4) that only other sensors tell; return its covariance (6, 6)."""
        assert self.limit is not None
        self.limit = self.limit.updated(np.eye(6), T_world_cam, stamp_ns, sensed)
        return self.limit.covariance

    def stays_degenerate(self, spectrum: Observability) -> bool:
        """Return whether the frame that was last taken is degenerate, given the frame before.

        What is anchored from a degenerate pose is as wrong as the pose, but claims to be certain,
        and the next frames are placed against it. So a direction is held again only where it is
        held clearly better than the limit; else the state would flicker about it.
        """
        assert self.limit is not None
        share = _HELD_AGAIN if self._degenerate else 1.0
        self._degenerate = self.is_degenerate(spectrum, self.limit.covariance, share)
        return self._degenerate

    def is_degenerate(
        self, spectrum: Observability, covariance: NDArray[np.float64], share: float = 1.0
    ) -> bool:
        """Return whether a direction is not held, by the frame or by what is claimed of it.

        `share` is that of the limits which counts.
        """
        limits = self.config.registration
        unheld = spectrum.is_degenerate(share * limits.degenerate_m, share * limits.degenerate_rad)
        return unheld or self.exceeds(covariance, share)

    def exceeds(self, covariance: NDArray[np.float64], share: float = 1.0) -> bool:
        """Return whether the largest claimed sigma (6, 6) is that of a degenerate pose."""
        limits = self.config.registration
        claimed_m, claimed_rad = (
            math.sqrt(np.linalg.eigvalsh(block)[-1])
            for block in (covariance[:3, :3], covariance[3:, 3:])
        )
        return (
            claimed_m > share * limits.degenerate_m or claimed_rad > share * limits.degenerate_rad
        )
