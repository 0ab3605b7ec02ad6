# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tests of the depth bias that is estimated while tracking."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.depth_bias import DepthBias
from dcgs_ros.core.tracking.factors import NormalEquations, PointFactors, Targets
from dcgs_ros.core.tracking.registration import Registration

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
SIGMA = 0.01
NOISE_M = 0.002
THETA = np.array([0.008, -0.006, 0.01, -0.015, 0.012])
CLOSE = 0.003  # of an estimate from twelve intervals
FAR_OFF = 0.03  # by which a pose may be off, metres and radians: the estimate does not care


def bias_at(points: NDArray[np.floating], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the relative error of depth at points (N, 3) of the camera frame."""
    half = 0.5 * np.array([CAMERA.width / CAMERA.fx, CAMERA.height / CAMERA.fy])
    x, y = (points[:, :2] / points[:, 2:] / half).T
    result: NDArray[np.float64] = (
        np.column_stack([x, y, x * y, x * x - 1 / 3, y * y - 1 / 3]) @ theta
    )
    return result


def registration(
    rng: np.random.Generator, host: int, T_world_host: NDArray[np.float64],
    theta: NDArray[np.float64], known: NDArray[np.float64], with_image: bool = True,
) -> Registration:  # fmt: skip
    """Surfaces in all directions, seen from a keyframe and from a pose beside it.

    Both times depth is wrong by `theta` and corrected by what is `known` of it.
    """
    n = 600
    there = rng.uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.0), (n, 3)) * rng.uniform(1, 3, (n, 1))
    motion = se3.exp(rng.normal(scale=0.15, size=6))  # T_host_cam
    here = se3.transform(se3.inverse(motion), there)
    T = T_world_host @ motion @ se3.exp(rng.uniform(-FAR_OFF, FAR_OFF, 6) / np.sqrt(6))
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    left = theta - known
    noise = [rng.normal(scale=NOISE_M, size=(n, 3)) for _ in range(2)]
    mu = there * (1 + bias_at(there, left))[:, None] + noise[0]
    a = here * (1 + bias_at(here, left))[:, None] + noise[1]
    variance = np.full(n, NOISE_M**2, np.float32)
    targets = Targets(
        se3.transform(T_world_host, mu).astype(np.float32),
        np.tile(np.array([0, 0, 1], np.float32), (n, 1)), variance, variance,
        np.full(n, host, np.int32),
    )  # fmt: skip
    covariances = np.tile(np.array([1, 0, 0, 1, 0, 1], np.float32) * variance[0], (n, 1))
    pairs = PointFactors(
        a.astype(np.float32), covariances, targets, normals.astype(np.float32),
        normals.astype(np.float32),
    )  # fmt: skip
    image = PointFactors(pairs.points, covariances, targets) if with_image else None
    nothing = NormalEquations(np.zeros((6, 6)), np.zeros(6), 0.0)
    return Registration(T, pairs, image, nothing, nothing, nothing, n, 1.0)


def after(
    thetas: list[NDArray[np.float64]], sigma: float = SIGMA, with_image: bool = True
) -> DepthBias:
    """Track some frames after each of several keyframes; theta is another one in each interval."""
    rng = np.random.default_rng(3)
    bias = DepthBias(CAMERA, sigma)
    for host, theta in enumerate(thetas):
        T_world_host = se3.exp(rng.normal(scale=0.5, size=6))
        bias.add_keyframe(T_world_host)
        for _ in range(3):
            bias.observe(registration(rng, host, T_world_host, theta, bias.theta, with_image))
    bias.add_keyframe(np.eye(4))
    return bias


@pytest.mark.parametrize('with_image', [True, False])
def test_the_bias_is_found_whatever_the_poses_are(with_image: bool) -> None:
    """Corrected depth goes on telling of all of it, not of what is left."""
    bias = after([THETA] * 12, with_image=with_image)
    np.testing.assert_allclose(bias.theta, THETA, atol=CLOSE)


def test_depth_is_divided_by_it() -> None:
    bias = after([THETA] * 12)
    depth_m = np.full((120, 160), 2.0, np.float32)
    frame = RgbdFrame(0, 0, np.zeros((120, 160), np.uint8), depth_m)
    rays = np.append(CAMERA.undistort(np.array([[140.0, 20.0]]))[0], 1.0)[None]
    expected = 2.0 / (1 + bias_at(rays, bias.theta)[0])
    assert bias.corrected(frame).depth_m[20, 140] == pytest.approx(expected, rel=1e-5)
    assert bias.corrected(frame).depth_m.dtype == np.float32


def test_intervals_that_disagree_tell_nothing() -> None:
    rng = np.random.default_rng(9)
    bias = after([rng.normal(scale=0.03, size=5) for _ in range(12)])
    assert np.abs(bias.theta).max() < SIGMA


def test_few_intervals_tell_nothing() -> None:
    assert not after([THETA] * 4).theta.any()


def test_a_calibrated_camera_is_left_alone() -> None:
    bias = after([THETA] * 12, sigma=0.0)
    frame = RgbdFrame(0, 0, np.zeros((120, 160), np.uint8), np.ones((120, 160), np.float32))
    assert bias.corrected(frame) is frame


def test_keyframes_of_another_map_are_not_compared_with() -> None:
    """What depth was corrected by there is not known."""
    rng = np.random.default_rng(5)
    bias = DepthBias(CAMERA, SIGMA)
    bias.reset([np.eye(4)])
    for _ in range(12):
        bias.observe(registration(rng, 0, np.eye(4), THETA, bias.theta))
        bias.add_keyframe(np.eye(4))
    assert not bias.theta.any()
