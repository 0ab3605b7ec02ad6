# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What can be a trajectory, and what cannot."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.trajectory import Trajectory, TrajectoryError


def poses(count: int) -> NDArray[np.float64]:
    return np.tile(np.eye(4), (count, 1, 1))


@pytest.mark.parametrize('count', [0, 1, 5])
def test_length_is_the_number_of_poses(count: int) -> None:
    assert len(Trajectory(np.arange(count), poses(count))) == count


def test_any_step_forward_is_a_step() -> None:
    Trajectory(np.array([0, 1, 10**18]), poses(3))


@pytest.mark.parametrize('shape', [(3, 4, 4), (2, 3, 4), (2, 16), (4, 4)])
def test_poses_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(TrajectoryError, match='2 stamps'):
        Trajectory(np.arange(2), np.zeros(shape))


@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf])
def test_the_first_pose_that_is_not_finite_is_named(bad: float) -> None:
    T_world_cam = poses(5)
    T_world_cam[3, 0, 3] = T_world_cam[4, 1, 1] = bad
    with pytest.raises(TrajectoryError, match='pose 4 of 5'):
        Trajectory(np.arange(5), T_world_cam)


@pytest.mark.parametrize(('stamps', 'second'), [((0, 10, 10), 0.0), ((0, 10**9, 0), 1.0)])
def test_the_first_stamp_that_does_not_increase_is_named(
    stamps: tuple[int, ...], second: float
) -> None:
    with pytest.raises(TrajectoryError, match=f'pose 3 of 3 comes {second:.6f} s'):
        Trajectory(np.array(stamps), poses(3))
