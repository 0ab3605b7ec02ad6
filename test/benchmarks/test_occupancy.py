# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tests of how an occupancy grid is compared with the truth."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.occupancy import ADDRESSES, ghosts, mapped, score, solid, truth
from dcgs_ros.core.config.navigation import GridConfig
from dcgs_ros.core.navigation.occupancy import OccupancyMap
from dcgs_ros.core.navigation.voxels import FREE, OCCUPIED, UNKNOWN
from dcgs_ros.datasets.synthetic.raycast import Scene
from dcgs_ros.datasets.synthetic.scenes.builder import SceneBuilder


def scene() -> Scene:
    """Return a room of 4 x 4 m with a crate, a lamp over the band, and a ball on the floor."""
    build = SceneBuilder()
    build.box((0, 0, 1.3), (2.0, 2.0, 1.3), None)
    build.box((1.0, 0.0, 0.4), (0.3, 0.2, 0.4), None, yaw=0.5 * np.pi)
    build.box((-1.0, 0.0, 2.4), (0.3, 0.3, 0.1), None)
    build.sphere((0.0, 1.0, 0.05), 0.13, 'poster', 1.0)
    return build.build((0, 0, 2), 0.5)


def test_solid_is_what_stands_in_the_band() -> None:
    """A turned crate, the outside of the room, and the top of a ball; not the lamp."""
    places = np.array(
        [[1.15, 0.25], [1.25, 0.0], [2.1, 0], [-1, 0], [0, 1.05], [0, 1.125], [0, 0]]
    )
    found = solid(scene(), places, 0.1, 1.5)
    assert found.tolist() == [True, False, True, False, True, False, False]


def test_score_of_a_grid_that_is_the_truth_is_whole() -> None:
    """One that is the opposite is wrong everywhere; unknown cells do not count."""
    config = GridConfig()
    empty = OccupancyMap(np.zeros((60, 60), np.int8), (-0.5, -0.5), 0.05)
    true = truth(empty, scene(), np.eye(4), config)
    right = np.where(true.touched, OCCUPIED, FREE).astype(np.int8)
    found = score(OccupancyMap(right, empty.origin_m, 0.05), true)
    assert (found.right, found.every, found.free_found) == (1.0, 1.0, 1.0)
    wrong = np.where(true.touched, FREE, OCCUPIED).astype(np.int8)
    wrong[0, 0] = UNKNOWN
    other = score(OccupancyMap(wrong, empty.origin_m, 0.05), true)
    assert (other.right, other.every) == (0.0, 0.0)
    assert other.known == found.known - 1
    assert 0 < found.known < 3600  # cells that edges cut are neither


@pytest.mark.slow
def test_grid_of_a_room_is_right() -> None:
    """Of a hand-held camera's room, at the poses that the tracker finds."""
    found, times_ms = mapped(ADDRESSES[0], 2, GridConfig())
    assert found.right > 0.98
    assert np.median(times_ms) < 100.0


@pytest.mark.slow
def test_crate_that_went_leaves_no_ghost() -> None:
    """Half of the time it stands before the camera; what is left may not have been seen since."""
    before, after = ghosts(2, GridConfig())
    assert before > 30
    assert after <= 0.05 * before
