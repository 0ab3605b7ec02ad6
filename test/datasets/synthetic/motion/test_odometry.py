# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Wheel odometry against the path, and its drift against its law."""

import numpy as np
import pytest

from dcgs_ros.datasets.synthetic.motion.odometry import (
    NO_ERRORS,
    RATE_HZ,
    WHEELS,
    WheelErrors,
    measured_odometry,
)
from dcgs_ros.datasets.synthetic.scenes.catalogue import SCENE_NAMES
from dcgs_ros.datasets.synthetic.source import SyntheticSource


class Straight:
    """Along x at 0.5 m/s, or turning on the spot at 0.5 rad/s."""

    T_base_cam = None

    def __init__(self, turning=False):
        self._rates = np.array([0.0, 0.0, 0.5] if turning else [0.5, 0.0, 0.0])

    def ground(self, times_s):
        return np.asarray(times_s)[:, None] * self._rates


def measured(path, seconds, seed=0, errors=WHEELS):
    """Poses and velocities (N, 3)."""
    blocks = list(measured_odometry(path, 0.0, seconds, seed, errors))
    return tuple(
        np.concatenate([getattr(block, name) for block in blocks])
        for name in ('poses', 'velocities')
    )


@pytest.mark.parametrize('scene', SCENE_NAMES)
def test_without_errors_it_is_the_path(scene):
    """Summed up over 60 s, and at every instant."""
    path = SyntheticSource.from_address(f'synthetic:{scene}')._path
    poses, velocities = measured(path, 60.0, errors=NO_ERRORS)
    ground = path.ground(np.arange(len(poses)) / RATE_HZ)
    c, s = np.cos(ground[0, 2]), np.sin(ground[0, 2])
    moved = ground[:, :2] - ground[0, :2]
    true = np.stack([c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0]], axis=1)
    np.testing.assert_allclose(poses[:, :2], true, atol=1e-9)
    turned = (poses[:, 2] - ground[:, 2] + ground[0, 2] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0, atol=1e-9)
    speed = np.hypot(*np.diff(ground[:, :2], axis=0).T) * RATE_HZ
    np.testing.assert_allclose(np.hypot(*velocities[1:, :2].T), speed, atol=1e-3)


def test_wheels_of_the_wrong_size_err_by_a_share_of_the_way():
    """1 % over seeds straight ahead; turns by 2 % about the 4 % that slip adds."""
    ends = np.array([measured(Straight(), 60.0, seed)[0][-1, 0] for seed in range(80)])
    assert (ends / 30 - 1).std() == pytest.approx(WHEELS.scale, rel=0.25)
    assert abs((ends / 30 - 1).mean()) < 0.004
    turns = np.array([measured(Straight(True), 60.0, seed)[0][-1, 2] for seed in range(80)])
    assert (turns / 30 - 1).mean() == pytest.approx(WHEELS.slip, abs=0.01)
    assert (turns / 30 - 1).std() == pytest.approx(WHEELS.turn_scale, rel=0.3)


def test_slip_comes_and_goes_in_turns():
    """Within one turn the measured rate wanders by half of the slip, over about a second."""
    only = WheelErrors(0.0, 0.0, 0.04, 0.0, 0.0)
    excess = np.concatenate(
        [measured(Straight(True), 60.0, seed, only)[1][:, 2] / 0.5 - 1 for seed in range(10)]
    )
    assert excess.mean() == pytest.approx(0.04, abs=0.003)
    assert excess.std() == pytest.approx(0.02, rel=0.15)
    later = np.corrcoef(excess[:-RATE_HZ], excess[RATE_HZ:])[0, 1]
    assert later == pytest.approx(np.exp(-1), abs=0.12)


def test_noise_grows_with_the_root_of_the_way():
    """0.5 % of a metre after 1 m, twice that after 4 m."""
    only = WheelErrors(0.0, 0.0, 0.0, 0.0, 0.005)
    ways = np.array([measured(Straight(), 8.0, seed, only)[0][:, 0] for seed in range(200)])
    for metres in (1.0, 4.0):
        found = (ways[:, round(metres / 0.5 * RATE_HZ)] - metres).std()
        assert found == pytest.approx(0.005 * np.sqrt(metres), rel=0.15)


def test_a_turning_base_drifts_sideways_unseen():
    """Straight ahead it has no sideways velocity; in a bend it has one it did not make."""

    class Bend:
        T_base_cam = None

        def ground(self, times_s):
            a = 0.5 * np.asarray(times_s)
            return np.stack([np.sin(a), 1 - np.cos(a), a], axis=1)

    only = WheelErrors(0.0, 0.0, 0.0, 0.02, 0.0)
    assert np.abs(measured(Straight(), 5.0, 0, only)[1][:, 1]).max() < 1e-12
    sideways = measured(Bend(), 5.0, 0, only)[1][:, 1]
    assert sideways.mean() == pytest.approx(-0.02 * 0.5 * 0.5, rel=0.05)


def test_ring_drifts_by_metres_and_is_the_same_again():
    """After 55 m: decimetres to metres off, as of a few per cent in turns of 360 degrees."""
    ends = []
    for seed in range(6):
        source = SyntheticSource.from_address(f'synthetic:ring?frames=3900&seed={seed}')
        poses = np.array([sample.pose for sample in source.odometry()])
        ends.append(np.hypot(*poses[round(source._path.cycle_s * RATE_HZ), :2]))
    assert 0.3 < np.median(ends) < 4 and max(ends) < 8
    short = SyntheticSource.from_address('synthetic:ring?frames=30')
    samples = list(short.odometry())
    assert samples == list(short.odometry())
    assert samples[0].pose == (0, 0, 0) and samples[0].base_frame == 'base_link'
    assert (np.diff([sample.stamp_ns for sample in samples]) == 20_000_000).all()


def test_base_is_under_a_camera_on_wheels():
    """T_base_cam takes the base's pose to the camera's, but for vibration; a hand has none."""
    source = SyntheticSource.from_address('synthetic:corridor')
    times_s = np.arange(0, 40, 0.1)
    x, y, heading = source._path.ground(times_s).T
    bases = np.tile(np.eye(4), (len(times_s), 1, 1))
    bases[:, 0, 0], bases[:, 0, 1], bases[:, 0, 3] = np.cos(heading), -np.sin(heading), x
    bases[:, 1, 0], bases[:, 1, 1], bases[:, 1, 3] = np.sin(heading), np.cos(heading), y
    error = np.linalg.inv(bases @ source.T_base_cam) @ source._path.poses(times_s)
    assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.003
    assert np.abs(error[:, :3, :3] - np.eye(3)).max() < np.deg2rad(0.5)
    assert SyntheticSource.from_address('synthetic:corridor?motion=handheld').T_base_cam is None
