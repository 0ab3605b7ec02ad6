# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Covariances from residuals of known statistics, and degenerate scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import RegistrationConfig
from dcgs_ros.core.tracking.factors import PointFactors, Targets
from dcgs_ros.core.tracking.observability import observability
from dcgs_ros.core.tracking.registration import Registration
from dcgs_ros.core.tracking.uncertainty import PoseUncertainty, pose_uncertainty

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
SIGMA_M = 0.003
NORMAL_RAD = 0.05  # noise of normals
LIMITS = (RegistrationConfig().degenerate_m, RegistrationConfig().degenerate_rad)
DENSE = 1e-4  # relative: float32 inputs
T_WORLD_CAM = se3.exp(np.array([0.3, -0.2, 0.5, 0.1, 0.2, -0.3]))
Planes = list[tuple[tuple[float, float, float], float]]
WALL: Planes = [((0, 0, -1), 1.5)]  # n . p = -distance
CORNER: Planes = [((0, 0, -1), 2.0), ((1, 0, 0), 0.8), ((0, -1, 0), 0.7)]
FOLDED: Planes = [((0.6, 0, -0.8), 1.2), ((-0.6, 0, -0.8), 1.2)]  # free along y


def scene(planes: Planes, count: int = 3000, seed: int = 1) -> tuple[NDArray[np.float64], ...]:
    """Points (N, 3) that a camera sees of the nearest plane, and their normals."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0, 0), (640, 480), (count, 2))
    rays = np.column_stack([(pixels - (319.5, 239.5)) / 525.0, np.ones(count)])
    n = np.array([plane[0] for plane in planes], np.float64)
    facing = rays @ n.T
    with np.errstate(divide='ignore'):
        z = np.where(facing < -1e-3, -np.array([plane[1] for plane in planes]) / facing, np.inf)
    nearest = z.argmin(axis=1)
    return rays * z.min(axis=1, keepdims=True), n[nearest]


def tilted(normals: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Normals with independent errors of NORMAL_RAD about each axis."""
    noisy = normals + rng.normal(scale=NORMAL_RAD, size=normals.shape)
    return np.asarray(noisy / np.linalg.norm(noisy, axis=1, keepdims=True))


def pairs_of(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    map_normals: NDArray[np.float64],
    residuals: NDArray[np.float64],
) -> PointFactors:
    """Pairs of a camera at T_WORLD_CAM with residuals (N,) along the normals, sigma SIGMA_M."""
    R, t = T_WORLD_CAM[:3, :3], T_WORLD_CAM[:3, 3]
    n = len(points)
    world = (points + residuals[:, None] * normals) @ R.T + t
    half = np.full(n, 0.5 * SIGMA_M**2, np.float32)
    targets = Targets(
        world.astype(np.float32), np.tile(np.array([0, 0, 1], np.float32), (n, 1)), half, half,
        np.zeros(n, np.int32),
    )  # fmt: skip
    isotropic = np.array([1, 0, 0, 1, 0, 1], np.float32) * np.float32(0.5 * SIGMA_M**2)
    return PointFactors(
        points.astype(np.float32), np.tile(isotropic, (n, 1)), targets,
        normals.astype(np.float32), (map_normals @ R.T).astype(np.float32),
    )  # fmt: skip


def registered(depth: PointFactors, image: PointFactors | None = None) -> Registration:
    """Pairs as if they had been registered at T_WORLD_CAM."""
    sharp_depth = depth.along_normals(T_WORLD_CAM)
    by_image = None if image is None else image.normal_equations(T_WORLD_CAM)
    equations = sharp_depth if by_image is None else sharp_depth + by_image
    n = len(depth.points)
    return Registration(T_WORLD_CAM, depth, image, equations, by_image, sharp_depth, n, 1.0)


def uncertainty(
    planes: Planes,
    residuals: NDArray[np.float64] | None = None,
    noisy: bool = False,
    image: PointFactors | None = None,
    seed: int = 1,
) -> PoseUncertainty:
    rng = np.random.default_rng(seed + 100)
    points, normals = scene(planes)
    of_frame, of_map = (tilted(normals, rng) if noisy else normals for _ in range(2))
    if residuals is None:
        residuals = rng.normal(scale=SIGMA_M, size=len(points))
    return pose_uncertainty(
        registered(pairs_of(points, of_frame, of_map, residuals), image), CAMERA
    )


def landmarks(count: int = 40, seed: int = 3) -> PointFactors:
    """Corners on the wall, with the noise of theirs."""
    points, _ = scene(WALL, count, seed)
    noise = np.random.default_rng(seed).normal(scale=0.002, size=points.shape)
    world = (points + noise) @ T_WORLD_CAM[:3, :3].T + T_WORLD_CAM[:3, 3]
    variance = np.full(count, 2e-6, np.float32)
    targets = Targets(
        world.astype(np.float32), np.tile(np.array([0, 0, 1], np.float32), (count, 1)), variance,
        variance, np.zeros(count, np.int32),
    )  # fmt: skip
    covariances = np.tile(np.array([2, 0, 0, 2, 0, 2], np.float32) * np.float32(1e-6), (count, 1))
    return PointFactors(points.astype(np.float32), covariances, targets, huber=2.0)


def rows(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows n^T [I, -[a]x], (N, 6)."""
    return np.column_stack([normals, np.cross(points, normals)])


def is_degenerate(found: PoseUncertainty) -> bool:
    H = found.information
    return observability(H + np.eye(6), H).is_degenerate(*LIMITS)


def test_exact_normals_leave_the_information_of_point_to_plane() -> None:
    """Less what could be chance: two sigma of a sum of N terms."""
    points, normals = scene(CORNER)
    J = rows(points, normals) / SIGMA_M
    H = J.T @ J
    found = uncertainty(CORNER).information
    ratios = np.linalg.eigvals(np.linalg.solve(H, found)).real
    assert 0.85 < ratios.min() and ratios.max() < 1.0


def test_crossed_normals_are_the_dense_formula() -> None:
    """H = sum (J_n^T J_m + J_m^T J_n) / 2 variance, less 2 sqrt(sum (u J_n J_m u)^2)."""
    rng = np.random.default_rng(7)
    points, normals = scene(CORNER)
    n, m = tilted(normals, rng), tilted(normals, rng)
    pairs = pairs_of(points, n, m, np.zeros(len(points)))
    found = pose_uncertainty(registered(pairs), CAMERA).information
    J_n, J_m = rows(points, n) / SIGMA_M, rows(points, m) / SIGMA_M
    eigenvalues, U = np.linalg.eigh(0.5 * (J_n.T @ J_m + J_m.T @ J_n))
    chance = np.sqrt((((J_n @ U) * (J_m @ U)) ** 2).sum(axis=0))
    expected = U @ np.diag(eigenvalues - 2 * chance) @ U.T
    np.testing.assert_allclose(found, expected, atol=DENSE * np.abs(expected).max())


@pytest.mark.parametrize('seed', range(5))
def test_noise_of_normals_does_not_hold_a_plane(seed: int) -> None:
    """With the frame's normals alone it looks held: to 1 mm and less."""
    found = uncertainty(WALL, noisy=True, seed=seed)
    assert is_degenerate(found)
    points, normals = scene(WALL)
    J = rows(points, tilted(normals, np.random.default_rng(seed))) / SIGMA_M
    assert np.sqrt(np.linalg.inv(J.T @ J).diagonal().max()) < 2e-3


@pytest.mark.parametrize('noisy', [False, True])
def test_what_holds_a_pose_is_not_degenerate(noisy: bool) -> None:
    assert not is_degenerate(uncertainty(CORNER, noisy=noisy))
    assert not is_degenerate(uncertainty(WALL, noisy=noisy, image=landmarks()))
    assert is_degenerate(uncertainty(WALL, noisy=noisy))


@pytest.mark.parametrize('noisy', [False, True])
def test_the_weak_direction_is_named(noisy: bool) -> None:
    """Two walls that meet in a vertical edge leave the camera free along it."""
    H = uncertainty(FOLDED, noisy=noisy).information
    weakest = np.abs(observability(H, H).weakest)
    assert weakest.argmax() == 1
    assert is_degenerate(uncertainty(FOLDED, noisy=noisy))


def test_independent_residuals_give_the_inverse_hessian() -> None:
    """In expectation: the sandwich's mean over draws, in units of H^-1."""
    points, normals = scene(CORNER)
    J = rows(points, normals) / SIGMA_M
    H = J.T @ J
    rng = np.random.default_rng(11)
    noise = [
        uncertainty(CORNER, rng.normal(scale=SIGMA_M, size=len(points))).noise for _ in range(60)
    ]
    root = np.linalg.cholesky(H)
    design = root.T @ np.mean(noise, axis=0) @ root
    # 4 sigma of the mean of 60 draws; up to 15 % of the information is given up for chance.
    np.testing.assert_allclose(np.diag(design), 1.15, atol=0.35)
    assert np.abs(design - np.diag(np.diag(design))).max() < 0.3


def test_residuals_that_a_cell_shares_count_once() -> None:
    """With the same error for all n points of a cell the variance is n times as large."""
    points, _ = scene(CORNER)
    pixels = CAMERA.project(points.astype(np.float32)) + 0.5
    u, v = np.minimum(pixels // 80, (7, 5)).astype(int).T
    cells = v * 8 + u
    mean = len(points) / 48
    rng = np.random.default_rng(12)
    alone, shared = (
        np.mean(
            [uncertainty(CORNER, SIGMA_M * draw(rng)).noise.diagonal() for _ in range(60)],
            axis=0,
        )
        for draw in (
            lambda rng: rng.normal(size=len(points)),
            lambda rng: rng.normal(size=48)[cells],
        )
    )
    ratios = shared / alone
    assert 0.4 * mean < ratios.min() and ratios.max() < 1.6 * mean


def test_the_scale_of_omega_does_not_matter() -> None:
    """Cost in other units, and the variance that says so: what the ablations `shared` need."""
    points, normals = scene(CORNER)
    rng = np.random.default_rng(13)
    pairs = pairs_of(points, normals, normals, rng.normal(scale=SIGMA_M, size=len(points)))
    t, k = pairs.targets, np.float32(1e5)
    other = replace(
        pairs, covariances=k * pairs.covariances,
        targets=replace(t, perp=k * t.perp, along=k * t.along),
    )  # fmt: skip
    one = pose_uncertainty(registered(pairs), CAMERA)
    two = pose_uncertainty(registered(other), CAMERA, variance=1.0 / float(k))
    for a, b in (
        (one.noise, two.noise), (one.bias, two.bias), (one.information, two.information),
    ):  # fmt: skip
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3 * np.abs(a).max())
    beta2 = [a / b for a, b in (one.bias_evidence, two.bias_evidence)]
    assert beta2[0] == pytest.approx(beta2[1], abs=1e-10)


def biased(beta: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Residuals of the corner by noise and a smooth relative bias of depth."""
    points, normals = scene(CORNER)
    u = (points[:, 0] / points[:, 2] * 525 + 320) / 640
    v = (points[:, 1] / points[:, 2] * 525 + 240) / 480
    field = np.zeros(len(points))
    for p in range(6):
        for q in range(5):
            size = np.sqrt(2.0) ** ((p > 0) + (q > 0)) / max(p * p + q * q, 1)
            field += rng.normal() * size * np.cos(np.pi * p * u) * np.cos(np.pi * q * v)
    d = (normals * points).sum(axis=1)
    return np.asarray(rng.normal(scale=SIGMA_M, size=len(points)) - beta * field * d)


def test_the_bias_is_found_in_what_the_pose_leaves() -> None:
    """beta^2 without the part of the bias that the pose has taken up; 0 on average without any."""
    points, normals = scene(CORNER)
    J = rows(points, normals)
    for beta in (0.0, 0.003):
        rng, sums = np.random.default_rng(14), np.zeros(2)
        for _ in range(60):
            e = biased(beta, rng)
            e -= J @ np.linalg.lstsq(J, e, rcond=None)[0]
            sums += uncertainty(CORNER, e).bias_evidence
        assert sums[0] / sums[1] == pytest.approx(beta**2, rel=0.35, abs=(2e-4) ** 2)


def test_the_bias_moves_the_pose_as_claimed() -> None:
    """Monte Carlo: the pose that biased depth gives scatters with beta^2 times `bias`."""
    points, normals = scene(CORNER)
    J, rng, beta = rows(points, normals), np.random.default_rng(15), 0.003
    poses = [np.linalg.lstsq(J, biased(beta, rng), rcond=None)[0] for _ in range(300)]
    scatter = np.cov(np.array(poses).T)
    claimed = beta**2 * uncertainty(CORNER).bias
    assert 0.7 < np.trace(scatter[:3, :3]) / np.trace(claimed[:3, :3]) < 1.3
    assert 0.7 < np.trace(scatter[3:, 3:]) / np.trace(claimed[3:, 3:]) < 1.3


def test_what_is_left_out_widens_the_claim_and_loosens_its_cross_terms() -> None:
    alone = uncertainty(CORNER)
    claimed = alone.covariance(0.0, 0.0, np.zeros(6))
    np.testing.assert_allclose(claimed[:3, :3], 2.0 * alone.noise[:3, :3])
    np.testing.assert_allclose(claimed[3:, 3:], 2.0 * alone.noise[3:, 3:])
    np.testing.assert_allclose(claimed[:3, 3:], 1.6 * alone.noise[:3, 3:])
    assert np.linalg.eigvalsh(claimed)[0] > 0


def test_depth_that_comes_late_moves_the_pose_by_its_share() -> None:
    """Without an image all of the way; with one less."""
    twist = np.array([0.2, 0.1, -0.3, 0.1, 0.4, 0.2])
    alone = uncertainty(CORNER)
    grown = alone.covariance(0.0, 0.01, twist) - alone.covariance(0.0, 0.0, twist)
    expected = 2.0 * 1e-4 * np.outer(twist, twist)
    expected[:3, 3:] *= 0.8
    expected[3:, :3] *= 0.8
    np.testing.assert_allclose(grown, expected, rtol=1e-3, atol=1e-12)
    held = uncertainty(WALL, image=landmarks())
    follows = held.follows_depth @ np.array([1.0, 0, 0, 0, 0, 0])
    assert abs(follows[0]) < 0.2  # a wall does not see the motion along itself
    assert np.trace(alone.covariance(1e-6, 0.0, twist)) > np.trace(alone.noise)
