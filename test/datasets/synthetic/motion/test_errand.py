# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A robot that drives, stops and turns on the spot does one of them at a time."""

import numpy as np
import pytest

from dcgs_ros.datasets.synthetic.motion.errand import Errand

CORNERS = ((0.0, 0.0), (3.0, 0.0), (3.0, 2.0))
PATH = Errand(CORNERS).path(0, 1.0)
TIMES = np.arange(0.0, 2 * PATH.cycle_s, 1e-2)
GROUND = PATH.ground(TIMES)
PACE = np.linalg.norm(np.diff(GROUND[:, :2], axis=0), axis=1) * 100
RATE = np.diff(GROUND[:, 2]) * 100


def test_it_drives_at_half_a_metre_and_turns_at_one_and_a_half_radians_a_second() -> None:
    assert PACE.max() == pytest.approx(0.5, rel=1e-3)
    assert np.abs(RATE).max() == pytest.approx(1.5, rel=1e-3)
    assert np.abs(np.diff(PACE)).max() < 0.02
    assert np.abs(np.diff(RATE)).max() < 0.03


def test_it_stands_between_driving_and_turning() -> None:
    drives, turns = PACE > 1e-6, np.abs(RATE) > 1e-6
    assert not (drives & turns).any()
    pauses_s = 1e-2 * np.sum(~drives & ~turns)
    assert 6 * 0.9 < pauses_s < 6 * 1.3


def test_it_goes_from_corner_to_corner_where_it_looks() -> None:
    for corner in CORNERS:
        assert np.linalg.norm(GROUND[:, :2] - corner, axis=1).min() < 1e-9
    steps, heading = np.diff(GROUND[:, :2], axis=0), GROUND[:-1, 2]
    aside = np.cos(heading) * steps[:, 1] - np.sin(heading) * steps[:, 0]
    np.testing.assert_allclose(aside, 0.0, atol=1e-9)


def test_a_lap_ends_where_the_next_begins() -> None:
    start, lap = PATH.ground(np.array([0.7, PATH.cycle_s + 0.7]))
    np.testing.assert_allclose(lap - start, [0.0, 0.0, 2 * np.pi], atol=1e-9)


def test_the_camera_shakes_on_the_way_and_is_still_where_it_stands() -> None:
    assert PATH.T_base_cam is not None
    x, y, yaw = GROUND.T
    T = np.tile(np.eye(4), (len(TIMES), 1, 1))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(yaw)
    T[:, 1, 0], T[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    T[:, 0, 3], T[:, 1, 3] = x, y
    off_m = np.linalg.norm((PATH.poses(TIMES) - T @ PATH.T_base_cam)[:, :3, 3], axis=1)
    assert 1e-4 < off_m.max() < 2e-3
    assert off_m[:-1][PACE < 1e-9].max() < 1e-5
