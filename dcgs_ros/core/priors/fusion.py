# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What sensors say of one interval, fused with constant velocity into one prior of the pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..tracking.factors import NormalEquations, PosePrior
from .gravity import UpPrior
from .gyro import Turn
from .planar import FloorPrior
from .readings import MotionFactor

_LIKELY_SIGMAS = 6.0  # of a hand: what is beyond, no robot does either
# Shares of the limits: held by the images below the first, not at all above the second.
_HELD, _UNHELD = 1.0 / 6.0, 0.5
_OPEN = 30.0  # times the limits: sensors may know as little of what images leave open
_LEAST_TRUST = 1e-2  # in the images where they hold nothing: of the information they claim
_STEPS = 4  # of Gauss-Newton: the factors are nearly linear in so small a motion


@dataclass(frozen=True)
class Sensed:
    """What sensors beside the camera say of its motion since the last pose, if anything."""

    factors: tuple[MotionFactor, ...] = ()
    turn: Turn | None = None
    floor: FloorPrior | None = None
    T_base_cam: NDArray[np.float64] | None = None  # (4, 4), where wheels carry the camera
    tells_way: bool = False  # whether the wheels tell how far it went
    up: UpPrior | None = None

    @property
    def spans(self) -> bool:
        """Whether it tells how the camera moved, however long the interval was."""
        return bool(self.factors)

    def fused(
        self, hand: PosePrior, T_world_cam: NDArray[np.float64], twist: NDArray[np.float64]
    ) -> PosePrior:
        """Return the prior after the interval; `hand` is what constant velocity says.

        The last pose is `T_world_cam` (4, 4), the last `twist` (6,) per second, camera frame. The
        mean is that of all together, in information form.
        """
        if self.turn is not None:  # constant velocity in a camera that turns as measured
            hand = replace(hand, T_world_cam=T_world_cam @ self.turn.pose(twist, self.T_base_cam))
        T = hand.T_world_cam
        placed = [(T_world_cam @ f.T_before_now, f.information) for f in self.factors]
        for _ in range(_STEPS):
            system = self._system(T, placed)
            T = T @ se3.exp((system + hand.normal_equations(T)).step(0.0))
        sensed = np.asarray(self._system(T, placed).H, np.float64)
        return replace(hand, T_world_cam=se3.orthonormalised(T), sensed=sensed)

    def carried(
        self,
        T_by_images: NDArray[np.float64],  # (4, 4)
        covariance: NDArray[np.float64],  # (6, 6) of that, honestly
        T_last: NDArray[np.float64],  # (4, 4)
        limits: tuple[float, float],  # metres and radians at which a pose is degenerate
    ) -> NDArray[np.float64]:
        """Return the pose, which goes on as the sensors tell along what the images hardly hold.

        An average would not do: along a bare wall the images do not say nothing, they say that the
        camera moved less than it did, in each frame again. They are believed wholly along the axes
        that they hold to a sixth of the limits, and not at all where it is less than half of them.
        """
        scale = np.repeat([1.0 / limits[0], 1.0 / limits[1]], 3)
        variances, axes = np.linalg.eigh(covariance * np.outer(scale, scale))
        sigmas = np.clip(np.sqrt(np.maximum(variances, 0.0)), 1e-6, _OPEN)
        weakness = np.clip((sigmas - _HELD) / (_UNHELD - _HELD), 1e-6, 1.0)
        trust = (1.0 - weakness) / weakness + _LEAST_TRUST
        scaled = axes * scale[:, None]
        images = (scaled * (trust / sigmas**2)) @ scaled.T
        placed = [(T_last @ f.T_before_now, f.information) for f in self.factors]
        sensors = self._system(T_by_images, placed)
        return np.asarray(T_by_images @ se3.exp(np.linalg.solve(images + sensors.H, sensors.g)))

    def _system(
        self,
        T: NDArray[np.float64],
        placed: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    ) -> NormalEquations:
        total = NormalEquations(np.zeros((6, 6)), np.zeros(6), 0.0)
        for T_said, information in placed:
            residual = se3.log(se3.inverse(T) @ T_said)
            g = information @ residual
            total = total + NormalEquations(information, g, float(residual @ g))
        for term in (self.floor, self.up):
            if term is not None:
                total = total + term.normal_equations(T)
        return total


def is_likely(factor: MotionFactor, T_world_cam: NDArray[np.float64], hand: PosePrior) -> bool:
    """Return whether a hand could have moved the camera so from a pose (4, 4).

    Wheels that jump and rates out of range are left out before the images are asked.
    """
    sigmas = hand.sigmas_to(T_world_cam @ factor.T_before_now, factor.noise + factor.drift)
    return sigmas < _LIKELY_SIGMAS
