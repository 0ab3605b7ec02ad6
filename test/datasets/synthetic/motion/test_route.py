# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Routes are closed, smooth and as fast as a robot or a walker."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcgs_ros.datasets.synthetic.motion.route import GAITS, HANDHELD, WHEELED
from dcgs_ros.datasets.synthetic.scenes.catalogue import SCENES, build_scenario

ROUTED = [
    ('room', 'wheeled'),
    *((scene, motion) for scene in ('corridor', 'ring') for motion in SCENES[scene].motions),
]
CLEARANCE_M = 0.35  # half a doorway of 1.3 m, less what a hand shakes


def path_of(scene, motion, seed=0, **extras):
    """Return a scene and its path."""
    stage = build_scenario(scene, seed, motion, **extras)
    return stage.scene, stage.motion.path(seed, 1.0)


def cycle(path, rate_hz=30):
    """Times (N,) of one cycle."""
    return np.arange(0, path.cycle_s, 1 / rate_hz)


@pytest.mark.parametrize(('scene', 'motion'), ROUTED)
def test_camera_keeps_clear_of_things(scene, motion):
    """All the way round, the camera is inside, upright and no nearer to anything than a robot."""
    for seed in range(3):
        room, path = path_of(scene, motion, seed)
        poses = path.poses(cycle(path, 10))
        floor_m = 0.9 * poses[:, 2, 3].min()
        assert room.clearance(poses[:, :3, 3]).min() > min(CLEARANCE_M, floor_m)
        R = poses[:, :3, :3]
        np.testing.assert_allclose(R.transpose(0, 2, 1) @ R - np.eye(3), 0, atol=1e-12)
        assert (poses[:, 2, 1] < -0.8).all()


@pytest.mark.parametrize(('scene', 'motion'), ROUTED)
def test_path_is_smooth_also_where_it_closes(scene, motion):
    """Velocity has no steps, and one cycle later the camera's carrier is back."""
    _, path = path_of(scene, motion)
    times = np.arange(-2, path.cycle_s + 2, 1e-3)
    ground = path.ground(times)
    ground[:, 2] = np.unwrap(ground[:, 2])
    velocity = np.diff(ground, axis=0) * 1e3
    acceleration = np.abs(np.diff(velocity, axis=0)) * 1e3
    assert acceleration[:, :2].max() < 2 and acceleration[:, 2].max() < 12
    turned = ground[-1000, 2] - ground[-1000 - round(path.cycle_s * 1e3), 2]
    assert abs(turned) == pytest.approx(2 * np.pi, abs=0.02)
    again = path.ground(times[:1] + path.cycle_s)[0, :2]
    np.testing.assert_allclose(again, ground[0, :2], atol=1e-6)


@pytest.mark.parametrize(('scene', 'length_m'), [('corridor', 60.0), ('ring', 55.0)])
def test_routes_are_as_long_as_they_should_be(scene, length_m):
    """30 m and back; 55 m round."""
    _, path = path_of(scene, 'wheeled')
    assert path.length_m == pytest.approx(length_m, rel=0.03)


def test_wheels_roll_and_hands_shake():
    """A robot at 0.3 to 0.6 m/s turns by up to 1 rad/s and stays level; a walker does neither."""
    pitch = {}
    for motion, gait in (('wheeled', WHEELED), ('handheld', HANDHELD)):
        _, path = path_of('corridor', motion)
        poses = path.poses(cycle(path))
        ground = path.ground(cycle(path, 100))
        speed = np.linalg.norm(np.diff(ground[:, :2], axis=0), axis=1) * 100
        rate = np.abs(np.diff(np.unwrap(ground[:, 2]))) * 100
        assert np.median(speed) == pytest.approx(gait.speed_m_s, rel=0.02)
        assert 0.5 < rate.max() < 1.5 * gait.turn_rad_s <= 1.5
        pitch[motion] = np.rad2deg(np.arcsin(poses[:, 2, 2])).std()
        assert poses[:, 2, 3].std() < gait.shake_m
    assert pitch['wheeled'] < 0.2 < 0.4 < pitch['handheld']
    assert 0.3 <= WHEELED.speed_m_s <= 0.6 and 0.3 <= WHEELED.height_m <= 1


def test_ring_is_gone_round_either_way():
    """The area that the route encloses is positive counter-clockwise."""
    for direction, sign in (('ccw', 1), ('cw', -1)):
        _, path = path_of('ring', 'wheeled', direction=direction)
        places = path.ground(cycle(path, 5))[:, :2]
        area = sum(a[0] * b[1] - a[1] * b[0] for a, b in pairwise(places)) / 2
        assert sign * area == pytest.approx(17.7 * 10, rel=0.03)


def test_speed_and_seed():
    """Twice the speed is the same path twice as fast; a seed shakes it by little."""
    stage = build_scenario('ring', 0, 'wheeled')
    times = np.arange(0, 20, 0.1)
    slow, fast, other = (
        stage.motion.path(seed, speed) for seed, speed in ((0, 1.0), (0, 2.0), (1, 1.0))
    )
    np.testing.assert_allclose(fast.poses(times), slow.poses(2 * times), atol=1e-12)
    distance = np.linalg.norm(slow.poses(times)[:, :3, 3] - other.poses(times)[:, :3, 3], axis=1)
    assert 0 < distance.max() < 0.01
    turned = Rotation.from_matrix(slow.poses(times)[:, :3, :3]).inv() * Rotation.from_matrix(
        other.poses(times)[:, :3, :3]
    )
    assert np.rad2deg(turned.magnitude()).max() < 1
    assert set(GAITS) == {'wheeled', 'handheld'}
