# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Normal equations against finite differences and dense algebra."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.tracking.factors import (
    NormalEquations,
    PointFactors,
    PosePrior,
    Targets,
    observed_from,
)

STEP = 1e-6  # of central differences
FINITE_DIFFERENCE = 1e-6  # relative
DENSE = 1e-6  # relative: points and covariances are float32
EXACT = 1e-9  # relative, float64 throughout
T_WORLD_CAM = se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.8, 0.5]))
HOST = np.zeros(1, np.int32)


def spd(rng: np.random.Generator, count: int, sigma_m: float) -> NDArray[np.float64]:
    """Random positive definite matrices (N, 3, 3) of about sigma^2."""
    factors = rng.normal(scale=sigma_m, size=(count, 3, 3))
    return factors @ factors.transpose(0, 2, 1) + 0.05 * sigma_m**2 * np.eye(3)


def unit(vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def make_pairs(
    seed: int, count: int = 40, sigma_m: float = 0.02, error_m: float = 0.02
) -> PointFactors:
    """Pairs of points about 2 m before the camera, off by `error_m`."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-1, -1, 1), (1, 1, 3), (count, 3))
    world = points @ T_WORLD_CAM[:3, :3].T + T_WORLD_CAM[:3, 3]
    targets = Targets(
        (world + rng.normal(scale=error_m, size=(count, 3))).astype(np.float32),
        unit(rng.normal(size=(count, 3))).astype(np.float32),
        rng.uniform(0.1, 2, count).astype(np.float32) * np.float32(sigma_m**2),
        rng.uniform(0.1, 2, count).astype(np.float32) * np.float32(sigma_m**2),
        np.zeros(count, np.int32),
    )
    rows, columns = np.triu_indices(3)
    covariances = spd(rng, count, sigma_m)[:, rows, columns].astype(np.float32)
    normals = unit(rng.normal(size=(count, 3))).astype(np.float32)
    return PointFactors(points.astype(np.float32), covariances, targets, normals)


def full(scalars: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N, 6) xx xy xz yy yz zz to (N, 3, 3)."""
    rows, columns = np.triu_indices(3)
    matrices = np.zeros((len(scalars), 3, 3))
    matrices[:, rows, columns] = matrices[:, columns, rows] = scalars
    return matrices


def omegas(pairs: PointFactors, T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Omega_i = Sigma_i + R D_i R^T (N, 3, 3), the paper's, in the world."""
    R, t = T[:3, :3], pairs.targets
    u = t.axes.astype(np.float64)
    along = u[:, :, None] * u[:, None, :]
    sigma = t.perp[:, None, None] * (np.eye(3) - along) + t.along[:, None, None] * along
    return sigma + R @ full(pairs.covariances) @ R.T


def residuals(pairs: PointFactors, T: NDArray[np.float64]) -> NDArray[np.float64]:
    """d_i = mu_i - T a_i (N, 3), the paper's, in the world."""
    moved = pairs.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    difference: NDArray[np.float64] = pairs.targets.points.astype(np.float64) - moved
    return difference


def squares(d: NDArray[np.floating], omega: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.einsum('ij,ij->i', d, np.linalg.solve(omega, d[:, :, None])[:, :, 0])


def huber(square: NDArray[np.floating], delta: float) -> NDArray[np.float64]:
    """Return rho(s): s inside delta^2, 2 delta sqrt(s) - delta^2 beyond."""
    beyond = square > delta**2
    return np.where(beyond, 2 * min(delta, 1e6) * np.sqrt(square) - min(delta, 1e6) ** 2, square)


def cost_at(pairs: PointFactors, xi: NDArray[np.floating], omega: NDArray[np.floating]) -> float:
    """E(T exp(xi)) with the Omega held."""
    square = squares(residuals(pairs, T_WORLD_CAM @ se3.exp(xi)), omega)
    return pairs.weight * float(huber(square, pairs.huber).sum())


def jacobian(pairs: PointFactors) -> NDArray[np.float64]:
    """Derivative (N, 3, 6) of -d_i by the twist on the right, by central differences."""
    columns = []
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = STEP
        ahead = residuals(pairs, T_WORLD_CAM @ se3.exp(xi))
        behind = residuals(pairs, T_WORLD_CAM @ se3.exp(-xi))
        columns.append((behind - ahead) / (2 * STEP))
    return np.stack(columns, axis=2)


@pytest.mark.parametrize('delta', [math.inf, 1.5])
@pytest.mark.parametrize('weight', [1.0, 0.3])
def test_gradient_is_that_of_the_cost(delta: float, weight: float) -> None:
    """DE/dxi = -2 g at xi = 0, also where Huber's kernel bends."""
    pairs = replace(make_pairs(seed=1), huber=delta, weight=weight)
    omega, equations = omegas(pairs, T_WORLD_CAM), pairs.normal_equations(T_WORLD_CAM)
    steps = STEP * np.eye(6)
    gradient = np.array(
        [(cost_at(pairs, xi, omega) - cost_at(pairs, -xi, omega)) / (2 * STEP) for xi in steps]
    )
    np.testing.assert_allclose(
        -2 * equations.g, gradient, atol=FINITE_DIFFERENCE * np.abs(gradient).max() * 10
    )
    assert equations.cost == pytest.approx(cost_at(pairs, np.zeros(6), omega), rel=DENSE)
    beyond = squares(residuals(pairs, T_WORLD_CAM), omega) > delta**2
    assert beyond.any() == math.isfinite(delta) and not beyond.all()


@pytest.mark.parametrize('delta', [math.inf, 1.5])
@pytest.mark.parametrize('weight', [1.0, 0.3])
def test_hessian_is_dense_algebra(delta: float, weight: float) -> None:
    """H = sum w rho'(s) J^T Omega^-1 J with J by finite differences."""
    pairs = replace(make_pairs(seed=2), huber=delta, weight=weight)
    omega, J = omegas(pairs, T_WORLD_CAM), jacobian(pairs)
    d = residuals(pairs, T_WORLD_CAM)
    square = squares(d, omega)
    slope = np.minimum(1.0, delta / np.sqrt(square))
    W = (weight * slope)[:, None, None] * np.linalg.inv(omega)
    H = np.einsum('nij,nik,nkl->jl', J, W, J)
    g = np.einsum('nij,nik,nk->j', J, W, d)
    equations = pairs.normal_equations(T_WORLD_CAM)
    np.testing.assert_allclose(equations.H, H, atol=DENSE * np.abs(H).max())
    np.testing.assert_allclose(equations.g, g, atol=DENSE * np.abs(g).max() * 10)
    np.testing.assert_allclose(equations.H, equations.H.T)
    np.testing.assert_allclose(pairs.chi2(T_WORLD_CAM), square, rtol=1e-4)


def test_cost_grows_linearly_beyond_delta() -> None:
    """One pair, isotropic, pulled away: E = 2 delta |d| / sigma - delta^2."""
    sigma_m, delta = 0.01, 2.0
    covariances = np.array([[0.5, 0, 0, 0.5, 0, 0.5]], np.float32) * np.float32(sigma_m**2)
    half = np.array([0.5 * sigma_m**2], np.float32)
    for pull in (0.5, 1.9, 2.1, 10.0, 100.0):
        target = np.array([[pull * sigma_m, 0, 2]], np.float32)
        targets = Targets(target, np.array([[0, 0, 1]], np.float32), half, half, HOST)
        pairs = PointFactors(np.array([[0, 0, 2]], np.float32), covariances, targets, huber=delta)
        expected = pull**2 if pull < delta else 2 * delta * pull - delta**2
        equations = pairs.normal_equations(np.eye(4))
        assert equations.cost == pytest.approx(expected, rel=1e-4)
        force = min(pull, delta) / sigma_m
        assert equations.g[0] == pytest.approx(force, rel=1e-4)


def test_cost_does_not_depend_on_the_world(seed: int = 3) -> None:
    """Turning and shifting world and pose together leaves E, H and g as they are."""
    pairs = make_pairs(seed)
    T = se3.exp(np.array([0.3, 0.2, -0.5, 1.0, 0.4, -0.2]))
    t = pairs.targets
    turned = replace(
        t,
        points=(t.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
        axes=(t.axes @ T[:3, :3].T).astype(np.float32),
    )
    one = pairs.normal_equations(T_WORLD_CAM)
    other = replace(pairs, targets=turned).normal_equations(T @ T_WORLD_CAM)
    assert other.cost == pytest.approx(one.cost, rel=1e-4)
    np.testing.assert_allclose(other.H, one.H, atol=1e-4 * np.abs(one.H).max())
    np.testing.assert_allclose(other.g, one.g, atol=1e-4 * np.abs(one.g).max())


def test_what_has_no_target_does_not_count() -> None:
    pairs = make_pairs(seed=4)
    keep = np.arange(len(pairs.points)) % 3 != 0
    t = pairs.targets
    perp = np.where(keep, t.perp, -1).astype(np.float32)
    points = np.where(keep[:, None], t.points, np.nan).astype(np.float32)
    masked = replace(pairs, targets=replace(t, points=points, perp=perp))
    assert pairs.normals is not None
    kept = PointFactors(pairs.points[keep], pairs.covariances[keep], t[keep], pairs.normals[keep])
    for one, other in (
        (masked.normal_equations(T_WORLD_CAM), kept.normal_equations(T_WORLD_CAM)),
        (masked.along_normals(T_WORLD_CAM), kept.along_normals(T_WORLD_CAM)),
    ):
        np.testing.assert_allclose(one.H, other.H, rtol=EXACT)
        np.testing.assert_allclose(one.g, other.g, rtol=EXACT)
        assert one.cost == pytest.approx(other.cost)
    chi2 = masked.chi2(T_WORLD_CAM)
    np.testing.assert_array_equal(np.isnan(chi2), ~keep)


def test_no_pairs_say_nothing() -> None:
    equations = make_pairs(seed=5, count=0).normal_equations(T_WORLD_CAM)
    assert not equations.H.any() and not equations.g.any() and equations.cost == 0.0


def test_along_normals_is_point_to_plane() -> None:
    """Scalar residuals n . R^T d with variance n . R^T Omega R n."""
    pairs = make_pairs(seed=6)
    assert pairs.normals is not None
    n = pairs.normals.astype(np.float64) @ T_WORLD_CAM[:3, :3].T
    J, d = jacobian(pairs), residuals(pairs, T_WORLD_CAM)
    variance = np.einsum('ni,nij,nj->n', n, omegas(pairs, T_WORLD_CAM), n)
    rows, r = np.einsum('ni,nij->nj', n, J), np.einsum('ni,ni->n', n, d)
    H = (rows / variance[:, None]).T @ rows
    equations = pairs.along_normals(T_WORLD_CAM)
    np.testing.assert_allclose(equations.H, H, atol=DENSE * np.abs(H).max())
    g = (rows / variance[:, None]).T @ r
    np.testing.assert_allclose(equations.g, g, atol=DENSE * np.abs(g).max() * 10)
    assert equations.cost == pytest.approx(float((r**2 / variance).sum()), rel=1e-5)


def test_along_normals_is_what_an_unbounded_radius_leaves() -> None:
    """D + r^2 (I - n n^T) with r to infinity."""
    pairs = make_pairs(seed=7)
    assert pairs.normals is not None
    x, y, z = pairs.normals.T
    tangential = np.column_stack([1 - x * x, -x * y, -x * z, 1 - y * y, -y * z, 1 - z * z])
    # In float64: the kernel takes both, and float32 would drown D in r^2.
    covariances: NDArray[np.floating] = pairs.covariances + 10.0 * tangential.astype(np.float64)
    wide = replace(pairs, covariances=covariances)
    sharp, limit = pairs.along_normals(T_WORLD_CAM), wide.normal_equations(T_WORLD_CAM)
    np.testing.assert_allclose(limit.H, sharp.H, atol=1e-3 * np.abs(sharp.H).max())
    np.testing.assert_allclose(limit.g, sharp.g, atol=1e-3 * np.abs(sharp.g).max())


def test_across_rays_keeps_what_the_image_says() -> None:
    """A pull along the ray is forgotten, one across it is felt as before."""
    points = np.array([[0.3, -0.2, 2.0]], np.float32)
    ray = unit(points)[0]
    across = np.cross(ray, [0, 1, 0])
    across /= np.linalg.norm(across)
    covariances = np.array([[1, 0, 0, 1, 0, 1]], np.float32) * np.float32(1e-4)
    zero = np.zeros(1, np.float32)
    for direction, share in ((ray, 0.0), (across, 1.0)):
        target = (points + 0.05 * direction).astype(np.float32)
        pairs = PointFactors(
            points,
            covariances,
            Targets(target, np.array([[0, 0, 1]], np.float32), zero, zero, HOST),
        )
        before = pairs.normal_equations(np.eye(4)).cost
        after = pairs.across_rays().normal_equations(np.eye(4)).cost
        assert after == pytest.approx(share * before, abs=1e-3 * before)


def random_equations(seed: int) -> NormalEquations:
    """Well-posed system whose cost is never negative."""
    rng = np.random.default_rng(seed)
    J, e = rng.normal(size=(30, 6)), rng.normal(size=30)
    return NormalEquations(J.T @ J, J.T @ e, float(e @ e))


def test_limited_marginalises_a_common_motion() -> None:
    """Schur complement of the 12x12 system in (pose, common motion of covariance Q)."""
    equations, rng = random_equations(seed=8), np.random.default_rng(9)
    factor = rng.normal(scale=0.3, size=(6, 6))
    Q = factor @ factor.T + 1e-3 * np.eye(6)
    joint = np.block([[equations.H, equations.H], [equations.H, equations.H + np.linalg.inv(Q)]])
    right = np.concatenate([equations.g, equations.g])
    gain = joint[:6, 6:] @ np.linalg.inv(joint[6:, 6:])
    limited = equations.limited(Q)
    np.testing.assert_allclose(limited.H, joint[:6, :6] - gain @ joint[6:, :6], atol=EXACT)
    np.testing.assert_allclose(limited.g, right[:6] - gain @ right[6:], atol=EXACT)
    minimum = equations.cost - right[6:] @ np.linalg.solve(joint[6:, 6:], right[6:])
    assert limited.cost == pytest.approx(minimum, rel=EXACT)


def test_limited_is_never_surer_than_q_and_finds_the_same_pose() -> None:
    equations = random_equations(seed=10)
    Q = np.diag([1e-2, 2e-2, 3e-2, 1e-3, 2e-3, 3e-3])
    limited = equations.limited(Q)
    covariance = np.linalg.inv(limited.H)
    np.testing.assert_allclose(covariance, np.linalg.inv(equations.H) + Q, rtol=1e-7)
    np.testing.assert_allclose(
        np.linalg.solve(limited.H, limited.g), np.linalg.solve(equations.H, equations.g)
    )
    np.testing.assert_allclose(equations.limited(np.zeros((6, 6))).H, equations.H)


def test_limited_pairs_are_limited_equations() -> None:
    pairs, Q = make_pairs(seed=11), np.diag([1e-6] * 3 + [1e-7] * 3)
    limited = replace(pairs, Q=Q).normal_equations(T_WORLD_CAM)
    expected = pairs.normal_equations(T_WORLD_CAM).limited(Q)
    np.testing.assert_allclose(limited.H, expected.H)
    np.testing.assert_allclose(limited.g, expected.g)


def sure_equations(seed: int) -> NormalEquations:
    """Return equations beside which what keeps an empty system solvable does not count."""
    random = random_equations(seed)
    return NormalEquations(1e6 * random.H, 1e6 * random.g, 1e6 * random.cost)


def test_terms_are_apart_by_the_way_between_their_minima() -> None:
    """Marginalised over the pose; there both terms are at their own minimum."""
    one, other = sure_equations(seed=15), sure_equations(seed=16)
    apart = one.apart_from(other)
    delta = np.linalg.solve(one.H, one.g) - np.linalg.solve(other.H, other.g)
    np.testing.assert_allclose(np.linalg.solve(apart.H, apart.g), delta, rtol=1e-4)
    covariance = np.linalg.inv(one.H) + np.linalg.inv(other.H)
    np.testing.assert_allclose(np.linalg.inv(apart.H), covariance, rtol=1e-4, atol=1e-10)
    lowest = sum(e.cost - e.g @ np.linalg.solve(e.H, e.g) for e in (one, other))
    assert apart.cost - apart.g @ delta == pytest.approx(lowest, rel=1e-4)


def test_along_what_one_term_leaves_open_nothing_is_apart() -> None:
    held, other = np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 0.0]), sure_equations(seed=17)
    one = NormalEquations(held, held @ np.ones(6), 1e6)
    for apart in (one.apart_from(other), other.apart_from(one)):
        np.testing.assert_allclose(apart.H[5], 0.0, atol=2.0)
        assert apart.g[5] == pytest.approx(0.0, abs=2.0)


def test_terms_add() -> None:
    one, other = random_equations(seed=12), random_equations(seed=13)
    total = one + other
    np.testing.assert_array_equal(total.H, one.H + other.H)
    np.testing.assert_array_equal(total.g, one.g + other.g)
    assert total.cost == one.cost + other.cost


def test_step_solves_the_damped_system() -> None:
    equations = random_equations(seed=14)
    np.testing.assert_allclose(equations.H @ equations.step(0.0), equations.g, atol=1e-7)
    damped = equations.H + 0.5 * np.diag(np.diag(equations.H))
    np.testing.assert_allclose(damped @ equations.step(0.5), equations.g, atol=1e-7)


def test_step_stands_still_where_nothing_is_known() -> None:
    np.testing.assert_array_equal(
        NormalEquations(np.zeros((6, 6)), np.zeros(6), 0.0).step(1e-3), 0.0
    )


def test_prior_pulls_to_its_pose() -> None:
    """One undamped step from a near pose arrives; the cost is the squared Mahalanobis distance."""
    xi = np.array([0.01, -0.02, 0.015, 0.004, 0.003, -0.002])
    prior = PosePrior(T_WORLD_CAM @ se3.exp(xi), 0.02, 0.005)
    equations = prior.normal_equations(T_WORLD_CAM)
    reached = T_WORLD_CAM @ se3.exp(equations.step(0.0))
    np.testing.assert_allclose(reached, prior.T_world_cam, atol=1e-6)
    expected = (xi[:3] ** 2).sum() / 0.02**2 + (xi[3:] ** 2).sum() / 0.005**2
    assert equations.cost == pytest.approx(expected)
    np.testing.assert_allclose(
        np.linalg.inv(equations.H), np.diag([0.02**2] * 3 + [0.005**2] * 3), rtol=EXACT
    )
    at_rest = prior.normal_equations(prior.T_world_cam)
    assert at_rest.cost == pytest.approx(0, abs=EXACT)
    np.testing.assert_allclose(at_rest.g, 0, atol=1e-6)


def test_observed_from_is_the_tracking_covariance() -> None:
    """Axes along the rays from the viewpoint, z p / f across them, sigma_z along them."""
    rng, sensor = np.random.default_rng(15), SensorNoise.structured_light()
    points = rng.uniform(-1, 1, (20, 3)).astype(np.float32)
    viewpoints = rng.uniform(2, 3, (20, 3)).astype(np.float32)
    targets = observed_from(
        points, viewpoints, sensor, 0.5 / 525.0, np.zeros(len(points), np.int32)
    )
    rays = points.astype(np.float64) - viewpoints
    ranges = np.linalg.norm(rays, axis=1)
    along = (targets.along - targets.perp)[:, None, None] * (
        targets.axes[:, :, None] * targets.axes[:, None, :]
    )
    found = targets.perp[:, None, None] * np.eye(3) + along
    expected = sensor.covariance(rays / ranges[:, None], ranges, 0.5, 525.0)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
