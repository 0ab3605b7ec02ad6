# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The optimum of a pose graph, and what the robust kernel does with wrong loops."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from walks import LOOP, Walk, round_block  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.backend.edges import Edge, information_of, odometry_edges
from dcgs_ros.core.backend.pose_graph import Solution, optimise

LAP = 30  # keyframes of the small block
SMALL_M = (3.0, 1.5)


def edges_of(walk: Walk) -> list[Edge]:
    return [edge for odometry in walk.odometry for edge in odometry_edges(odometry)]


def loop_edge(walk: Walk, a: int, b: int, error: NDArray[np.float64] | None = None) -> Edge:
    T = se3.inverse(walk.truth[a]) @ walk.truth[b]
    T = T if error is None else T @ se3.exp(error)
    return Edge(a, b, T, information_of(LOOP), loop=True)


def lines(x: list[float]) -> NDArray[np.float64]:
    """Return poses on a line."""
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 3] = x
    return poses


def test_odometry_alone_changes_nothing() -> None:
    walk = round_block(12, seed=0)
    solution = optimise(walk.tracked, edges_of(walk), [0])
    np.testing.assert_allclose(solution.T_world_cam, walk.tracked, atol=1e-9)
    assert (solution.weights == 1.0).all()


def test_a_gap_is_shared_out_by_information() -> None:
    """On a line: 1 m + 1 m of odometry, and 2.3 m with the same information all the way."""
    W = 1e4 * np.eye(6)
    step, whole = np.eye(4), np.eye(4)
    step[0, 3], whole[0, 3] = 1.0, 2.3
    edges = [Edge(0, 1, step, W, False), Edge(1, 2, step, W, False), Edge(0, 2, whole, W, False)]
    poses = optimise(lines([0.0, 1.0, 2.0]), edges, [0]).T_world_cam
    np.testing.assert_allclose(poses, lines([0.0, 1.1, 2.2]), atol=1e-9)


def test_shares_of_one_measurement_count_as_one() -> None:
    """Two hosts with a half each against an equally sure measurement: in the middle."""
    W = 1e4 * np.eye(6)
    one, other = np.eye(4), np.eye(4)
    one[0, 3], other[0, 3] = 1.0, 1.2
    hosts = [Edge(0, 2, one, 0.5 * W, False), Edge(1, 2, one, 0.5 * W, False)]
    poses = optimise(lines([0, 0, 1]), [*hosts, Edge(0, 2, other, W, False)], [0, 1]).T_world_cam
    assert poses[2, 0, 3] == pytest.approx(1.1)


def test_fixed_poses_stay_and_the_others_follow() -> None:
    walk = round_block(10, seed=1)
    moved = walk.tracked.copy()
    motion = se3.exp(np.array([0.3, 0.1, -0.2, 0.1, 0.2, -0.3]))
    moved[0] = motion @ moved[0]
    poses = optimise(moved, edges_of(walk), [0]).T_world_cam
    np.testing.assert_allclose(poses, motion @ walk.tracked, atol=1e-6)
    np.testing.assert_array_equal(poses[0], moved[0])


def closed(seed: int, *wrong: Edge) -> tuple[Walk, Solution]:
    """Walk two laps with a loop at every third keyframe of the second, and wrong ones."""
    walk = round_block(2 * LAP, seed, SMALL_M, drift=3.0)
    rng = np.random.default_rng(100 + seed)
    loops = [walk.loop(k - LAP, k, rng) for k in range(LAP, 2 * LAP, 3)]
    edges = [Edge(one.a, one.b, one.T_a_b, information_of(LOOP), True) for one in loops]
    return walk, optimise(walk.tracked, [*edges_of(walk), *edges, *wrong], [0])


@pytest.mark.parametrize('seed', range(3))
def test_loops_correct_the_drift(seed: int) -> None:
    walk, solution = closed(seed)
    assert walk.error_m(solution.T_world_cam) < 0.6 * walk.error_m(walk.tracked)
    gaps = []
    for k in range(LAP):
        true, found = (se3.inverse(T[k]) @ T[k + LAP] for T in (walk.truth, solution.T_world_cam))
        gaps.append(np.linalg.norm(true[:3, 3] - found[:3, 3]))
    assert max(gaps) < 0.08


@pytest.mark.parametrize('seed', range(3))
def test_wrong_loops_lose_their_weight(seed: int) -> None:
    """Three that are off by a period: the poses are those without them."""
    walk = round_block(2 * LAP, seed, SMALL_M, drift=3.0)
    shift = np.array([0.0, 0.0, 2.22, 0.0, 0.0, 0.0])
    wrong = [loop_edge(walk, k - LAP, k, shift) for k in (35, 44, 51)]
    _, without = closed(seed)
    _, solution = closed(seed, *wrong)
    assert solution.weights[-3:].max() < 0.01
    assert solution.weights[:-3].min() > 0.3
    np.testing.assert_allclose(solution.T_world_cam, without.T_world_cam, atol=0.02)


@pytest.mark.parametrize('seed', range(3))
def test_many_wild_loops_do_not_take_the_right_ones_with_them(seed: int) -> None:
    """Three wrong ones for each right one, each wrong in its own way."""
    walk = round_block(5 * LAP, seed, (6.0, 3.0))
    rng = np.random.default_rng(seed)
    right = [loop_edge(walk, k - 60, k, 0.005 * rng.normal(size=6)) for k in range(60, 150, 3)]
    wild = [
        Edge(a, b, se3.exp(0.3 * rng.normal(size=6)), information_of(LOOP), loop=True)
        for a, b in np.sort(rng.integers(0, 5 * LAP, (90, 2))).tolist()
        if b - a > 10
    ]
    solution = optimise(walk.tracked, [*edges_of(walk), *right, *wild], [0])
    weights = solution.weights[len(solution.weights) - len(right) - len(wild) :]
    assert (weights[: len(right)] > 0.1).sum() > 0.9 * len(right)
    assert np.median(weights[len(right) :]) < 0.01


def test_the_same_input_gives_the_same_bytes() -> None:
    results = [
        closed(
            4,
        )[1].T_world_cam.tobytes()
        for _ in range(2)
    ]
    assert results[0] == results[1]


def test_a_graph_without_edges_or_free_poses_is_left_alone() -> None:
    poses = lines([0.0, 1.0])
    assert len(optimise(poses, [], [0, 1]).weights) == 0
    step = [Edge(0, 1, np.eye(4), np.eye(6), False)]
    np.testing.assert_array_equal(optimise(poses, step, [0, 1]).T_world_cam, poses)
