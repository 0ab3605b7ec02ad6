# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Rotations by a gyro against closed forms and true paths; what it learns, and its faults."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dcgs_ros.core import se3
from dcgs_ros.core.priors.gyro import Gyro
from dcgs_ros.core.priors.readings import AngularRate
from dcgs_ros.datasets.synthetic.source import SyntheticSource

MS = 1_000_000
IMAGES_RAD = 1e-3
RIG = Rotation.from_euler('xyz', [0.4, -1.2, 0.7]).as_matrix()  # IMU to camera
SOURCE = SyntheticSource.from_address('synthetic:room?frames=450&sensor=d435i&seed=3')
Change = Callable[[int, NDArray[np.float64]], tuple[int, NDArray[np.float64]] | None]


def constant(rate: NDArray[np.float64], until_ns: int, step_ns: int = 5 * MS) -> Gyro:
    gyro = Gyro(RIG)
    for stamp_ns in range(0, until_ns, step_ns):
        gyro.sense(AngularRate(stamp_ns, RIG.T @ rate))
    return gyro


@cache
def measured() -> list[tuple[int, NDArray[np.float64]]]:
    return [(sample.stamp_ns, np.array(sample.angular_velocity)) for sample in SOURCE.imu()]


def rates(change: Change | None = None) -> Iterator[AngularRate]:
    """Yield what the gyro of the synthetic room measures, changed by stamp and value."""
    for stamp_ns, rate in measured():
        changed = (stamp_ns, rate) if change is None else change(stamp_ns, rate)
        if changed is not None:
            yield AngularRate(*changed)


def watched(change: Change | None = None, seconds: float = 15.0) -> tuple[Gyro, list[str | None]]:
    """Let a gyro learn from noisy images; return it, and its reason each half second."""
    gyro, readings = Gyro(SOURCE.T_cam_imu[:3, :3]), rates(change)
    truth, rng, reasons = SOURCE.groundtruth, np.random.default_rng(0), []
    assert truth is not None
    last_ns, R_last, held = None, np.eye(3), next(readings)
    for stamp_ns in truth.stamps_ns[::15][: round(2 * seconds)].tolist():
        while held is not None and held.stamp_ns <= stamp_ns + 20 * MS:
            gyro.sense(held)
            held = next(readings, None)  # type: ignore[assignment]
        noise = se3.exp(np.array([0, 0, 0, *(IMAGES_RAD * rng.standard_normal(3))]))[:3, :3]
        R = SOURCE.pose(stamp_ns)[:3, :3] @ noise
        if last_ns is not None:
            gyro.learn(last_ns, stamp_ns, R_last.T @ R, 2 * IMAGES_RAD**2 * np.eye(3))
        reasons.append(gyro.reason(stamp_ns))
        last_ns, R_last = stamp_ns, R
    return gyro, reasons


def from_start(start_s: float) -> Callable[[int], bool]:
    first_ns = SOURCE.groundtruth.stamps_ns[0]  # type: ignore[union-attr]
    return lambda stamp_ns: stamp_ns >= first_ns + start_s * 1e9


@pytest.mark.parametrize('ends_ms', [(0, 100), (3, 98), (12, 13)])
def test_a_constant_rate_turns_by_its_exponential_in_the_camera_frame(
    ends_ms: tuple[int, int],
) -> None:
    rate = np.array([0.3, -2.0, 1.1])
    turn = constant(rate, 200 * MS).turn(ends_ms[0] * MS, ends_ms[1] * MS)
    assert turn is not None
    expected = Rotation.from_rotvec(rate * 1e-3 * (ends_ms[1] - ends_ms[0])).as_matrix()
    np.testing.assert_allclose(turn.R, expected, atol=1e-12)
    np.testing.assert_allclose(turn.end_rate, rate, atol=1e-12)
    np.testing.assert_allclose(turn.end_acceleration, 0, atol=1e-9)


def test_a_true_path_is_followed() -> None:
    truth = SOURCE.groundtruth
    assert truth is not None
    gyro = Gyro(SOURCE.T_cam_imu[:3, :3])
    for reading in rates():
        if reading.stamp_ns < truth.stamps_ns[60] + 20 * MS:
            gyro.sense(reading)
    start_ns, end_ns = truth.stamps_ns[[0, 60]].tolist()
    turn = gyro.turn(start_ns, end_ns)
    assert turn is not None
    true = SOURCE.pose(start_ns)[:3, :3].T @ SOURCE.pose(end_ns)[:3, :3]
    angle = Rotation.from_matrix(turn.R.T @ true).magnitude()
    assert angle < 0.03  # two seconds of a bias of 5 mrad/s a axis


def test_an_error_of_the_bias_turns_by_its_jacobian() -> None:
    rate, error = np.array([0.3, -2.0, 1.1]), 1e-4 * np.array([1.0, 2.0, -1.0])
    turn, wrong = (constant(r, 1200 * MS).turn(0, 1000 * MS) for r in (rate, rate + error))
    assert turn is not None and wrong is not None
    moved = Rotation.from_matrix(turn.R.T @ wrong.R).as_rotvec()
    np.testing.assert_allclose(moved, turn.J @ error, rtol=0.02, atol=1e-7)


def test_a_bias_of_0_02_is_found_within_ten_seconds() -> None:
    extra = 0.02 * np.array([1.0, -1.0, 1.0]) / np.sqrt(3)
    gyro, reasons = watched(lambda stamp_ns, rate: (stamp_ns, rate + extra), 10.0)
    plain, _ = watched(None, 10.0)
    np.testing.assert_allclose(gyro.bias - plain.bias, extra, atol=2e-4)
    assert np.linalg.norm(gyro.bias - extra) < 0.013  # its own bias beside
    assert set(reasons[1:]) == {None}


@pytest.mark.parametrize('late_ms', [-12, 12])
def test_a_late_clock_is_found(late_ms: int) -> None:
    gyro, reasons = watched(lambda stamp_ns, rate: (stamp_ns + late_ms * MS, rate))
    assert gyro.delay_s == pytest.approx(1e-3 * late_ms, abs=2e-3)
    assert reasons[-1] is None


def test_noise_is_read_from_the_readings() -> None:
    rng, density = np.random.default_rng(0), 0.02  # rad/s per sqrt(Hz), eighty times a D435i's
    gyro = Gyro(np.eye(3))
    for k in range(1000):
        white = density * np.sqrt(200.0) * rng.standard_normal(3)
        gyro.sense(AngularRate(5 * MS * k, np.array([1.0, 0.0, -0.5]) + white))
    assert gyro.density == pytest.approx(density, rel=0.2)
    turn = gyro.turn(1000 * MS, 2000 * MS)
    assert turn is not None
    variance = gyro.factor(turn).noise[3, 3]
    assert variance == pytest.approx(gyro.density**2, rel=1e-6)


def test_a_good_gyro_is_used() -> None:
    _, reasons = watched()
    assert reasons == [None] * 30


def test_a_dead_gyro_is_left_out() -> None:
    dead = from_start(5.0)
    _, reasons = watched(lambda stamp_ns, rate: None if dead(stamp_ns) else (stamp_ns, rate), 8.0)
    assert reasons[10] is None
    assert str(reasons[12]).startswith('no reading for')


def test_a_frozen_gyro_is_left_out() -> None:
    frozen, last = from_start(5.0), [np.zeros(3)]

    def change(stamp_ns: int, rate: NDArray[np.float64]) -> tuple[int, NDArray[np.float64]]:
        last[0] = last[0] if frozen(stamp_ns) else rate
        return stamp_ns, last[0]

    _, reasons = watched(change, 8.0)
    assert reasons[9] is None
    assert str(reasons[11]).startswith('frozen')


def test_a_late_gyro_is_left_out() -> None:
    _, reasons = watched(lambda stamp_ns, rate: (stamp_ns + 120 * MS, rate))
    assert 'contradicts the images' in str(reasons[8])


def test_a_gyro_mounted_otherwise_is_left_out() -> None:
    turned = Rotation.from_euler('z', 90, degrees=True)
    _, reasons = watched(lambda stamp_ns, rate: (stamp_ns, turned.apply(rate)))
    assert 'contradicts the images' in str(reasons[4])
    assert 'degrees off' in str(reasons[-1])


def test_a_gyro_that_agrees_again_is_taken_back() -> None:
    fault = from_start(4.0)
    healed = from_start(7.0)
    _, reasons = watched(
        lambda stamp_ns, rate: (
            stamp_ns, -rate if fault(stamp_ns) and not healed(stamp_ns) else rate
        )
    )  # fmt: skip
    assert reasons[8] is None
    assert 'contradicts' in str(reasons[12])
    assert reasons[-1] is None


def test_what_was_not_measured_is_not_told() -> None:
    gyro = constant(np.ones(3), 200 * MS)
    assert gyro.turn(0, 400 * MS) is None
    assert gyro.turn(-100 * MS, 100 * MS) is None
    assert Gyro(RIG).turn(0, 100 * MS) is None
    assert Gyro(RIG).reason(0) == 'no reading yet'
    for stamp_ns in range(400 * MS, 600 * MS, 5 * MS):
        gyro.sense(AngularRate(stamp_ns, np.ones(3) + 1e-9 * stamp_ns))
    assert gyro.turn(100 * MS, 500 * MS) is None  # over the gap
