# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which loops are believed, on two laps round a block."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from walks import LOOP, PERIOD_M, Loop, Walk, round_block  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.backend.certainty import steps
from dcgs_ros.core.backend.consistency import Consistency, Surroundings
from dcgs_ros.core.backend.keyframe_graph import KeyframeGraph

LAP = 120
SIZE_M = (12.0, 6.0)
SURE, UNSURE, LOST = 0.25, 1.0, 5.0  # drift: the prior's sigma is 6 cm, 20 cm, 1 m after a lap


def believed(walk: Walk, loops: Sequence[Loop]) -> list[Loop]:
    """Return what is believed of loops that are found one after another."""
    graph, consistency = KeyframeGraph(), Consistency()
    for keyframe in walk.keyframes():
        assert keyframe.odometry is not None
        graph.add(keyframe.frame.stamp_ns, keyframe.T_world_cam, keyframe.odometry)
    found: list[Loop] = []
    for loop in loops:
        consistency.add(loop, graph.poses, graph.steps())
        new = consistency.decide(graph.poses)
        graph.believe(new)
        if new:
            graph.optimise()
        found += [one for one in loops if any(one is other for other in new)]
    return found


def same(some: Sequence[Loop], others: Sequence[Loop]) -> bool:
    return [id(one) for one in some] == [id(one) for one in others]


def right(walk: Walk, keyframes: Sequence[int], seed: int = 0) -> list[Loop]:
    rng = np.random.default_rng(seed)
    return [walk.loop(k - LAP, k, rng) for k in keyframes]


def shifted(walk: Walk, keyframes: Sequence[int], shift_m: float, seed: int = 1) -> list[Loop]:
    """Return wrong loops that agree among themselves: the floor repeats itself."""
    rng = np.random.default_rng(seed)
    return [walk.loop(k - LAP, k, rng, shift_m) for k in keyframes]


def sigma_m(walk: Walk) -> float:
    loop = right(walk, [LAP + 5])[0]
    around = Surroundings.of(loop, walk.tracked, steps(walk.tracked, walk.odometry))
    return around.prior(loop).sigma_m


def test_the_walks_are_as_sure_as_their_names_say() -> None:
    sigmas = [sigma_m(round_block(2 * LAP, 0, SIZE_M, drift)) for drift in (SURE, UNSURE, LOST)]
    assert sigmas[0] < 0.1 and 0.15 < sigmas[1] < 0.3 and sigmas[2] > 0.8


@pytest.mark.parametrize('seed', range(3))
def test_a_lone_loop_is_believed_where_nothing_else_is_possible(seed: int) -> None:
    walk = round_block(LAP + 22, seed, SIZE_M, SURE)
    assert len(believed(walk, right(walk, [LAP + 5], seed))) == 1


@pytest.mark.parametrize('seed', range(3))
def test_a_lone_loop_waits_where_the_odometry_is_not_sure(seed: int) -> None:
    walk = round_block(LAP + 22, seed, SIZE_M, UNSURE)
    loops = right(walk, range(LAP + 1, LAP + 20, 2), seed)
    assert believed(walk, loops[:1]) == []
    assert same(believed(walk, loops), loops)


def test_views_that_are_not_apart_are_one() -> None:
    """However often the same two places are compared."""
    walk = round_block(LAP + 22, 0, SIZE_M, UNSURE)
    loops = right(walk, [LAP + 5] * 12) + right(walk, [LAP + 6] * 12)
    assert believed(walk, loops) == []


@pytest.mark.parametrize(('every', 'enough'), [(1, 6), (2, 4)])
def test_how_many_views_are_enough_follows_from_how_vague_odometry_is(
    every: int, enough: int
) -> None:
    """Keyframes are 0.3 m apart: views that overlap count in part. A metre asks for 3.7 views."""
    walk = round_block(LAP + 22, 0, SIZE_M, LOST)
    loops = right(walk, range(LAP + 1, LAP + 1 + every * enough, every))
    assert believed(walk, loops[:-1]) == []
    assert same(believed(walk, loops), loops)


@pytest.mark.parametrize('seed', range(3))
def test_the_impossible_is_never_believed(seed: int) -> None:
    """Off by a period of the floor, and in agreement with each other."""
    walk = round_block(LAP + 22, seed, SIZE_M, SURE)
    assert believed(walk, shifted(walk, range(LAP + 1, LAP + 18), PERIOD_M)) == []


@pytest.mark.parametrize('seed', range(3))
def test_between_two_stories_none_is_believed(seed: int) -> None:
    """Right and shifted loops at the same views, both possible."""
    walk = round_block(LAP + 22, seed, SIZE_M, LOST)
    views = range(LAP + 1, LAP + 18)
    pairs = zip(right(walk, views, seed), shifted(walk, views, 0.6), strict=True)
    assert believed(walk, [loop for pair in pairs for loop in pair]) == []


@pytest.mark.parametrize('seed', range(4))
def test_odometry_decides_between_two_stories_where_it_can(seed: int) -> None:
    """A period off is hardly possible, or not at all: then the right one is believed, or none."""
    walk = round_block(LAP + 22, seed, SIZE_M, LOST)
    views = range(LAP + 1, LAP + 18)
    wrong = shifted(walk, views, PERIOD_M)
    pairs = zip(right(walk, views, seed), wrong, strict=True)
    found = believed(walk, [loop for pair in pairs for loop in pair])
    assert len(found) in (0, len(views))
    assert not any(one is other for one in found for other in wrong)


@pytest.mark.parametrize('seed', range(3))
def test_the_story_that_most_views_tell_is_believed(seed: int) -> None:
    """And the other one is not, even when it goes on."""
    walk = round_block(LAP + 22, seed, SIZE_M, UNSURE)
    wrong = shifted(walk, [LAP + 2, LAP + 3], 0.3)
    loops = right(walk, range(LAP + 1, LAP + 18), seed)
    assert same(believed(walk, wrong + loops), loops)


def test_loops_that_agree_by_chance_do_not_support_each_other() -> None:
    """Wrong by different ways: each is possible, none is confirmed."""
    walk = round_block(LAP + 22, 0, SIZE_M, LOST)
    rng = np.random.default_rng(2)
    loops = [walk.loop(k - LAP, k, rng, rng.uniform(-2, 2)) for k in range(LAP + 1, LAP + 18)]
    assert believed(walk, loops) == []


def test_what_is_vague_between_two_loops_does_not_make_them_agree() -> None:
    """They are so far apart that the odometry between them allows for their errors."""
    walk = round_block(LAP + 60, 0, SIZE_M, LOST)
    rng = np.random.default_rng(3)
    views = range(LAP + 1, LAP + 58, 7)
    loops = [walk.loop(k - LAP, k, rng, rng.uniform(-0.15, 0.15)) for k in views]
    assert believed(walk, loops) == []


def test_the_same_shift_on_the_other_side_makes_a_story_doubtful() -> None:
    """Impossible loops one period farther: possible ones may be a period too far themselves."""
    walk = round_block(LAP + 22, 0, SIZE_M, UNSURE)
    views = list(range(LAP + 1, LAP + 8))
    possible, impossible = shifted(walk, views, 0.3), shifted(walk, views, 0.6)
    assert same(believed(walk, possible), possible)
    assert believed(walk, [*impossible, *possible]) == []


def test_the_prediction_of_one_loop_by_another_has_an_honest_covariance() -> None:
    """The mean of chi-square is at most its 6 degrees of freedom: the bounds are wider."""
    chi2 = []
    for seed in range(20):
        walk = round_block(LAP + 22, seed, SIZE_M)
        one, other = right(walk, [LAP + 5, LAP + 9], seed)
        around = Surroundings.of(one, walk.tracked, steps(walk.tracked, walk.odometry))
        chi2.append([around.pair(one, other).chi2, around.prior(one).chi2])
    assert (1.0 < np.mean(chi2, axis=0)).all() and (np.mean(chi2, axis=0) < 7.0).all()


def test_the_gap_of_a_pair_is_zero_without_noise() -> None:
    walk = round_block(LAP + 22, 0, SIZE_M)
    T = walk.truth
    loops = [Loop(a, b, se3.inverse(T[a]) @ T[b], LOOP, 100) for a, b in ((3, 130), (9, 140))]
    around = Surroundings.of(loops[0], T, steps(T, walk.odometry))
    np.testing.assert_allclose(around.pair(*loops).xi, 0.0, atol=1e-9)
    np.testing.assert_allclose(around.prior(loops[0]).xi, 0.0, atol=1e-9)
