# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The floor draws drift back, and lets a ramp go."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dcgs_ros.core import se3
from dcgs_ros.core.priors.planar import FloorPrior, on_floor

T_BASE_CAM = np.array(
    [[0, 0, 1, 0.2], [-1, 0, 0, 0.05], [0, -1, 0, 0.5], [0, 0, 0, 1]], np.float64
)
START = se3.exp(np.array([0.3, -0.2, 0.5, 0.4, -0.3, 1.0]))  # of the camera, in any world
FLOOR = on_floor(START, T_BASE_CAM, 0.005, 0.2)


def camera(
    x_m: float, z_m: float, roll_deg: float, pitch_deg: float, yaw_deg: float
) -> NDArray[np.float64]:
    """Return T_world_cam of a base at x, z that is tilted."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(
        'ZYX', [yaw_deg, pitch_deg, roll_deg], degrees=True
    ).as_matrix()
    T[:3, 3] = x_m, 0.4, z_m
    return FLOOR.T_world_floor @ T @ T_BASE_CAM


def residual(T: NDArray[np.float64], floor: FloorPrior = FLOOR) -> NDArray[np.float64]:
    """Return z, roll and pitch of the base, metres and degrees."""
    base = se3.inverse(floor.T_world_floor) @ T @ se3.inverse(T_BASE_CAM)
    _, pitch, roll = Rotation.from_matrix(base[:3, :3]).as_euler('ZYX', degrees=True)
    return np.array([base[2, 3], roll, pitch])


@pytest.mark.parametrize('yaw_deg', [0.0, 75.0, -160.0])
def test_drift_is_taken_back_whatever_the_heading(yaw_deg: float) -> None:
    T = camera(3.0, 0.01, 0.1, -0.15, yaw_deg)
    for _ in range(10):
        equations = FLOOR.normal_equations(T)
        T = T @ se3.exp(np.linalg.solve(equations.H + 1e-3 * np.eye(6), equations.g))
    np.testing.assert_allclose(residual(T), 0.0, atol=1e-4)


def test_it_says_nothing_of_place_and_heading() -> None:
    one, other = camera(0.0, 0.0, 0.0, 0.0, 0.0), camera(5.0, 0.0, 0.0, 0.0, 60.0)
    for T in (one, other):
        equations = FLOOR.normal_equations(T)
        assert equations.cost == pytest.approx(0.0, abs=1e-12)
        assert np.linalg.matrix_rank(equations.H, 1e-3) == 3


def test_the_gradient_is_that_of_the_cost() -> None:
    T, h = camera(1.0, 0.012, 0.3, -0.2, 30.0), 1e-6
    gradient = [
        (FLOOR.normal_equations(T @ se3.exp(h * e)).cost
         - FLOOR.normal_equations(T @ se3.exp(-h * e)).cost) / (2 * h)
        for e in np.eye(6)
    ]  # fmt: skip
    np.testing.assert_allclose(-2.0 * FLOOR.normal_equations(T).g, gradient, rtol=1e-2, atol=5.0)


def test_a_ramp_is_not_flattened() -> None:
    """Images that see a ramp of 5 degrees, to 1 cm and 0.5 degrees, keep it."""
    up = camera(4.0, 0.35, 0.0, -5.0, 0.0)
    images = np.diag(np.repeat([0.01**-2, np.radians(0.5) ** -2], 3))
    T = up
    for _ in range(20):
        floor, xi = FLOOR.normal_equations(T), se3.log(se3.inverse(T) @ up)
        T = T @ se3.exp(np.linalg.solve(floor.H + images, floor.g + images @ xi))
    z_m, _, pitch_deg = residual(T)
    assert z_m == pytest.approx(0.35, abs=0.005)
    assert pitch_deg == pytest.approx(-5.0, abs=0.1)


def test_a_base_upside_down_is_on_no_floor() -> None:
    assert not FLOOR.normal_equations(camera(0.0, 0.0, 180.0, 0.0, 0.0)).H.any()
