# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which keyframes hold a pose: a corridor's walls do not hold it along the corridor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core.tracking.factors import PointFactors, Targets, covariances_along_rays
from dcgs_ros.core.tracking.hosting import Hosts, hosts_of
from dcgs_ros.core.tracking.registration import Registration

ALONG = 2  # the axis of the corridor
WALLS = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])  # two walls and the floor


def seen(points: NDArray[np.float64], hosts: list[int], sigma_m: float) -> PointFactors:
    """Return exact matches of isotropic points with Gaussians of `hosts`."""
    n = len(points)
    variance = np.full(n, 0.5 * sigma_m**2, np.float32)
    targets = Targets(
        points.astype('f4'), np.tile(np.array([0, 0, 1], 'f4'), (n, 1)), variance, variance,
        np.array(hosts, np.int32),
    )  # fmt: skip
    D = covariances_along_rays(points, variance, variance)
    return PointFactors(points.astype('f4'), D, targets)


def corridor(
    wall_hosts: list[int], corner_hosts: list[int], seed: int = 0
) -> tuple[Hosts, NDArray[np.float64]]:
    """Return the hosts of a camera in a corridor, its walls and corners of these, and C."""
    rng = np.random.default_rng(seed)
    n = 300
    kinds = rng.integers(3, size=n)
    points = rng.uniform([-1, -1, 1], [1, 1, 5], size=(n, 3))
    points[kinds == 0, 0], points[kinds == 1, 0], points[kinds == 2, 1] = -1, 1, 1
    depth = seen(points, rng.choice(wall_hosts, n).tolist(), 0.01)
    normals = [WALLS[kinds] + rng.normal(scale=0.05, size=(n, 3)) for _ in range(2)]
    corners = seen(rng.uniform([-1, -1, 1], [1, 1, 5], size=(12, 3)), corner_hosts * 4, 0.01)
    equations = depth.normal_equations(np.eye(4))
    found = Registration(np.eye(4), depth, corners, equations, None, equations, n, 1.0)
    J = np.concatenate([np.hstack([m, np.cross(points, m)]) / 0.01 for m in normals], axis=1)
    H = sum(
        np.outer(row, row) for row in np.hstack([WALLS[kinds], np.cross(points, WALLS[kinds])])
    )
    covariance = np.linalg.inv(1e4 * H + corners.normal_equations(np.eye(4)).H)
    return hosts_of(found, J, covariance, 9), covariance


def test_the_hosts_information_adds_up() -> None:
    hosts, C = corridor([1, 2, 5], [5, 7, -1])
    assert hosts.keyframes.tolist() == [1, 2, 5, 7, 9]
    whole = np.linalg.inv(C)
    np.testing.assert_allclose(hosts.information.sum(axis=0), whole, atol=1e-4 * whole.max())
    for information in hosts.information:
        assert np.linalg.eigvalsh(information)[0] > -1e-6 * whole.max()


def test_walls_do_not_hold_along_them() -> None:
    hosts, C = corridor([1], [7, 7, 7])
    told = dict(zip(hosts.keyframes.tolist(), hosts.information, strict=True))
    whole = np.linalg.inv(C)
    assert told[1][0, 0] > 0.8 * whole[0, 0] and told[1][1, 1] > 0.8 * whole[1, 1]
    assert told[7][ALONG, ALONG] > 0.9 * whole[ALONG, ALONG]
    assert told[1][ALONG, ALONG] < 0.1 * whole[ALONG, ALONG]


def test_noise_of_normals_holds_nothing() -> None:
    """A plane in front of the camera, which many noisy normals see."""
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-1, 1, (2000, 2)), np.full(2000, 2.0)])
    depth = seen(points, [0] * 2000, 0.01)
    normals = np.array([0, 0, -1]) + rng.normal(scale=0.2, size=(2, 2000, 3))
    rows = np.concatenate([np.hstack([m, np.cross(points, m)]) / 0.01 for m in normals], axis=1)
    equations = depth.normal_equations(np.eye(4))
    found = Registration(np.eye(4), depth, None, equations, None, equations, 2000, 1.0)
    hosts = hosts_of(found, rows, 1e-4 * np.eye(6), 9)
    told = dict(zip(hosts.keyframes.tolist(), hosts.information, strict=True))
    assert told[0][2, 2] > 0.99e4
    assert told[9][0, 0] > 0.99e4


def test_what_nothing_holds_goes_on_from_the_last_keyframe() -> None:
    none = np.empty((0, 3))
    depth, rows, C = seen(none, [], 0.01), np.empty((0, 12)), 1e-4 * np.eye(6)
    equations = depth.normal_equations(np.eye(4))
    found = Registration(np.eye(4), depth, None, equations, None, equations, 0, np.inf)
    hosts = hosts_of(found, rows, C, 4)
    assert hosts.keyframes.tolist() == [4]
    np.testing.assert_allclose(hosts.information[0], np.linalg.inv(C), rtol=1e-6)


def test_a_slide_adds_up_though_most_matches_are_of_the_first_keyframe() -> None:
    """Each keyframe matches the walls of the first, and corners of the one before."""
    hosts, _ = corridor([0], [1, 1, 1])
    theirs = np.array([np.zeros((6, 6)), 0.04 * np.eye(6)])
    assert hosts.keyframes.tolist() == [0, 1, 9]
    found = Hosts(hosts.keyframes[:2], hosts.information[:2]).inherited(theirs)
    assert found[ALONG, ALONG] > 0.9 * 0.04


def test_back_at_old_keyframes_new_ones_do_not_matter() -> None:
    hosts, C = corridor([0, 6], [0, 0, 6])
    theirs = np.array([np.zeros((6, 6)), 0.04 * np.eye(6), 0.04 * np.eye(6)])
    assert hosts.keyframes.tolist() == [0, 6, 9]
    assert np.trace(hosts.inherited(theirs)) < 4.0 * np.trace(C)


def test_of_many_hosts_those_that_hold_most_are_kept() -> None:
    hosts, C = corridor(list(range(8)), [9, 20, 20])
    assert len(hosts.keyframes) == 6 and {9, 20} < set(hosts.keyframes.tolist())
    whole = np.linalg.inv(C)
    np.testing.assert_allclose(hosts.information.sum(axis=0), whole, atol=1e-4 * whole.max())


def test_a_host_that_may_be_beside_the_last_keyframe_holds_nothing() -> None:
    """It is matched by chance; what it seems to tell is left to the newest of the others."""
    hosts = Hosts(np.array([0, 7, 8], np.int32), np.tile(np.eye(6), (3, 1, 1)))
    theirs = np.array([np.zeros((6, 6)), 0.039 * np.eye(6), 0.04 * np.eye(6)])
    kept = hosts.within_reach(theirs, theirs[2], 0.12)
    assert kept.keyframes.tolist() == [7, 8]
    np.testing.assert_array_equal(kept.information, np.array([[[1.0]], [[2.0]]]) * np.eye(6))
    assert hosts.within_reach(theirs, theirs[2], 0.3).keyframes.tolist() == [0, 7, 8]


def test_a_camera_that_was_found_in_the_old_part_is_not_held_by_where_it_had_drifted() -> None:
    hosts = Hosts(np.array([0, 7, 8], np.int32), np.tile(np.eye(6), (3, 1, 1)))
    theirs = np.array([np.zeros((6, 6)), 0.039 * np.eye(6), 0.04 * np.eye(6)])
    kept = hosts.within_reach(theirs, theirs[0], 0.12)
    assert kept.keyframes.tolist() == [0]
    np.testing.assert_array_equal(kept.information[0], 3.0 * np.eye(6))
