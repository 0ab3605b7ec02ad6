# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Paths are rigid, smooth, like a hand's, and keep a distance from surfaces."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dcgs_ros.datasets.synthetic.motion.hand_held import HandHeldPath
from dcgs_ros.datasets.synthetic.scenes.catalogue import build_scenario

SCENES = ('room', 'plane', 'zigzag', 'desk')
SEEDS = range(5)
TIMES_S = np.arange(0, 60, 1 / 30)
CLEARANCE_M = 0.4


def angular_rates(poses):
    """Degrees per second (N - 1,) of poses 1/30 s apart."""
    first, second = (
        Rotation.from_matrix(poses[:-1, :3, :3]),
        Rotation.from_matrix(poses[1:, :3, :3]),
    )
    return np.rad2deg((first.inv() * second).magnitude()) * 30


@pytest.mark.parametrize('scene', SCENES)
@pytest.mark.parametrize('seed', SEEDS)
def test_path_is_rigid_and_clear_of_things(scene, seed):
    """R^T R = 1, det R = 1; no surface is nearer than a forearm."""
    stage = build_scenario(scene, seed)
    poses = HandHeldPath(stage.motion, seed, 1.0).poses(TIMES_S)
    R = poses[:, :3, :3]
    np.testing.assert_allclose(
        R.transpose(0, 2, 1) @ R, np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1)
    assert stage.scene.clearance(poses[:, :3, 3]).min() > CLEARANCE_M
    down = poses[:, :3, 1]
    assert (down[:, 2] < 0).all()


@pytest.mark.parametrize('seed', SEEDS)
def test_room_is_walked_like_by_a_hand(seed):
    """About 0.25 m/s and 20-30 degrees/s, with bursts of more than 90."""
    poses = HandHeldPath(build_scenario('room', seed).motion, seed, 1.0).poses(TIMES_S)
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 30
    rates = angular_rates(poses)
    assert 0.2 < speeds.mean() < 0.35 and speeds.max() < 0.8
    assert 20 < rates.mean() < 30 and 90 < rates.max() < 140


def test_double_speed_is_the_same_path_twice_as_fast():
    """The pose at t of speed 2 is that at 2 t of speed 1."""
    motion = build_scenario('room', 1).motion
    fast, slow = HandHeldPath(motion, 1, 2.0), HandHeldPath(motion, 1, 1.0)
    np.testing.assert_allclose(fast.poses(TIMES_S), slow.poses(2 * TIMES_S), atol=1e-12)


@pytest.mark.parametrize('scene', SCENES)
def test_turns_add_up_to_nothing(scene):
    """Otherwise the path would jump at the start of each cycle."""
    motion = build_scenario(scene, 0).motion
    for channel in range(6):
        assert sum(turn.change for turn in motion.turns if turn.channel == channel) == 0
    assert all(turn.start_s + turn.duration_s < motion.cycle_s for turn in motion.turns)


def test_seeds_shake_differently():
    """The seed changes the path by centimetres, not decimetres."""
    motion = build_scenario('room', 0).motion
    a, b = (HandHeldPath(motion, seed, 1.0).poses(TIMES_S)[:, :3, 3] for seed in (0, 1))
    distance = np.linalg.norm(a - b, axis=1)
    assert 0.003 < distance.mean() < 0.05
