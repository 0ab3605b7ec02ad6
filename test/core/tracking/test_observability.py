# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Hessians of known spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.tracking.observability import observability

EXACT = 1e-9  # relative
SPECTRUM = np.array([2e3, 5e3, 1e4, 3e4, 8e4, 4e5])


def turned(
    spectrum: NDArray[np.floating], seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Symmetric matrix of that spectrum and its axes (columns)."""
    n = len(spectrum)
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0]
    matrix = axes @ np.diag(spectrum) @ axes.T
    return 0.5 * (matrix + matrix.T), axes


def blocks(
    translation: NDArray[np.floating], rotation: NDArray[np.floating]
) -> NDArray[np.float64]:
    H = np.zeros((6, 6))
    H[:3, :3], H[3:, 3:] = translation, rotation
    return H


def test_eigenvalues_ascend_and_kappa_is_their_ratio() -> None:
    H, _ = turned(SPECTRUM, seed=1)
    result = observability(H, H)
    np.testing.assert_allclose(result.eigenvalues, SPECTRUM, rtol=EXACT)
    assert result.kappa == pytest.approx(200.0, rel=EXACT)
    assert result.kappa_without_radius == pytest.approx(200.0, rel=EXACT)


def test_the_weakest_direction_is_that_without_the_radius() -> None:
    """What the radius alone holds is not held."""
    H, _ = turned(SPECTRUM, seed=2)
    sharp, axes = turned(SPECTRUM * [1e-3, 1, 1, 1, 1, 1], seed=3)
    result = observability(H, sharp)
    assert abs(result.weakest @ axes[:, 0]) == pytest.approx(1.0, abs=EXACT)
    assert np.linalg.norm(result.weakest) == pytest.approx(1.0, abs=EXACT)
    assert result.kappa == pytest.approx(200.0, rel=EXACT)
    assert result.kappa_without_radius == pytest.approx(2e5, rel=1e-6)


def test_the_blocks_are_translation_and_rotation() -> None:
    """Translation first, as in a twist."""
    translation, _ = turned(np.array([1.0, 2.0, 30.0]), seed=4)
    rotation, _ = turned(np.array([5.0, 6.0, 10.0]), seed=5)
    result = observability(blocks(translation, rotation), blocks(translation, rotation))
    assert result.kappa_translation == pytest.approx(30.0, rel=EXACT)
    assert result.kappa_rotation == pytest.approx(2.0, rel=EXACT)


def test_the_sigmas_are_those_of_the_weakest_directions() -> None:
    """In metres and in radians, each with all that the other leaves open."""
    H, _ = turned(SPECTRUM, seed=6)
    result, covariance = observability(np.eye(6), H), np.linalg.inv(H + np.eye(6))
    for sigma, block in (
        (result.sigma_m, covariance[:3, :3]),
        (result.sigma_rad, covariance[3:, 3:]),
    ):
        directions = np.random.default_rng(7).normal(size=(2000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sampled = np.sqrt(np.einsum('ni,ij,nj->n', directions, block, directions))
        assert sampled.max() <= sigma * (1 + EXACT)
        assert sampled.max() == pytest.approx(sigma, rel=0.02)


def test_what_nothing_holds_is_degenerate() -> None:
    """Below the limit of its own unit; a metre and a radian at most."""
    H = blocks(np.diag([1e6, 1e6, 400.0]), np.diag([1e6, 1e6, 2500.0]))
    result = observability(H, H)
    assert result.sigma_m == pytest.approx(0.05, rel=1e-2)
    assert result.sigma_rad == pytest.approx(0.02, rel=1e-2)
    for limit_m, limit_rad, degenerate in (
        (0.06, 0.03, False),
        (0.04, 0.03, True),
        (0.06, 0.01, True),
    ):
        assert result.is_degenerate(limit_m, limit_rad) == degenerate
    nothing = observability(H, np.zeros((6, 6)))
    assert nothing.sigma_m == nothing.sigma_rad == 1.0


@pytest.mark.parametrize('rank', [0, 3, 5])
def test_a_singular_hessian_has_a_large_but_finite_condition(rank: int) -> None:
    spectrum = np.where(np.arange(6) < 6 - rank, 0.0, 1e4)
    H, _ = turned(spectrum, seed=7)
    result = observability(H, H)
    kappas = [result.kappa, result.kappa_without_radius, result.sigma_m, result.sigma_rad]
    assert np.isfinite(kappas).all()
    if rank:
        assert result.kappa > 1e9
