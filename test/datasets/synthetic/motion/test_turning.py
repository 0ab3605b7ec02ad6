# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A robot that turns on the spot does no more."""

import numpy as np
import pytest

from dcgs_ros.datasets.synthetic.motion.turning import OnTheSpot
from dcgs_ros.datasets.synthetic.scenes.catalogue import build_scenario

TIMES = np.arange(-1.0, 25.0, 1e-2)


def test_it_turns_at_up_to_3_rad_s_and_stays() -> None:
    ground = OnTheSpot((0.3, -0.2)).path(0, 1.0).ground(TIMES)
    rate = np.abs(np.diff(ground[:, 2])) * 100
    assert rate.max() == pytest.approx(3.0, rel=1e-3)
    np.testing.assert_array_equal(ground[:, :2], np.tile([0.3, -0.2], (len(TIMES), 1)))
    assert np.abs(np.diff(rate)).max() < 0.1


def test_the_camera_is_where_the_base_carries_it() -> None:
    path = OnTheSpot((0.3, -0.2)).path(0, 1.0)
    assert path.T_base_cam is not None
    x, y, yaw = path.ground(TIMES).T
    T = np.tile(np.eye(4), (len(TIMES), 1, 1))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(yaw)
    T[:, 1, 0], T[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    T[:, 0, 3], T[:, 1, 3] = x, y
    np.testing.assert_allclose(path.poses(TIMES), T @ path.T_base_cam, atol=1e-12)


def test_it_keeps_clear_of_the_room() -> None:
    scenario = build_scenario('room', 0, 'turning')
    poses = scenario.motion.path(0, 1.0).poses(TIMES)
    assert scenario.scene.clearance(poses[:, :3, 3]).min() > 0.35
