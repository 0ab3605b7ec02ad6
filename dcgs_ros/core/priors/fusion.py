# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What sensors say of one interval, fused with constant velocity into one prior of the pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..tracking.factors import NormalEquations, PosePrior
from .gyro import Turn
from .planar import FloorPrior
from .readings import MotionFactor

_LIKELY_SIGMAS = 6.0  # of a hand: what is beyond, no robot does either
_STEPS = 4  # of Gauss-Newton: the factors are nearly linear in so small a motion


@dataclass(frozen=True)
class Sensed:
    """What sensors beside the camera say of its motion since the last pose, if anything."""

    factors: tuple[MotionFactor, ...] = ()
    turn: Turn | None = None
    floor: FloorPrior | None = None

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
            hand = replace(hand, T_world_cam=T_world_cam @ self.turn.pose(twist[:3]))
        T = hand.T_world_cam
        placed = [(T_world_cam @ f.T_before_now, f.information) for f in self.factors]
        for _ in range(_STEPS):
            system = self._system(T, placed)
            T = T @ se3.exp((system + hand.normal_equations(T)).step(0.0))
        sensed = self._system(T, placed).H
        return replace(hand, T_world_cam=se3.orthonormalised(T), sensed=sensed)

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
        return total if self.floor is None else total + self.floor.normal_equations(T)


def is_likely(factor: MotionFactor, T_world_cam: NDArray[np.float64], hand: PosePrior) -> bool:
    """Return whether a hand could have moved the camera so from a pose (4, 4).

    Wheels that jump and rates out of range are left out before the images are asked.
    """
    off = se3.log(se3.inverse(hand.T_world_cam) @ T_world_cam @ factor.T_before_now)
    sigmas = np.repeat([hand.sigma_m, hand.sigma_rad], 3)
    covariance = np.diag(sigmas**2) + factor.noise + factor.drift
    return bool(off @ np.linalg.solve(covariance, off) < _LIKELY_SIGMAS**2)
