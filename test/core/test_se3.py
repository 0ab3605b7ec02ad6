# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""SE(3): group axioms, round trips, and scipy's matrix exponential."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dcgs_ros.core import se3

EXACT = 1e-11  # of rotations and metres, for twists of a few metres
NEAR_PI = 1e-8  # log there: the axis comes from a square root
ANGLES = {
    'zero': 0.0,
    'tiny': 1e-9,
    'below the series': 0.99e-4,
    'above the series': 1.01e-4,
    'small': 9.9e-3,
    'above the other series': 1.01e-2,
    'generic': 1.3,
    'right angle': math.pi / 2,
    'below near pi': math.pi - 1.01e-3,
    'near pi': math.pi - 0.99e-3,
    'very near pi': math.pi - 1e-9,
}
coordinates = st.floats(-3.0, 3.0)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)
angles = st.one_of(
    st.floats(0.0, 2e-4), st.floats(0.0, math.pi), st.floats(math.pi - 2e-3, math.pi - 1e-9)
)


@st.composite
def twists(draw: st.DrawFn) -> NDArray[np.float64]:
    """Translation of metres, rotation of up to pi about any axis."""
    axis = draw(vectors.filter(lambda v: np.linalg.norm(v) > 0.1))
    return np.concatenate([draw(vectors), draw(angles) * axis / np.linalg.norm(axis)])


def matrix_of(xi: NDArray[np.floating]) -> NDArray[np.float64]:
    """Element of the Lie algebra (4, 4)."""
    generator = np.zeros((4, 4))
    generator[:3, :3] = se3.hat(xi[3:])
    generator[:3, 3] = xi[:3]
    return generator


def twist_of_angle(angle: float, seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])


@given(vectors, vectors)
def test_hat_is_the_cross_product(v: NDArray[np.floating], w: NDArray[np.floating]) -> None:
    np.testing.assert_allclose(se3.hat(v) @ w, np.cross(v, w), atol=EXACT)


@given(twists())
def test_exp_is_a_rigid_motion(xi: NDArray[np.floating]) -> None:
    T = se3.exp(xi)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=EXACT)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=EXACT)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


@given(twists())
def test_exp_is_the_matrix_exponential(xi: NDArray[np.floating]) -> None:
    np.testing.assert_allclose(se3.exp(xi), expm(matrix_of(xi)), atol=EXACT)


@pytest.mark.parametrize('angle', ANGLES.values(), ids=list(ANGLES))
def test_exp_is_the_matrix_exponential_on_both_sides_of_each_series(angle: float) -> None:
    xi = twist_of_angle(angle, seed=1)
    np.testing.assert_allclose(se3.exp(xi), expm(matrix_of(xi)), atol=EXACT)


@pytest.mark.parametrize('angle', ANGLES.values(), ids=list(ANGLES))
def test_log_undoes_exp_on_both_sides_of_each_series(angle: float) -> None:
    xi = twist_of_angle(angle, seed=2)
    tolerance = NEAR_PI if angle > 3.0 else EXACT
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=tolerance)


@given(twists())
def test_log_undoes_exp(xi: NDArray[np.floating]) -> None:
    # Of half a turn there are two logarithms, both right: test_log_of_half_a_turn.
    assume(np.linalg.norm(xi[3:]) < math.pi - 1e-10)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=NEAR_PI)


@given(twists())
def test_exp_undoes_log(xi: NDArray[np.floating]) -> None:
    T = se3.exp(xi)
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=NEAR_PI)


@pytest.mark.parametrize('axis', [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (-1, 2, 3)])
def test_log_of_half_a_turn(axis: tuple[float, float, float]) -> None:
    """Either sense of the axis is right; the angle is pi and exp leads back."""
    u = np.array(axis) / np.linalg.norm(axis)
    T = np.eye(4)
    T[:3, :3] = 2 * np.outer(u, u) - np.eye(3)
    T[:3, 3] = (0.3, -0.2, 0.5)
    xi = se3.log(T)
    assert np.linalg.norm(xi[3:]) == pytest.approx(math.pi, abs=NEAR_PI)
    assert abs(xi[3:] @ u) == pytest.approx(math.pi, abs=NEAR_PI)
    np.testing.assert_allclose(se3.exp(xi), T, atol=NEAR_PI)


@given(twists(), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_motions_along_one_twist_commute_and_add(
    xi: NDArray[np.floating], s: float, t: float
) -> None:
    np.testing.assert_allclose(
        se3.exp(s * xi) @ se3.exp(t * xi), se3.exp((s + t) * xi), atol=EXACT
    )


@given(twists(), twists(), twists())
def test_group_axioms(
    a: NDArray[np.floating], b: NDArray[np.floating], c: NDArray[np.floating]
) -> None:
    A, B, C = se3.exp(a), se3.exp(b), se3.exp(c)
    np.testing.assert_allclose(se3.inverse(A) @ A, np.eye(4), atol=EXACT)
    np.testing.assert_allclose(A @ se3.inverse(A), np.eye(4), atol=EXACT)
    np.testing.assert_allclose(se3.inverse(A), se3.exp(-a), atol=EXACT)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=EXACT)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=EXACT)


def test_inverse_of_a_stack_is_the_stack_of_inverses() -> None:
    rng = np.random.default_rng(3)
    stack = np.array([se3.exp(xi) for xi in rng.normal(size=(6, 6))]).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(se3.inverse(stack), np.linalg.inv(stack), atol=EXACT)
    assert se3.inverse(stack[:0]).shape == (0, 3, 4, 4)


@given(twists(), twists())
def test_adjoint_carries_a_twist_to_the_other_side(
    a: NDArray[np.floating], xi: NDArray[np.floating]
) -> None:
    T = se3.exp(a)
    np.testing.assert_allclose(
        T @ se3.exp(xi) @ se3.inverse(T), se3.exp(se3.adjoint(T) @ xi), atol=10 * EXACT
    )


@given(twists(), twists())
def test_adjoint_is_a_homomorphism(a: NDArray[np.floating], b: NDArray[np.floating]) -> None:
    A, B = se3.exp(a), se3.exp(b)
    np.testing.assert_allclose(
        se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), atol=10 * EXACT
    )


@given(twists())
def test_translation_of_exp_is_the_integral_of_the_turning_velocity(
    xi: NDArray[np.floating],
) -> None:
    """T = integral of R(s phi) rho over s: Gauss-Legendre with 20 nodes is exact here."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    shares = 0.5 * (nodes + 1.0)
    turned = Rotation.from_rotvec(shares[:, None] * xi[3:]).apply(xi[:3])
    np.testing.assert_allclose(se3.exp(xi)[:3, 3], 0.5 * weights @ turned, atol=EXACT)


@given(twists(), st.floats(1e-9, 1e-3))
def test_orthonormalised_removes_scale_and_leaves_rigid_motions(
    xi: NDArray[np.floating], bad: float
) -> None:
    T = se3.exp(xi)
    np.testing.assert_allclose(se3.orthonormalised(T), T, atol=EXACT)
    stretched = T.copy()
    stretched[:3, :3] *= 1.0 + bad
    np.testing.assert_allclose(se3.orthonormalised(stretched), T, atol=EXACT)


def test_stacks_are_as_one_by_one() -> None:
    rng = np.random.default_rng(0)
    T = np.array([se3.exp(xi) for xi in rng.normal(size=(5, 6))])
    np.testing.assert_array_equal(se3.adjoint(T), [se3.adjoint(one) for one in T])
    T[:, :3, :3] *= 1.01
    exact = [se3.orthonormalised(one) for one in T]
    np.testing.assert_array_equal(se3.orthonormalised(T), exact)
    assert se3.adjoint(T[:0]).shape == (0, 6, 6) and len(se3.orthonormalised(T[:0])) == 0


@given(twists())
def test_quaternion_round_trip(xi: NDArray[np.floating]) -> None:
    T = se3.exp(xi)
    quat_wxyz = se3.to_quaternion(T)
    assert quat_wxyz[0] >= 0.0
    assert np.linalg.norm(quat_wxyz) == pytest.approx(1.0, abs=EXACT)
    np.testing.assert_allclose(se3.from_quaternion(quat_wxyz, T[:3, 3]), T, atol=EXACT)


@given(twists())
def test_quaternion_is_the_closed_form(xi: NDArray[np.floating]) -> None:
    angle = float(np.linalg.norm(xi[3:]))
    assume(angle < math.pi - 1e-10)  # of half a turn there are two quaternions
    half_sine = 0.5 * np.sinc(angle / (2 * math.pi))  # sin(angle / 2) / angle
    expected = np.concatenate([[math.cos(angle / 2)], half_sine * xi[3:]])
    np.testing.assert_allclose(se3.to_quaternion(se3.exp(xi)), expected, atol=NEAR_PI)


def test_quaternions_of_stacks() -> None:
    rng = np.random.default_rng(4)
    stack = np.array([se3.exp(xi) for xi in rng.normal(size=(6, 6))]).reshape(2, 3, 4, 4)
    quat_wxyz = se3.to_quaternion(stack)
    assert quat_wxyz.shape == (2, 3, 4)
    np.testing.assert_allclose(quat_wxyz[1, 2], se3.to_quaternion(stack[1, 2]), atol=EXACT)
    np.testing.assert_allclose(
        se3.from_quaternion(quat_wxyz, stack[..., :3, 3]), stack, atol=EXACT
    )
    assert se3.from_quaternion(np.empty((0, 4)), np.empty((0, 3))).shape == (0, 4, 4)
    assert se3.to_quaternion(np.empty((0, 4, 4))).shape == (0, 4)


def test_transform_maps_points_as_the_homogeneous_product_does() -> None:
    rng = np.random.default_rng(11)
    T, points = se3.exp(rng.normal(size=6)), rng.normal(size=(7, 3))
    expected = np.column_stack([points, np.ones(7)]) @ T.T
    np.testing.assert_allclose(se3.transform(T, points), expected[:, :3], atol=1e-14)
    np.testing.assert_allclose(
        se3.transform(se3.inverse(T), se3.transform(T, points)), points, atol=1e-13
    )
