# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The covariance of the pose and its weakly constrained directions, from the Hessian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_PRIOR = np.eye(6)  # 1 m, 1 rad: bounds the covariance of unconstrained directions


@dataclass(frozen=True)
class Observability:
    """Spectrum of the 6x6 Hessian in the camera frame (translation first, metres and radians).

    `kappa` are condition numbers: of the whole H; of H without the tangential information that
    comes from the finite association radius r; of the rotation and translation blocks of H.
    """

    eigenvalues: NDArray[np.floating]  # (6,) of H, ascending
    weakest: NDArray[np.floating]  # (6,) unit eigenvector of the smallest one without radius
    kappa: float
    kappa_without_radius: float
    kappa_rotation: float
    kappa_translation: float
    block_ratio: float  # the larger condition number of the two blocks without radius


def observability(
    H: NDArray[np.floating], H_without_radius: NDArray[np.floating]
) -> Observability:
    """Return the spectrum of the Hessian (6, 6), with and without the radius' information."""
    eigenvalues = np.linalg.eigvalsh(H)
    sharp, directions = np.linalg.eigh(H_without_radius)
    blocks = (H_without_radius[:3, :3], H_without_radius[3:, 3:])
    return Observability(
        eigenvalues,
        directions[:, 0],
        _condition(eigenvalues),
        _condition(sharp),
        _condition(np.linalg.eigvalsh(H[3:, 3:])),
        _condition(np.linalg.eigvalsh(H[:3, :3])),
        max(_condition(np.linalg.eigvalsh(block)) for block in blocks),
    )


def pose_covariance(H: NDArray[np.floating], variance: float = 1.0) -> NDArray[np.floating]:
    """Return the covariance (6, 6) of xi in T_world_cam exp(xi): square metres and radians.

    `variance` scales it if the cost is not metric (the ablations with normalised covariances).
    """
    return np.linalg.inv(H / variance + _PRIOR)


def _condition(eigenvalues: NDArray[np.floating]) -> float:
    return float(eigenvalues[-1] / max(eigenvalues[0], 1e-12 * eigenvalues[-1], 1e-300))
