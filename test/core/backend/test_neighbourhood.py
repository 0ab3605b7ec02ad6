# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Keyframes that odometry links, without those that are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from walks import relative, round_block  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.backend.neighbourhood import Neighbourhood


def test_poses_are_added_up_along_the_edges() -> None:
    walk = round_block(12, seed=1)
    near = Neighbourhood()
    for odometry in walk.odometry:
        near.add(odometry)
    assert sorted(near.around(6, 1)) == [3, 4, 5, 6, 7, 8, 9]
    around = near.around(6, 2)
    assert sorted(around) == list(range(12))
    for other, T in around.items():
        true = se3.inverse(walk.tracked[6]) @ walk.tracked[other]
        np.testing.assert_allclose(T, true, atol=0.03)  # each edge has the drift of its hosts


def test_a_view_is_the_same_only_where_edges_lead_to_it() -> None:
    """The second lap is where the first was, which nothing tells yet."""
    lap = round_block(20, seed=0, size_m=(1.8, 1.2)).truth  # 20 steps of 0.3 m
    truth, near = np.concatenate([lap, lap]), Neighbourhood()
    for k in range(len(truth)):
        near.add(relative(k, truth[k], truth[:k]))
        assert near.same_view(k, 0.2, range(k)) is None


def test_what_is_left_out_is_stood_for_by_the_earlier_one() -> None:
    near = Neighbourhood()
    at = np.tile(np.eye(4), (5, 1, 1))
    at[:, 2, 3] = [0.0, 0.5, 1.0, 0.55, 1.05]
    for k, hosts in enumerate([[], [0], [1], [2], [3]]):
        odometry = relative(k, at[k], at[:k])
        T = np.array([se3.inverse(at[h]) @ at[k] for h in hosts]).reshape(-1, 4, 4)
        near.add(
            replace(
                odometry, hosts=np.array(hosts, np.int32), T_host_cam=T,
                information=np.tile(1e6 * np.eye(6), (len(hosts), 1, 1)),
            )
        )  # fmt: skip
        if k == 3:
            assert near.same_view(3, 0.1, range(3)) == 1
            near.leave_out(3, 1)
    around = near.around(4, 1)
    assert sorted(around) == [1, 4]
    np.testing.assert_allclose(around[1], se3.inverse(at[4]) @ at[1], atol=1e-12)
    assert near.same_view(4, 0.1, [0, 1, 2]) == 2
    assert near.same_view(4, 0.01, [0, 1, 2]) is None


def test_a_host_that_leaves_a_direction_open_is_not_linked_unless_it_is_the_newest() -> None:
    """Back in a corridor its walls are matched, but the camera may be anywhere along them."""
    truth, near = round_block(8, seed=0).truth, Neighbourhood()
    for k in range(7):
        near.add(relative(k, truth[k], truth[:k]))
    odometry = relative(7, truth[7], truth[:7])
    information = odometry.information.copy()
    information[:, 0, :] = information[:, :, 0] = 0.0
    near.add(replace(odometry, information=information))
    assert sorted(near.around(7, 1)) == [6, 7]
