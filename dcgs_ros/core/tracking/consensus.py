# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which landmarks stand still, where some of them move by themselves.

A thing that moves near the camera and a camera that goes sideways and turns are alike to corners
that lie at two depths: least squares, Huber's too, finds a pose that suits both. So where that
jumps, or many residuals are large, the pose is sought that suits most landmarks best, whatever
the rest do (least trimmed squares: Rousseeuw and Van Driessen 2006), from where the camera was
expected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .cloud import FrameCloud
from .factors import PointFactors, PosePrior
from .registration import descend

# What calls for a choice: a start so far from where the camera was expected, or such residuals.
_JUMP_SIGMAS = 2.0  # of a hand's acceleration
_LARGE_CHI2, _MANY = 50.0, 0.05  # share of landmarks
_FEWEST = 40  # landmarks: a choice of fewer would be the prediction's
_MOST = 0.6  # share that is believed to stand still
_ROUNDS, _STEPS = 4, 2
_NEARER = 0.5  # of the jump, at most, is left where it was a thing that moved
_MOVES_CHI2 = 16.0  # of a landmark at the pose of most
_REACH_M = 0.3  # how far a point speaks for others: farther depth is of something else


@dataclass(frozen=True)
class Corners:
    """Where a frame measured its landmarks, and which of them move."""

    points: NDArray[np.float32]  # (L, 3) metres, camera, at colour's instant
    moving: NDArray[np.bool_]  # (L,)

    @classmethod
    def none(cls) -> Corners:
        """Return an empty set."""
        return cls(np.empty((0, 3), np.float32), np.empty(0, np.bool_))

    def standing(self, cloud: FrameCloud) -> FrameCloud:
        """Return the points whose nearest corner does not move, or is not near.

        The cloud is in the camera frame, at colour's instant or not far from it.
        """
        if not self.moving.any():
            return cloud
        return cloud[~told_by_nearest(self.points, self.moving, cloud.points)]


def told_by_nearest(
    points: NDArray[np.float32],  # (N, 3) metres
    told: NDArray[np.bool_],  # (N,) what is known of each
    others: NDArray[np.float32],  # (M, 3) metres, in the same frame
) -> NDArray[np.bool_]:
    """Return what the nearest of the points tells of each of the `others` (M,); far off, False."""
    _, nearest = cKDTree(points).query(others, distance_upper_bound=_REACH_M)
    return np.asarray(np.append(told, False)[nearest])


def standing(
    T_world_cam: NDArray[np.float64], prior: PosePrior, image: PointFactors
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return a pose (4, 4), and which landmarks (L,) stand still; `T_world_cam` suits them all."""
    all_stand = T_world_cam, np.ones(len(image.points), np.bool_)
    many = np.mean(image.chi2(T_world_cam) > _LARGE_CHI2) > _MANY
    jump = prior.sigmas_to(T_world_cam)
    if len(image.points) < _FEWEST or (not many and jump < _JUMP_SIGMAS):
        return all_stand
    T = prior.T_world_cam
    for _ in range(_ROUNDS):
        chi2 = image.chi2(T)
        most = image[chi2 <= np.quantile(chi2, _MOST)]
        T = descend(T, [prior, most], _STEPS)
    if prior.sigmas_to(T) > _NEARER * jump:
        return all_stand
    return T, image.chi2(T) < _MOVES_CHI2
