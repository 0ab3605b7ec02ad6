# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which directions the measurements hold, from the Hessian and from what noise cannot feign."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_PRIOR = np.eye(6)  # 1 m, 1 rad: bounds the sigma of unconstrained directions


@dataclass(frozen=True)
class Observability:
    """Spectrum of the 6x6 Hessian in the camera frame (translation first, metres and radians).

    `kappa` are condition numbers: of the whole H; of the information without what comes from the
    finite association radius r or from noise of the normals; of the rotation and translation
    blocks of H. The sigmas are those that independent noise leaves with that information, along
    the weakest direction of a translation and of a rotation.
    """

    eigenvalues: NDArray[np.floating]  # (6,) of H, ascending
    weakest: NDArray[np.floating]  # (6,) unit eigenvector of the smallest one of the information
    kappa: float
    kappa_without_radius: float
    kappa_rotation: float
    kappa_translation: float
    sigma_m: float
    sigma_rad: float

    def is_degenerate(self, limit_m: float, limit_rad: float) -> bool:
        """Return whether a direction is not held to within the limits."""
        return self.sigma_m > limit_m or self.sigma_rad > limit_rad


def observability(H: NDArray[np.floating], information: NDArray[np.floating]) -> Observability:
    """Return the spectrum of the Hessian (6, 6), and of the information that is none of noise."""
    eigenvalues = np.linalg.eigvalsh(H)
    held, directions = np.linalg.eigh(information)
    covariance = np.linalg.inv(information + _PRIOR)
    return Observability(
        eigenvalues,
        directions[:, 0],
        _condition(eigenvalues),
        _condition(held),
        _condition(np.linalg.eigvalsh(H[3:, 3:])),
        _condition(np.linalg.eigvalsh(H[:3, :3])),
        math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
        math.sqrt(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1])),
    )


def _condition(eigenvalues: NDArray[np.floating]) -> float:
    return float(eigenvalues[-1] / max(eigenvalues[0], 1e-12 * eigenvalues[-1], 1e-300))
