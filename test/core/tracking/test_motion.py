# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Prediction, motion between two stamps, and the offset between colour and depth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config.stages import TimingConfig
from dcgs_ros.core.tracking.factors import NormalEquations
from dcgs_ros.core.tracking.motion import ColorDepthOffset, ConstantVelocity

EXACT = 1e-9  # metres and radians: stamps are whole nanoseconds
OFFSET_S = 1e-4  # how near to the truth a noise-free estimate comes against its prior
FRAME_NS = 33_333_333
START_NS = 5_000_000_000
T_START = se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.8, 0.5]))
TWIST = np.array([0.3, -0.2, 0.5, 0.4, 0.8, -0.6])  # per second


def seconds(stamp_ns: int) -> float:
    return (stamp_ns - START_NS) * 1e-9


def on_twist(stamp_ns: int) -> NDArray[np.float64]:
    return T_START @ se3.exp(TWIST * seconds(stamp_ns))


def moving_on_twist() -> tuple[ConstantVelocity, int]:
    """Three frames along a constant twist, at uneven intervals."""
    stamp = START_NS
    motion = ConstantVelocity.at_rest(T_START, stamp)
    for step in (FRAME_NS, 2 * FRAME_NS, FRAME_NS // 2):
        stamp += step
        motion = motion.advanced(on_twist(stamp), stamp)
    return motion, stamp


@pytest.mark.parametrize('ahead_ns', [FRAME_NS // 3, FRAME_NS, 3 * FRAME_NS])
def test_a_constant_twist_is_predicted_exactly(ahead_ns: int) -> None:
    motion, stamp = moving_on_twist()
    expected = on_twist(stamp + ahead_ns)
    np.testing.assert_allclose(motion.predict(stamp + ahead_ns), expected, atol=10 * EXACT)
    prior = motion.prior(stamp + ahead_ns)
    np.testing.assert_allclose(prior.T_world_cam, expected, atol=10 * EXACT)
    assert prior.sigma_m > 0 and prior.sigma_rad > 0


def test_the_longer_the_less_sure() -> None:
    motion, stamp = moving_on_twist()
    sigmas = [motion.prior(stamp + k * FRAME_NS).sigma_m for k in (1, 2, 4)]
    np.testing.assert_allclose(np.array(sigmas) / sigmas[0], [1, 4, 16], rtol=1e-3)


def test_a_still_camera_stays() -> None:
    motion = ConstantVelocity.at_rest(T_START, START_NS)
    np.testing.assert_array_equal(motion.predict(START_NS + FRAME_NS), T_START)
    local = motion.arriving(T_START, START_NS + FRAME_NS)
    np.testing.assert_allclose(local.pose_after(-0.02), np.eye(4), atol=EXACT)


def test_over_a_long_gap_nothing_is_extrapolated() -> None:
    motion, stamp = moving_on_twist()
    later = stamp + 10_000_000_000
    np.testing.assert_array_equal(motion.predict(later), motion.T_world_cam)
    there = T_START @ se3.exp(10 * TWIST)
    np.testing.assert_allclose(motion.arriving(there, later).pose_after(0.02), np.eye(4))
    after = motion.advanced(there, later)
    np.testing.assert_array_equal(after.predict(later + FRAME_NS), there)


def test_prediction_moves_with_the_world() -> None:
    """Left invariance."""
    T = se3.exp(np.array([1.0, -2.0, 0.5, 0.4, -0.3, 0.8]))
    here, stamp = moving_on_twist()
    there = ConstantVelocity.at_rest(T @ T_START, START_NS)
    for k in (FRAME_NS, 3 * FRAME_NS, 3 * FRAME_NS + FRAME_NS // 2):
        there = there.advanced(T @ on_twist(START_NS + k), START_NS + k)
    np.testing.assert_allclose(
        there.predict(stamp + FRAME_NS), T @ here.predict(stamp + FRAME_NS), atol=10 * EXACT
    )


def test_between_the_stamps_of_a_constant_twist_motion_is_exact() -> None:
    """T_now_then for lags of either sign."""
    motion, stamp = moving_on_twist()
    now = stamp + FRAME_NS
    local = motion.arriving(on_twist(now), now)
    np.testing.assert_allclose(local.twist, TWIST, atol=1e-6)
    np.testing.assert_allclose(local.acceleration, 0.0, atol=1e-4)
    for lag_s in (-0.025, 0.0, 0.01):
        np.testing.assert_allclose(
            local.pose_after(lag_s), se3.exp(TWIST * lag_s), atol=100 * EXACT
        )


@pytest.mark.parametrize('second_ns', [FRAME_NS, 2 * FRAME_NS, FRAME_NS // 3])
def test_uniform_acceleration_along_a_line_is_exact(second_ns: int) -> None:
    """Position p = v t + a t^2 / 2 without turning, whatever the two intervals."""
    velocity, acceleration = np.array([0.5, -0.3, 0.2]), np.array([2.0, 3.0, -1.0])

    def pose(stamp_ns: int) -> NDArray[np.float64]:
        t = seconds(stamp_ns)
        T = np.eye(4)
        T[:3, 3] = velocity * t + 0.5 * acceleration * t * t
        return T

    motion = ConstantVelocity.at_rest(pose(START_NS), START_NS)
    motion = motion.advanced(pose(START_NS + FRAME_NS), START_NS + FRAME_NS)
    now = START_NS + FRAME_NS + second_ns
    local = motion.arriving(pose(now), now)
    np.testing.assert_allclose(local.acceleration[:3], acceleration, atol=1e-6)
    np.testing.assert_allclose(local.twist[:3], velocity + acceleration * seconds(now), atol=1e-6)
    for lag_s in (-0.02, 0.01):
        then = now + round(lag_s * 1e9)
        np.testing.assert_allclose(pose(now) @ local.pose_after(lag_s), pose(then), atol=EXACT)
        np.testing.assert_allclose(
            local.twist_after(lag_s)[:3], velocity + acceleration * seconds(then), atol=1e-6
        )


def test_interpolation_is_surest_at_both_ends() -> None:
    """The path is pinned at the last pose and at this one; between them it may bend."""
    motion, stamp = moving_on_twist()
    now = stamp + FRAME_NS
    spread = {
        lag: np.linalg.eigvalsh(motion.passage_covariance(now, lag * FRAME_NS * 1e-9))
        for lag in (0.0, -0.25, -0.5, -0.75, -1.0)
    }
    assert all((values > 0).all() for values in spread.values())
    assert spread[-0.5][-1] > spread[-0.25][-1] > 100 * spread[0.0][-1]
    assert spread[-0.25][-1] == pytest.approx(spread[-0.75][-1])
    assert spread[-1.0][-1] == pytest.approx(spread[0.0][-1], abs=1e-12)


def equations(H: NDArray[np.float64], x: NDArray[np.float64]) -> NormalEquations:
    """A term whose minimum is at x."""
    return NormalEquations(H, H @ x, float(x @ H @ x))


def information(rng: np.random.Generator, sigma: float = 1e-3) -> NDArray[np.float64]:
    """Random, well conditioned, of about sigma^-2."""
    factor = rng.normal(size=(6, 6))
    matrix: NDArray[np.float64] = (factor @ factor.T + np.eye(6)) / sigma**2
    return matrix


def observe(
    offset: ColorDepthOffset,
    true_s: float,
    seed: int,
    intervals: int = 8,
    frames: int = 10,
    turning: bool = True,
    bias: float = 0.003,
) -> None:
    """Registrations in which depth is off by its remaining time error and the map by a constant.

    Depth moved by exp(v tau) with a tau that is too small asks for a pose farther along v.
    """
    rng = np.random.default_rng(seed)
    for _ in range(intervals):
        b = rng.normal(scale=bias, size=6)
        twist = rng.normal(scale=0.5, size=6)
        for _ in range(frames):
            if turning:
                twist = rng.normal(scale=0.5, size=6)
            depth = equations(information(rng), twist * (true_s - offset.seconds) + b)
            image = equations(information(rng), np.zeros(6))
            offset.observe(depth, image, twist, 1 / 30)
        offset.map_changes()


@pytest.mark.parametrize('true_ms', [-20.0, -3.0, 0.0, 5.0, 30.0])
def test_a_constant_offset_is_found(true_ms: float) -> None:
    """Whatever the map's own error, which is another one after each keyframe."""
    offset = ColorDepthOffset(TimingConfig(prior_ms=15.0))
    observe(offset, 1e-3 * true_ms, seed=1)
    assert offset.seconds == pytest.approx(1e-3 * true_ms, abs=OFFSET_S)


def test_it_does_not_matter_which_of_the_two_is_right() -> None:
    """Depth and image moved by the same pose error: their disagreement is what counts."""
    offset, rng = ColorDepthOffset(TimingConfig()), np.random.default_rng(2)
    for _ in range(40):
        twist, x = rng.normal(scale=0.5, size=6), rng.normal(scale=0.01, size=6)
        depth = equations(information(rng), x + twist * (0.008 - offset.seconds))
        offset.observe(depth, equations(information(rng), x), twist, 1 / 30)
    assert offset.seconds == pytest.approx(0.008, abs=OFFSET_S)


def test_a_constant_velocity_tells_nothing() -> None:
    """It cannot be told from an error of the map."""
    offset = ColorDepthOffset(TimingConfig(prior_ms=15.0))
    observe(offset, 0.02, seed=3, intervals=1, turning=False)
    assert abs(offset.seconds) < 1e-3


@pytest.mark.parametrize('fixed_ms', [0.0, -7.5, 12.0])
def test_a_fixed_offset_stays(fixed_ms: float) -> None:
    offset = ColorDepthOffset(TimingConfig(colour_depth_offset_ms=fixed_ms))
    observe(offset, 0.02, seed=4)
    assert offset.seconds == pytest.approx(1e-3 * fixed_ms, abs=1e-15)


def test_the_estimate_is_bounded_by_its_prior() -> None:
    offset = ColorDepthOffset(TimingConfig(prior_ms=5.0))
    observe(offset, 0.5, seed=5)
    assert 0.005 < offset.seconds <= 0.015 + 1e-12


def test_before_anything_is_seen_it_is_zero() -> None:
    offset = ColorDepthOffset(TimingConfig())
    offset.map_changes()
    offset.map_changes()
    assert offset.seconds == 0.0


def test_what_is_old_is_forgotten() -> None:
    """A camera that changes its timing is followed after a few times the memory."""
    offset = ColorDepthOffset(TimingConfig(memory_s=1.0))
    observe(offset, 0.01, seed=6, intervals=20)
    assert offset.seconds == pytest.approx(0.01, abs=OFFSET_S)
    observe(offset, -0.01, seed=7, intervals=30)
    assert offset.seconds == pytest.approx(-0.01, abs=10 * OFFSET_S)


@pytest.mark.parametrize('silent', ['depth', 'image', 'both'])
def test_where_one_of_the_two_says_nothing_nothing_is_learned(silent: str) -> None:
    """A frame whose depth has no pairs, or whose landmarks all went."""
    offset, rng = ColorDepthOffset(TimingConfig()), np.random.default_rng(8)
    nothing = NormalEquations(np.zeros((6, 6)), np.zeros(6), 0.0)
    something = equations(information(rng), np.full(6, 0.01))
    for _ in range(5):
        offset.observe(
            nothing if silent in ('depth', 'both') else something,
            nothing if silent in ('image', 'both') else something,
            rng.normal(size=6), 1 / 30,
        )  # fmt: skip
        offset.map_changes()
    assert abs(offset.seconds) < OFFSET_S
