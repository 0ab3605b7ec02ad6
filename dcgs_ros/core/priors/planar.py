# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The floor under a base: z, roll and pitch are about what they were at the start.

It is soft: how far the base is off, in sigmas, is weighed by 1 / (1 + (r / c)^2)^2 (Geman and
McClure), so that drift is drawn back, and a ramp, which the images see, is let go.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..tracking.factors import NormalEquations

_DRIFT = 5.0  # c: what is farther off, in sigmas, is no drift


@dataclass(frozen=True)
class FloorPrior:
    """A term of the cost: the base stands on the floor."""

    T_world_floor: NDArray[np.float64]  # (4, 4) of the base at its start: z is up
    T_base_cam: NDArray[np.float64]  # (4, 4)
    sigma_m: float
    sigma_rad: float

    def normal_equations(self, T_world_cam: NDArray[np.float64]) -> NormalEquations:
        """Return the term of the residual (z, roll, pitch) of the base in sigmas, so weighed."""
        T = se3.inverse(self.T_world_floor) @ T_world_cam @ se3.inverse(self.T_base_cam)
        x, y, z = T[2, :3]  # the floor's normal in the base's frame
        if z <= 0.0:
            return NormalEquations(np.zeros((6, 6)), np.zeros(6), 0.0)
        residual = np.array([-T[2, 3] / self.sigma_m, -y / self.sigma_rad, x / self.sigma_rad])
        J = np.zeros((3, 6))  # by a motion of the base
        J[0, :3] = np.array([x, y, z]) / self.sigma_m
        J[1, 3:] = np.array([z, 0.0, -x]) / self.sigma_rad
        J[2, 3:] = np.array([0.0, z, -y]) / self.sigma_rad
        off2 = np.square(residual)
        off2[1:] = off2[1:].sum()
        weights = (1.0 + off2 / _DRIFT**2) ** -2.0
        J = J @ se3.adjoint(self.T_base_cam)
        H, g = J.T @ (weights[:, None] * J), J.T @ (weights * residual)
        return NormalEquations(H, g, float(np.square(residual) @ np.sqrt(weights)))


def on_floor(
    T_world_cam: NDArray[np.float64],
    T_base_cam: NDArray[np.float64],
    sigma_m: float,
    sigma_deg: float,
) -> FloorPrior:
    """Return the floor under a base whose camera is at a pose (4, 4)."""
    T_world_floor = T_world_cam @ se3.inverse(T_base_cam)
    return FloorPrior(T_world_floor, T_base_cam, sigma_m, math.radians(sigma_deg))
