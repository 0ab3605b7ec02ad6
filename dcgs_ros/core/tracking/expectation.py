# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Where somebody says that the camera is: a person who points at a map, or another estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3

# 10 cm, 5 deg: least sigmas. A place that is pointed at on a floor plan has none along z.
_LEAST = np.diag(np.square(np.repeat([0.1, np.radians(5.0)], 3)))
_WITHIN = 20.0  # chi2 of six degrees of freedom that 99.7 % are below
_TRIED = 256  # places: each is the nearest one within the basin of a registration for some poses
_SEED = 0  # of what is tried


@dataclass(frozen=True)
class ExpectedPlace:
    """A pose of the camera, and how sure it is."""

    T_world_cam: NDArray[np.float64]  # (4, 4)
    covariance: NDArray[np.float64]  # (6, 6) of xi in T_world_cam exp(xi), translation first

    @property
    def _widened(self) -> NDArray[np.float64]:
        return self.covariance + _LEAST

    def admits(self, T_world_cam: NDArray[np.float64]) -> bool:
        """Return whether the camera may be at a pose (4, 4)."""
        xi = se3.log(se3.inverse(self.T_world_cam) @ T_world_cam)
        return float(xi @ np.linalg.solve(self._widened, xi)) <= _WITHIN

    def poses(self) -> list[NDArray[np.float64]]:
        """Return poses (4, 4) to try, drawn as likely as they are; always the same ones."""
        drawn = np.random.default_rng(_SEED).standard_normal((_TRIED, 6))
        around = drawn @ np.linalg.cholesky(self._widened).T
        return [self.T_world_cam @ se3.exp(xi) for xi in around]
