# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Joint registration of a frame against the map (paper, depth residual and estimation)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..config.stages import Config
from ..kernels.jit import kernel
from .cloud import FrameCloud, measurement_covariances
from .factors import Factor, NormalEquations, PointFactors, PosePrior, Targets
from .gaussian_map import GaussianMap

_DAMPING_START, _DAMPING_MIN = 1e-5, 1e-7
_SETTLED = 1e-4  # relative decrease of the cost below which no further step is taken
_STEPS_AN_ASSOCIATION = 2
_START_STEPS = 5
_FLATTEST = 1e-3  # smallest lambda3 / lambda2 of Z(Sigma): an exact plane has no inverse


class DepthTerm:
    """Matches each point of a cloud with the nearest Gaussian, if their normals agree."""

    def __init__(
        self,
        cloud: FrameCloud,
        gaussians: GaussianMap,
        focal_px: float,
        config: Config,
        Q: NDArray[np.float64] | None = None,  # (6, 6) as in `PointFactors`
    ) -> None:
        """Compute the D_i, which do not depend on the pose."""
        self.cloud = cloud
        self._gaussians = gaussians
        self._config = config
        self._anchor = config.registration.anchor_px / focal_px
        self._shared = config.shares_covariance
        self._Q = Q
        self._slots = np.full(len(cloud), -1, np.int32)
        if self._shared:
            self._covariances = _plane_covariances(cloud)
        else:
            registration = config.registration
            self._covariances = measurement_covariances(
                cloud.points, cloud.normals, config.sensor,
                registration.footprint_px / focal_px, registration.radius_m,
            )  # fmt: skip

    def associate(self, T_world_cam: NDArray[np.float64], search_m: float) -> PointFactors:
        """Return the matches at a pose, at most `search_m` apart; the r in D_i is not changed.

        The ablation `shared` uses the paper's Z(Sigma) = Sigma / lambda2 on both sides, of the
        scatter for the point and of Sigma_r for the Gaussian, with lambda1 taken equal to lambda2.
        """
        cloud, gaussians, registration = self.cloud, self._gaussians, self._config.registration
        gaussians.index.nearest_moved(
            gaussians.means, cloud.points, T_world_cam, search_m, self._slots
        )
        n = len(cloud)
        targets = Targets(
            np.empty((n, 3), np.float32), np.empty((n, 3), np.float32),
            np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.int32),
        )  # fmt: skip
        map_normals = np.zeros((n, 3), np.float32)
        sensor = self._config.sensor
        _gather(
            self._slots, cloud.normals, T_world_cam, registration.min_normal_cosine,
            gaussians.means, gaussians.normals, gaussians.viewpoints, gaussians.flatness,
            gaussians.hosts, self._anchor, sensor.a_m, sensor.b_per_m, self._shared,
            targets.points, targets.axes, targets.perp, targets.along, targets.hosts, map_normals,
        )  # fmt: skip
        return PointFactors(
            cloud.points, self._covariances, targets, cloud.normals, map_normals, Q=self._Q
        )


@dataclass(frozen=True)
class Registration:
    """The result of the minimisation."""

    T_world_cam: NDArray[np.float64]  # (4, 4)
    depth: PointFactors  # of the last association
    image: PointFactors | None
    equations: NormalEquations  # both terms, at T_world_cam
    image_equations: NormalEquations | None  # of the landmarks alone
    sharp_depth: NormalEquations  # the depth term along the normals only
    inliers: int  # points with a match
    median_chi2: float  # of the depth factors; infinite where none has a match

    @property
    def overlap(self) -> float:
        """Share of the cloud's points that have a match."""
        return self.inliers / max(len(self.depth.points), 1)

    @property
    def hosts(self) -> NDArray[np.int32]:
        """(N,) keyframes of the Gaussians, or else of the landmarks, that were matched."""
        hosts = self.depth.targets.hosts
        if self.image is not None and not self.inliers:
            hosts = self.image.targets.hosts
        return hosts[hosts >= 0]

    def beside(self, image: PointFactors) -> Registration:
        """Return it with landmarks that had no part in it, but tell how sure the pose is."""
        by_image = image.normal_equations(self.T_world_cam)
        return replace(self, image=image, image_equations=by_image)


def descend(
    T_world_cam: NDArray[np.float64], terms: Sequence[Factor], steps: int
) -> NDArray[np.float64]:
    """Return the pose after at most `steps` Levenberg-Marquardt steps with fixed matches.

    A step is T <- T exp(xi). It is checked when the next one starts; the last one is not, since
    the next association follows.
    """
    T, current = T_world_cam, _summed(terms, T_world_cam)
    damping = _DAMPING_START
    trial = T @ se3.exp(current.step(damping))
    for _ in range(steps - 1):
        proposed = _summed(terms, trial)
        if proposed.cost <= current.cost * (1 + 1e-9):
            if current.cost - proposed.cost <= _SETTLED * current.cost:
                return trial
            T, current, damping = trial, proposed, max(0.2 * damping, _DAMPING_MIN)
        else:
            damping = 20 * max(damping, 1e-6)
        trial = T @ se3.exp(current.step(damping))
    return trial


def start_from_landmarks(prior: PosePrior, image: PointFactors) -> NDArray[np.float64]:
    """Return a pose from the landmarks and the predicted motion, which matters in fast motion.

    The prior limits the error from landmarks that are few or close together.
    """
    return descend(prior.T_world_cam, [prior, image], _START_STEPS)


def register(
    T_world_cam: NDArray[np.float64],
    depth: DepthTerm,
    image: PointFactors | None,
    config: Config,
    search_m: float,
    prior: PosePrior | None = None,
) -> Registration:
    """Minimise the paper's E(T): associate and descend until the pose has converged.

    The `prior` is the predicted motion. It is far weaker than what depth and landmarks measure,
    and carries the pose along the directions that they leave open; the equations of the result are
    without it.
    `search_m` is the radius of the first association; it halves with each next one, down to r.
    Convergence is judged over a whole association, since the steps with fixed matches get small
    well before the matches stop changing.
    """
    settings = config.registration
    others = [factor for factor in (image, prior) if factor is not None]
    T, search_m = T_world_cam, max(search_m, settings.radius_m)
    for _ in range(max(1, settings.max_iterations // _STEPS_AN_ASSOCIATION)):
        before = T
        pairs = depth.associate(T, search_m)
        T = descend(T, [pairs, *others], _STEPS_AN_ASSOCIATION)
        way = se3.log(se3.inverse(before) @ T)
        still = math.hypot(*way[:3]) < settings.tolerance_m
        still &= math.hypot(*way[3:]) < settings.tolerance_rad
        if still and search_m == settings.radius_m:
            break
        search_m = max(0.5 * search_m, settings.radius_m)
    T = se3.orthonormalised(T)
    sharp_depth = pairs.along_normals(T)
    equations, chi2 = pairs.evaluated(T)
    by_image = None if image is None else image.normal_equations(T)
    if by_image is not None:
        equations = equations + by_image
    chi2 = chi2[pairs.targets.perp >= 0]
    middle = len(chi2) // 2
    median = float(np.partition(chi2, middle)[middle]) if len(chi2) else np.inf
    return Registration(T, pairs, image, equations, by_image, sharp_depth, len(chi2), median)


def _summed(terms: Sequence[Factor], T: NDArray[np.float64]) -> NormalEquations:
    total = terms[0].normal_equations(T)
    for term in terms[1:]:
        total = total + term.normal_equations(T)
    return total


def _plane_covariances(cloud: FrameCloud) -> NDArray[np.float32]:
    """Return Z(Q_i) = I - (1 - lambda3 / lambda2) n n^T, (N, 6) xx xy xz yy yz zz."""
    n = cloud.normals
    k = 1.0 - np.maximum(cloud.flatness, _FLATTEST)
    return np.column_stack(
        [
            1 - k * n[:, 0] ** 2, -k * n[:, 0] * n[:, 1], -k * n[:, 0] * n[:, 2],
            1 - k * n[:, 1] ** 2, -k * n[:, 1] * n[:, 2], 1 - k * n[:, 2] ** 2,
        ]
    ).astype(np.float32)  # fmt: skip


@kernel
def _gather(
    slots, normals, T, min_cosine, means, map_normals, viewpoints, flatness, map_hosts, anchor,
    noise_a, noise_b, shared, points, axes, perp, along, hosts, matched_normals,
):  # fmt: skip
    """Write the targets of N points: the Gaussians in `slots` whose normals agree.

    `slots` (N,) int32 or -1, `normals` (N, 3) unit, camera; `T` (4, 4) T_world_cam; of the map
    `means`, `map_normals`, `viewpoints` (M, 3) metres, world, `flatness` and `map_hosts` (M,);
    `anchor` p / f, `noise_a` in metres, `noise_b` in 1/metre. Writes `points` and `axes` (N, 3),
    `perp`, `along` and `hosts` (N,) as in `Targets`, and `matched_normals` (N, 3); without a match
    `perp` is -1.
    """
    for i in range(slots.shape[0]):
        perp[i], hosts[i] = -1.0, -1
        j = slots[i]
        if j < 0:
            continue
        a, b, c = normals[i, 0], normals[i, 1], normals[i, 2]
        m0, m1, m2 = map_normals[j, 0], map_normals[j, 1], map_normals[j, 2]
        cosine = (
            (T[0, 0] * a + T[0, 1] * b + T[0, 2] * c) * m0
            + (T[1, 0] * a + T[1, 1] * b + T[1, 2] * c) * m1
            + (T[2, 0] * a + T[2, 1] * b + T[2, 2] * c) * m2
        )
        if not cosine >= min_cosine:
            continue
        points[i, 0], points[i, 1], points[i, 2] = means[j, 0], means[j, 1], means[j, 2]
        hosts[i] = map_hosts[j]
        matched_normals[i, 0], matched_normals[i, 1], matched_normals[i, 2] = m0, m1, m2
        if shared:
            axes[i, 0], axes[i, 1], axes[i, 2] = m0, m1, m2
            perp[i], along[i] = 1.0, max(flatness[j], _FLATTEST)
            continue
        x = means[j, 0] - viewpoints[j, 0]
        y = means[j, 1] - viewpoints[j, 1]
        z = means[j, 2] - viewpoints[j, 2]
        range2 = x * x + y * y + z * z
        s = 1.0 / np.sqrt(range2)
        axes[i, 0], axes[i, 1], axes[i, 2] = x * s, y * s, z * s
        perp[i] = anchor * anchor * range2
        along[i] = (noise_a + noise_b * range2) ** 2
