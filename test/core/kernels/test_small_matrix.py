# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Inverse and eigenvectors of symmetric 3x3 matrices, and small systems, against numpy."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.kernels.small_matrix import (
    eigenvalues_symmetric,
    inverse_symmetric,
    smallest_eigenvector,
    solve,
)

INVERSE = 1e-7  # relative: a needle's determinant loses its condition number twice
EIGENVALUE = 1e-14  # of the largest eigenvalue, apart from the degenerate
DEGENERATE = 1e-7  # where eigenvalues meet the cubic's roots lose half the digits
SOLVED = 1e-13
SCALES = [1e-8, 1.0, 1e6]
UPPER = np.triu_indices(3)


@numba.njit
def inverted(m):
    return inverse_symmetric(m[0], m[1], m[2], m[3], m[4], m[5])


@numba.njit
def eigenvalues(m):
    return eigenvalues_symmetric(m[0], m[1], m[2], m[3], m[4], m[5])


@numba.njit
def weakest(m, smallest):
    return smallest_eigenvector(m[0], m[1], m[2], m[3], m[4], m[5], smallest)


def with_spectrum(spectrum: tuple[float, float, float], seed: int) -> NDArray[np.float64]:
    """Build a matrix (3, 3) with those eigenvalues and random axes."""
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    matrix = axes @ np.diag(spectrum) @ axes.T
    return 0.5 * (matrix + matrix.T)


def full(scalars: NDArray[np.floating]) -> NDArray[np.float64]:
    matrix = np.zeros((3, 3))
    matrix[UPPER] = scalars
    return matrix + np.triu(matrix, 1).T


@pytest.mark.parametrize('scale', SCALES)
@pytest.mark.parametrize('spectrum', [(1, 1, 1), (3, 2, 1), (1, 1, 1e-4), (1, 1e-4, 1e-4)])
def test_inverse_is_numpys(spectrum: tuple[float, float, float], scale: float) -> None:
    for seed in range(20):
        matrix = scale * with_spectrum(spectrum, seed)
        expected = np.linalg.inv(matrix)
        error = np.abs(full(np.array(inverted(matrix[UPPER]))) - expected).max()
        assert error <= INVERSE * np.abs(expected).max()


@pytest.mark.parametrize('scale', SCALES)
@pytest.mark.parametrize(
    ('spectrum', 'tolerance'),
    [
        ((3, 2, 1), 10 * EIGENVALUE),
        ((5, 1, -2), 10 * EIGENVALUE),
        ((1, 0.5, 1e-6), 10 * EIGENVALUE),
        ((1, 1e-3, 1e-6), 10 * EIGENVALUE),
        ((1, 1, 1e-3), DEGENERATE),
        ((1, 1e-3, 1e-3), DEGENERATE),
        ((1, 1, 0), DEGENERATE),
        ((1, 0, 0), DEGENERATE),
        ((1, 1, 1), DEGENERATE),
        ((1, 1, 1 - 1e-9), DEGENERATE),
        ((0, 0, 0), 0.0),
    ],
)
def test_eigenvalues_are_numpys(
    spectrum: tuple[float, float, float], tolerance: float, scale: float
) -> None:
    for seed in range(20):
        matrix = scale * with_spectrum(spectrum, seed)
        found = np.array(eigenvalues(matrix[UPPER]))
        expected = np.linalg.eigvalsh(matrix)[::-1]
        assert np.abs(found - expected).max() <= tolerance * scale * max(np.abs(spectrum))


@pytest.mark.parametrize('scale', SCALES)
@pytest.mark.parametrize(
    'spectrum',
    [(3, 2, 1), (1, 1, 1e-3), (1, 1, 0), (1, 0.3, 0), (1, 0.01, 1e-4), (1, 1 - 1e-9, 0.5)],
)
def test_smallest_eigenvector_is_one(spectrum: tuple[float, float, float], scale: float) -> None:
    """Unit, and M v = lambda v, also where the other two eigenvalues are alike."""
    for seed in range(20):
        matrix = scale * with_spectrum(spectrum, seed)
        smallest = eigenvalues(matrix[UPPER])[2]
        v = np.array(weakest(matrix[UPPER], smallest))
        assert np.linalg.norm(v) == pytest.approx(1.0, abs=1e-12)
        residual = matrix @ v - np.linalg.eigvalsh(matrix)[0] * v
        assert np.abs(residual).max() <= DEGENERATE * scale * max(np.abs(spectrum))


@pytest.mark.parametrize('value', [0.0, 2.5])
def test_where_all_directions_are_alike_one_is_given(value: float) -> None:
    isotropic = value * np.eye(3)[UPPER]
    assert eigenvalues(isotropic) == (value, value, value)
    assert np.linalg.norm(weakest(isotropic, value)) == pytest.approx(1.0)


@pytest.mark.parametrize('axis', range(3))
def test_axes_of_a_diagonal_matrix(axis: int) -> None:
    diagonal = np.full(3, 2.0)
    diagonal[axis] = 0.5
    found = weakest(np.diag(diagonal)[UPPER], 0.5)
    np.testing.assert_allclose(np.abs(found), np.eye(3)[axis], atol=1e-12)


@pytest.mark.parametrize('size', [1, 2, 6])
def test_a_system_is_solved(size: int) -> None:
    rng = np.random.default_rng(size)
    A, B = rng.normal(size=(size, size)), rng.normal(size=(size, 3))
    X = B.copy()
    solve(A.copy(), X)
    np.testing.assert_allclose(A @ X, B, atol=SOLVED)


def test_a_zero_on_the_diagonal_is_no_obstacle() -> None:
    X = np.array([[2.0], [3.0]])
    solve(np.array([[0.0, 1.0], [1.0, 0.0]]), X)
    np.testing.assert_array_equal(X, [[3.0], [2.0]])


def test_a_singular_system_has_no_finite_solution() -> None:
    X = np.ones((2, 1))
    solve(np.ones((2, 2)), X)
    assert not np.isfinite(X).all()
