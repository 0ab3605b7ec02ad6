# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The IMU against the path it moves along, and its noise against its densities."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcgs_ros.datasets.synthetic.motion.imu import (
    ACCELEROMETER_NOISE,
    GYRO_NOISE,
    NO_NOISE,
    RATE_HZ,
    T_CAM_IMU,
    ImuNoise,
    exact_imu,
    measured_imu,
)
from dcgs_ros.datasets.synthetic.scenes.catalogue import SCENE_NAMES
from dcgs_ros.datasets.synthetic.source import IMU_FRAME, SyntheticSource

G = 9.80665


class Still:
    """A camera at rest, rolled and pitched."""

    T_base_cam = None

    def poses(self, times_s):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler('xyz', [-1.8, 0.2, 0.4]).as_matrix()
        return np.tile(pose, (len(times_s), 1, 1))


class Carousel:
    """A camera 2 m from a vertical axis, turning by 1.5 rad/s, looking outwards."""

    T_base_cam = None
    radius_m, rate = 2.0, 1.5

    def poses(self, times_s):
        angles = self.rate * np.asarray(times_s)
        c, s, zero, one = np.cos(angles), np.sin(angles), np.zeros_like(angles), 1 + 0 * angles
        columns = [(s, -c, zero), (zero, zero, -one), (c, s, zero)]
        poses = np.tile(np.eye(4), (len(angles), 1, 1))
        for k, column in enumerate(columns):
            poses[:, :3, k] = np.stack(column, axis=1)
        poses[:, :3, 3] = self.radius_m * np.stack([c, s, zero], axis=1)
        return poses


def measured(path, seconds, seed=0, gyro=GYRO_NOISE, accelerometer=ACCELEROMETER_NOISE):
    """All rates and forces (N, 3)."""
    blocks = list(measured_imu(path, 0.0, seconds, seed, gyro, accelerometer))
    return tuple(
        np.concatenate([getattr(b, name) for b in blocks]) for name in ('rates', 'forces')
    )


def test_at_rest_it_reads_gravity_upwards():
    """No rate, and g against the direction of gravity, in the IMU's own axes."""
    block = exact_imu(Still(), np.arange(0, 1, 0.005))
    np.testing.assert_allclose(block.rates, 0, atol=1e-12)
    R = Still().poses(np.zeros(1))[0, :3, :3]
    np.testing.assert_allclose(block.forces - R.T @ [0, 0, G], 0, atol=1e-6)


def test_on_a_carousel_it_reads_the_centripetal_force():
    """rate^2 (r + what the IMU is in front of the camera) inwards, g up, the rate about up."""
    block = exact_imu(Carousel(), np.arange(0, 3, 0.005))
    np.testing.assert_allclose(block.rates - [0, -1.5, 0], 0, atol=1e-6)
    inwards = 1.5**2 * (2.0 + T_CAM_IMU[2, 3])
    sideways = 1.5**2 * -T_CAM_IMU[0, 3]
    np.testing.assert_allclose(block.forces - [sideways, -G, -inwards], 0, atol=1e-5)


@pytest.mark.parametrize('address', [*SCENE_NAMES, 'corridor?motion=handheld'])
def test_integrated_it_is_the_path(address):
    """Rates give the turn of 10 s to 0.1 degree; forces its velocity and place."""
    source = SyntheticSource.from_address(f'synthetic:{address}')
    times_s = np.arange(0, 10, 1 / 400)
    block = exact_imu(source._path, times_s)
    poses = source._path.poses(times_s) @ T_CAM_IMU
    R = Rotation.from_matrix(poses[0, :3, :3])
    p, v = poses[0, :3, 3], (poses[1, :3, 3] - poses[0, :3, 3]) * 400
    v = v - 0.5 / 400 * (R.apply(block.forces[0]) - [0, 0, G])
    for (w0, w1), (f0, f1) in zip(pairwise(block.rates), pairwise(block.forces), strict=True):
        later = R * Rotation.from_rotvec(0.5 * (w0 + w1) / 400)
        a0, a1 = R.apply(f0) - [0, 0, G], later.apply(f1) - [0, 0, G]
        p = p + v / 400 + (2 * a0 + a1) / 6 / 400**2
        v = v + 0.5 * (a0 + a1) / 400
        R = later
    error = R.inv() * Rotation.from_matrix(poses[-1, :3, :3])
    assert np.rad2deg(error.magnitude()) < 0.1
    assert np.linalg.norm(p - poses[-1, :3, 3]) < 0.05


def allan(values, seconds):
    """Allan deviation (3,) of samples (N, 3) averaged over `seconds`."""
    size = round(seconds * RATE_HZ)
    means = values[: len(values) // size * size].reshape(-1, size, 3).mean(axis=1)
    return np.sqrt(0.5 * np.square(np.diff(means, axis=0)).mean(axis=0))


def test_noise_has_its_density_and_the_bias_wanders():
    """Allan deviation falls as density / sqrt(tau), then rises as walk sqrt(tau / 3)."""
    for noise, k in ((GYRO_NOISE, 0), (ACCELEROMETER_NOISE, 1)):
        values = measured(Still(), 600)[k]
        for tau in (0.1, 1.0):
            found = np.sqrt(np.mean(allan(values, tau) ** 2))
            assert found == pytest.approx(noise.density / np.sqrt(tau), rel=0.1)
    restless = ImuNoise(1e-6, 1e-3, 0.0)
    values = measured(Still(), 600, gyro=restless)[0]
    found = np.sqrt(np.mean(allan(values, 4.0) ** 2))
    assert found == pytest.approx(1e-3 * np.sqrt(4.0 / 3), rel=0.2)


def test_biases_are_drawn_with_the_seed():
    """Their spread over seeds is the stated one; the same seed gives the same bytes."""
    exact = exact_imu(Still(), np.zeros(1))
    firsts = [measured(Still(), 2.0, seed) for seed in range(60)]
    for k, (noise, true) in enumerate(
        ((GYRO_NOISE, exact.rates), (ACCELEROMETER_NOISE, exact.forces))
    ):
        biases = np.array([values[k].mean(axis=0) for values in firsts]) - true
        assert biases.std() == pytest.approx(noise.bias, rel=0.2)
    assert np.array_equal(firsts[3][0], measured(Still(), 2.0, 3)[0])


def test_every_source_has_an_imu():
    """200 Hz from before the first frame until after the last, ideal where the sensor is."""
    source = SyntheticSource.from_address('synthetic:ring?frames=40&seed=2')
    samples = list(source.imu())
    stamps = np.array([sample.stamp_ns for sample in samples])
    assert (np.diff(stamps) == 5_000_000).all() and samples == list(source.imu())
    truth = source.groundtruth.stamps_ns
    assert stamps[0] < truth[0] - 50e6 and stamps[-1] > truth[-1] + 50e6
    assert {sample.frame for sample in samples} == {IMU_FRAME}
    ideal = SyntheticSource.from_address('synthetic:ring?frames=40&seed=2&sensor=ideal')
    exact = next(measured_imu(source._path, *source._span_s, 2, NO_NOISE, NO_NOISE))
    assert [s.angular_velocity for s in ideal.imu()] == [tuple(w) for w in exact.rates.tolist()]
    error = np.array([s.angular_velocity for s in samples]) - exact.rates
    assert 1e-4 < np.abs(error).max() < 0.05
