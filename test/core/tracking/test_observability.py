# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Hessians of known spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.tracking.observability import observability, pose_covariance

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
    assert result.block_ratio == pytest.approx(30.0, rel=EXACT)


def test_the_block_ratio_does_not_depend_on_the_unit() -> None:
    """Metres and radians mix in kappa; not in the blocks."""
    H, _ = turned(SPECTRUM, seed=6)
    scale = np.diag([100.0] * 3 + [1.0] * 3)
    metres, centimetres = observability(H, H), observability(scale @ H @ scale, scale @ H @ scale)
    assert centimetres.block_ratio == pytest.approx(metres.block_ratio, rel=1e-6)
    assert centimetres.kappa_rotation == pytest.approx(metres.kappa_rotation, rel=1e-6)


@pytest.mark.parametrize('rank', [0, 3, 5])
def test_a_singular_hessian_has_a_large_but_finite_condition(rank: int) -> None:
    spectrum = np.where(np.arange(6) < 6 - rank, 0.0, 1e4)
    H, _ = turned(spectrum, seed=7)
    result = observability(H, H)
    kappas = [result.kappa, result.kappa_without_radius, result.block_ratio]
    assert np.isfinite(kappas).all()
    if rank:
        assert result.kappa > 1e9


def test_covariance_inverts_a_strong_hessian() -> None:
    H, _ = turned(SPECTRUM, seed=8)
    covariance = pose_covariance(H)
    np.testing.assert_allclose(covariance, np.linalg.inv(H), rtol=0, atol=1e-3 / SPECTRUM[0])
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)


def test_covariance_scales_with_the_variance() -> None:
    H, _ = turned(1e6 * SPECTRUM, seed=9)
    np.testing.assert_allclose(pose_covariance(H, 4.0), 4.0 * pose_covariance(H), rtol=1e-5)


def test_what_nothing_constrains_is_bounded() -> None:
    """No information leaves a metre and a radian, not infinity."""
    np.testing.assert_allclose(pose_covariance(np.zeros((6, 6))), np.eye(6))
    spectrum = np.array([0.0, 0.0, 1e6, 1e6, 1e6, 1e6])
    H, axes = turned(spectrum, seed=10)
    covariance = pose_covariance(H)
    for k in range(6):
        expected = 1.0 / (spectrum[k] + 1.0)
        assert axes[:, k] @ covariance @ axes[:, k] == pytest.approx(expected, rel=1e-6)
