# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Residuals and derivatives of a pose graph's edges."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.backend import linearisation
from dcgs_ros.core.backend.edges import Edge, EdgeArrays

STEP = 1e-6


def residual(poses: NDArray[np.float64], T_a_b: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.empty((1, 6))
    edges = EdgeArrays.of([Edge(0, 1, T_a_b, np.eye(6), False)])
    linearisation.residuals(poses, edges.a, edges.b, edges.T_b_a, out)
    return out[0]


def some_poses(seed: int, scale: float = 1.0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return np.array([se3.exp(scale * rng.normal(size=6)) for _ in range(2)])


def test_the_residual_is_the_twist_that_is_missing() -> None:
    poses = some_poses(0)
    missing = np.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.3])
    T_a_b = se3.inverse(poses[0]) @ poses[1] @ se3.inverse(se3.exp(missing))
    np.testing.assert_allclose(residual(poses, T_a_b), missing, atol=1e-12)


@pytest.mark.parametrize('angle', [np.pi - 1e-2, np.pi - 1e-5, np.pi])
def test_a_half_turn_has_a_residual_too(angle: float) -> None:
    """Where the sine no longer gives the axis."""
    for seed in range(5):
        axis = np.random.default_rng(seed).normal(size=3)
        xi = np.concatenate([[0.1, 0.2, 0.3], angle * axis / np.linalg.norm(axis)])
        poses = np.array([np.eye(4), se3.exp(xi)])
        found = residual(poses, np.eye(4))
        np.testing.assert_allclose(se3.exp(found), poses[1], atol=1e-8)
        assert np.linalg.norm(found[3:]) == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize('scale', [1e-9, 1e-3, 0.1, 1.0])
def test_normal_equations_are_those_of_finite_differences(scale: float) -> None:
    """Also for large residuals, where the right Jacobian counts."""
    rng = np.random.default_rng(1)
    poses = some_poses(2)
    T_a_b = se3.inverse(poses[0]) @ poses[1] @ se3.exp(scale * rng.normal(size=6))
    J = np.empty((6, 12))
    for i in range(12):
        ends = []
        for sign in (-1.0, 1.0):
            moved = poses.copy()
            moved[i // 6] = moved[i // 6] @ se3.exp(sign * STEP * np.eye(6)[i % 6])
            ends.append(residual(moved, T_a_b))
        J[:, i] = (ends[1] - ends[0]) / (2 * STEP)
    root = rng.normal(size=(6, 6))
    W = root @ root.T
    edges = EdgeArrays.of([Edge(0, 1, T_a_b, W, False)])
    errors, blocks, gradient = residual(poses, T_a_b)[None], np.zeros((4, 6, 6)), np.zeros((2, 6))
    linearisation.accumulate(
        poses, edges.a, edges.b, errors, edges.information, np.array([0.5]),
        np.array([[0, 1, 2, 3]]), np.arange(2), blocks, gradient,
    )  # fmt: skip
    H = np.block([[blocks[0], blocks[1]], [blocks[2], blocks[3]]])
    np.testing.assert_allclose(H, 0.5 * J.T @ W @ J, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(gradient.ravel(), 0.5 * J.T @ W @ errors[0], rtol=1e-6, atol=1e-6)


def test_chi2_and_step() -> None:
    rng = np.random.default_rng(3)
    errors, root, out = rng.normal(size=(4, 6)), rng.normal(size=(4, 6, 6)), np.empty(4)
    W = root @ root.transpose(0, 2, 1)
    linearisation.chi2(errors, W, out)
    np.testing.assert_allclose(out, np.einsum('ni,nij,nj->n', errors, W, errors))
    poses, moved = some_poses(4), np.empty((2, 4, 4))
    linearisation.step(poses, np.array([-1, 0]), errors[:1], moved)
    np.testing.assert_allclose(moved, [poses[0], poses[1] @ se3.exp(errors[0])])
