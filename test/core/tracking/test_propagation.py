# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Uncertainty over time: what is not measured grows, what is seen again shrinks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.covariances import surer
from dcgs_ros.core.tracking.hosting import Hosts
from dcgs_ros.core.tracking.propagation import BiasVariance, KeyframeChain, MotionLimit

FRAME_NS = 33_333_333
MILLIMETRE2 = np.diag([1e-6] * 6)


def random_covariance(seed: int, scale: float = 1e-3) -> NDArray[np.float64]:
    factor = np.random.default_rng(seed).normal(scale=scale, size=(6, 6))
    return np.asarray(factor @ factor.T + 1e-8 * np.eye(6))


def test_surer_is_below_both_and_equal_to_one_of_them() -> None:
    one, other = random_covariance(1), random_covariance(2)
    least = surer(one, other)
    for covariance in (one, other):
        assert np.linalg.eigvalsh(covariance - least)[0] > -1e-10
    np.testing.assert_allclose(surer(one, 4 * one), one, rtol=1e-4, atol=1e-11)
    np.testing.assert_allclose(surer(4 * one, one), one, rtol=1e-4, atol=1e-11)


def test_surer_takes_each_direction_from_the_one_that_knows_it() -> None:
    one = np.diag([1e-6, 1.0, 1e-6, 1.0, 1e-6, 1.0])
    other = np.diag([1.0, 1e-4, 1.0, 1e-4, 1.0, 1e-4])
    expected = np.diag([1e-6, 1e-4, 1e-6, 1e-4, 1e-6, 1e-4])
    np.testing.assert_allclose(surer(one, other), expected, atol=1e-11)


def test_what_is_measured_has_the_covariance_of_the_measurement() -> None:
    """However long: successive errors are not independent, so their mean is no better."""
    measured = random_covariance(3)
    limit = MotionLimit.begun(measured, np.eye(4), 0)
    for k in range(1, 20):
        limit = limit.updated(measured, np.eye(4), k * FRAME_NS)
        np.testing.assert_allclose(limit.covariance, measured, rtol=1e-6, atol=1e-12)


def test_a_motion_between_measured_poses_is_as_uncertain_as_both() -> None:
    """That of the pose before is along the axes of the last camera: they are turned."""
    measured = random_covariance(3)
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2]))
    limit = MotionLimit.begun(measured, np.eye(4), 0).updated(measured, np.eye(4), FRAME_NS)
    limit = limit.updated(measured, turn, 2 * FRAME_NS)
    Ad = se3.adjoint(se3.inverse(turn))
    both = Ad @ measured @ Ad.T + measured
    np.testing.assert_allclose(limit.motion_covariance, both, rtol=1e-6, atol=1e-12)


def test_a_motion_along_what_no_frame_holds_is_known_better_than_the_poses() -> None:
    """After a second the pose is anywhere within decimetres, but the last step is not."""
    blind = MILLIMETRE2.copy()
    blind[0, 0] = 100.0
    limit = MotionLimit.begun(MILLIMETRE2, np.eye(4), 0)
    limit = limit.updated(MILLIMETRE2, np.eye(4), FRAME_NS)
    for k in range(2, 32):
        limit = limit.updated(blind, np.eye(4), k * FRAME_NS)
    velocity_m = np.sqrt(limit.joint[6, 6]) * FRAME_NS * 1e-9
    assert np.sqrt(limit.covariance[0, 0]) > 0.3
    assert 0.5 * velocity_m < np.sqrt(limit.motion_covariance[0, 0]) < 2.0 * velocity_m < 0.15


def test_what_is_not_measured_grows_until_it_is_again() -> None:
    """Along x nothing is known for 20 frames; the other directions stay as they are."""
    blind = MILLIMETRE2.copy()
    blind[0, 0] = 100.0
    limit = MotionLimit.begun(MILLIMETRE2, np.eye(4), 0)
    limit = limit.updated(MILLIMETRE2, np.eye(4), FRAME_NS)
    sigmas = []
    for k in range(2, 22):
        limit = limit.updated(blind, np.eye(4), k * FRAME_NS)
        sigmas.append(np.sqrt(limit.covariance[0, 0]))
        np.testing.assert_allclose(np.diag(limit.covariance)[1:], 1e-6, rtol=1e-3)
    assert sigmas[0] < 0.02 and 0.2 < sigmas[-1] < 1.0
    assert (np.diff(sigmas) > 0).all()
    limit = limit.updated(MILLIMETRE2, np.eye(4), 22 * FRAME_NS)
    np.testing.assert_allclose(limit.covariance, MILLIMETRE2, rtol=1e-3, atol=1e-12)


def test_growth_is_that_of_random_accelerations() -> None:
    """Monte Carlo of a hand that accelerates anew in each frame, velocity known at first."""
    rng, dt, frames = np.random.default_rng(4), FRAME_NS * 1e-9, 15
    blind = np.diag([100.0] * 6)
    limit = MotionLimit(np.eye(4), 0, 1e-12 * np.eye(12), np.eye(6))
    for k in range(1, frames + 1):
        limit = limit.updated(blind, np.eye(4), k * FRAME_NS)
    velocity, position = np.zeros(4000), np.zeros(4000)
    for _ in range(frames):
        kick = rng.normal(scale=10.0, size=4000)
        position += velocity * dt + 0.5 * dt * dt * kick
        velocity += dt * kick
    assert np.sqrt(limit.covariance[0, 0]) == pytest.approx(position.std(), rel=0.1)
    assert np.sqrt(limit.joint[6, 6]) == pytest.approx(velocity.std(), rel=0.1)


def test_nothing_is_worse_than_a_metre() -> None:
    limit = MotionLimit.begun(1e6 * np.eye(6), np.eye(4), 0)
    for k in range(1, 5):
        assert np.linalg.eigvalsh(limit.covariance)[-1] < 1.0 + 1e-9
        limit = limit.updated(1e6 * np.eye(6), np.eye(4), k * FRAME_NS)


def test_uncertainty_turns_with_the_camera() -> None:
    """The direction that was unknown is the world's, not the camera's."""
    blind = MILLIMETRE2.copy()
    blind[0, 0] = 1.0
    turned = se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    everything_blind = 100 * np.eye(6)
    joint = 1e-12 * np.eye(12)
    joint[:6, :6] = blind
    limit = MotionLimit(np.eye(4), 0, joint, np.eye(6))
    after = limit.updated(everything_blind, turned, FRAME_NS).covariance
    assert after[1, 1] > 0.5 and after[0, 0] < 0.01


def test_the_chain_adds_up_from_keyframe_to_keyframe() -> None:
    """Monte Carlo: each keyframe is placed on the one before."""
    rng, steps = np.random.default_rng(5), 6
    moves = [se3.exp(rng.normal(scale=0.2, size=6)) for _ in range(steps)]
    P = random_covariance(6, 1e-3)
    chain, T = KeyframeChain(), np.eye(4)
    chain.reset(1)
    for k, move in enumerate(moves):
        T = T @ move
        claimed = chain.in_world(T, Hosts.only(k, P))
        chain.add(T, claimed)
    noise = np.random.default_rng(7).multivariate_normal(np.zeros(6), P, (3000, steps))
    errors = []
    for draw in noise:
        T_noisy = np.eye(4)
        for move, xi in zip(moves, draw, strict=True):
            T_noisy = T_noisy @ move @ se3.exp(xi)
        errors.append(se3.log(se3.inverse(T) @ T_noisy))
    sampled = np.cov(np.array(errors).T)
    np.testing.assert_allclose(sampled, claimed, atol=0.1 * np.abs(claimed).max())


def test_back_at_the_first_keyframe_the_world_is_as_certain_as_the_map() -> None:
    chain, P = KeyframeChain(), MILLIMETRE2
    chain.reset(1)
    for k in range(5):
        T = se3.exp(np.array([0.1 * (k + 1), 0, 0, 0, 0, 0]))
        chain.add(T, chain.in_world(T, Hosts.only(k, P)))
    far = chain.in_world(np.eye(4), Hosts.only(5, P))
    half = chain.in_world(
        np.eye(4), Hosts(np.array([0, 5], np.int32), np.tile(0.5 * np.linalg.inv(P), (2, 1, 1)))
    )
    back = chain.in_world(np.eye(4), Hosts.only(0, P))
    np.testing.assert_allclose(back, P, rtol=1e-5)
    assert np.trace(back) < np.trace(half) < np.trace(far)
    assert far[0, 0] == pytest.approx(6e-6)


def test_beta2_is_an_average_that_is_never_negative() -> None:
    bias = BiasVariance()
    assert bias.beta2 == 0.0
    assert bias.observed((-1.0, 1.0)).beta2 == 0.0
    for _ in range(200):
        bias = bias.observed((2e-6, 1.0)).observed((0.0, 1.0))
    assert bias.beta2 == pytest.approx(1e-6, rel=0.05)
