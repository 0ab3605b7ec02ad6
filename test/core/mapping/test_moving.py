# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper's map moves with its keyframes, and is optimised again where parts come together."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from test_mapper import (  # type: ignore[import-not-found]
    filled,
    frame_from,
    keyframe_from,
    mapper_for,
    poses,
    psnr,
    view_from,
)

from dcgs_ros.core import se3
from dcgs_ros.core.keyframe import Correction, KeyframePose, PosedFrame
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.mapping.splat_table import SplatTable
from dcgs_ros.core.mapping.splats import PLANES, Splats
from dcgs_ros.core.tracking.visited import origin

EXACT, FLOAT32_M = 1e-9, 3e-6
STEPS = 60
QUARTER = se3.exp(np.array([0.3, -0.2, 0.1, 0.0, 0.0, np.pi / 2]))  # axes go to axes
ANY = se3.exp(np.array([0.4, -0.3, 0.2, 0.3, -0.5, 0.2]))
GAUSSIANS, VIEWS, WORK_S = 400_000, 200, 1.0


def stamp_of(index: int) -> int:
    return frame_from(np.eye(4), index).stamp_ns


def correction_of(moved: dict[int, NDArray[np.float64]], revision: int = 1) -> Correction:
    """Correct keyframes by their index to poses."""
    stamps = np.array([stamp_of(index) for index in moved], np.int64)
    n = len(moved)
    T = np.array(list(moved.values())).reshape(-1, 4, 4)
    return Correction(revision, stamps, T, np.zeros((n, 6, 6)), np.zeros(n, np.int32))


def stepped(mapper: Mapper, steps: int = STEPS) -> list[float]:
    return [mapper.step(replay=True) for _ in range(steps)]


def test_the_map_as_seen_from_a_moved_keyframe_is_the_same() -> None:
    mapper = filled(3)
    stepped(mapper)
    before = [mapper.render(view.T_world_cam).planes.copy() for view in mapper.views]
    assert mapper.correct(correction_of({k: ANY @ T for k, T in enumerate(poses(3))})) == 3
    for view, planes in zip(mapper.views, before, strict=True):
        now = mapper.render(view.T_world_cam).planes
        assert np.mean(np.abs(now - planes) > 2e-3) < 1e-3  # the order of equal depths may change


def test_refinements_and_reach_stay_relative_to_the_trackers_world() -> None:
    mapper = filled(3)
    stepped(mapper)
    mapper.table.anchor(np.array([view.T_map_tracked for view in mapper.views]))
    corrections = mapper.corrections()
    refined = [view.correction for view in mapper.views]
    mapper.correct(correction_of({0: np.eye(4), 1: poses(3)[1], 2: ANY @ poses(3)[2]}))
    table = mapper.table
    anchors, means = table.anchors.copy(), table.splats.means.copy()
    table.anchor(np.array([view.T_map_tracked for view in mapper.views]))
    np.testing.assert_allclose(table.anchors, anchors, atol=FLOAT32_M)
    np.testing.assert_allclose(table.splats.means, means, atol=FLOAT32_M)
    for view, correction in zip(mapper.views, refined, strict=True):
        np.testing.assert_allclose(view.correction, correction, atol=EXACT)
    for view in mapper.views:  # what is interpolated in time does not know of the correction
        found = mapper.corrections().pose(view.stamp_ns + 5 * 10**7, ANY)
        np.testing.assert_allclose(
            found, corrections.pose(view.stamp_ns + 5 * 10**7, ANY), atol=EXACT
        )


def test_what_the_tracker_is_told_is_in_its_corrected_world() -> None:
    one, other = filled(3), filled(3)
    stepped(one)
    stepped(other)
    M = {0: np.eye(4), 1: ANY, 2: QUARTER}
    other.correct(correction_of({k: M[k] @ T for k, T in enumerate(poses(3))}, 7))
    old, new = one.update(), other.update()
    np.testing.assert_array_equal(old.ids, new.ids)
    motions = np.array([M[k] for k in old.ids // 1000])
    means = np.einsum('nij,nj->ni', motions[:, :3, :3], old.means) + motions[:, :3, 3]
    np.testing.assert_allclose(new.means, means, atol=FLOAT32_M)
    normals = np.einsum('nij,nj->ni', motions[:, :3, :3], old.normals)
    np.testing.assert_allclose(new.normals, normals, atol=1e-5)
    assert (old.revision, new.revision) == (0, 7)


def test_adam_goes_on_as_if_the_world_had_always_been_so() -> None:
    """A quarter turn takes axes to axes, so that variances by axis turn without loss."""
    one, other = filled(3, rates__pose_m=0.0), filled(3, rates__pose_m=0.0)
    for mapper in (one, other):
        stepped(mapper)
    other.correct(correction_of({k: QUARTER @ T for k, T in enumerate(poses(3))}))
    one._scheduler.begin_with(one.views, frozenset(range(3)))
    for _ in range(6):
        assert other.step(replay=True) == pytest.approx(one.step(replay=True), rel=1e-2)
    moved = QUARTER[:3, :3] @ one.table.splats.means + QUARTER[:3, 3:]
    distances = np.linalg.norm(moved - other.table.splats.means, axis=0)
    assert np.median(distances) < 1e-5
    reset = filled(3, rates__pose_m=0.0)
    stepped(reset)
    for name in ('first_moments', 'second_moments'):
        reset.table._columns[name][:] = 0.0
    reset._scheduler.begin_with(reset.views, frozenset(range(3)))
    stepped(reset, 6)
    apart = np.linalg.norm(reset.table.splats.means - one.table.splats.means, axis=0)
    assert np.median(apart) > 100 * np.median(distances)  # forgotten moments are noticed


def view_of(index: int, T: NDArray[np.float64], reference: KeyframePose | None) -> PosedFrame:
    return PosedFrame(frame_from(T, index), T, np.eye(4), reference=reference)


def test_a_view_goes_with_the_keyframe_it_was_placed_relative_to() -> None:
    """Which need not be the latest: a camera may be back where it was long ago."""
    mapper, T = mapper_for(), poses(5)
    mapper.insert(keyframe_from(T[0], 0, 0))
    mapper.insert(keyframe_from(T[1], 1, 1000))
    mapper.insert(view_of(2, T[2], KeyframePose(stamp_of(0), T[0])))
    mapper.insert(view_of(3, T[3], None))
    mapper.correct(correction_of({0: T[0], 1: ANY @ T[1]}))
    for index, expected in enumerate([T[0], ANY @ T[1], T[2], ANY @ T[3]]):
        np.testing.assert_allclose(mapper.views[index].T_tracked, expected, atol=EXACT)


def test_frames_from_before_a_correction_are_placed_where_their_keyframe_is_now() -> None:
    """Keyframes, and views, that a correction has overtaken; also where it came first of all."""
    mapper, T = mapper_for(), poses(4)
    mapper.correct(correction_of({0: T[0], 1: ANY @ T[1]}))
    mapper.insert(keyframe_from(T[0], 0, 0))
    mapper.insert(keyframe_from(T[1], 1, 1000))
    mapper.insert(view_of(2, T[2], KeyframePose(stamp_of(1), T[1])))
    mapper.insert(view_of(3, ANY @ T[3], KeyframePose(stamp_of(1), ANY @ T[1])))
    for index, expected in enumerate([T[0], ANY @ T[1], ANY @ T[2], ANY @ T[3]]):
        np.testing.assert_allclose(mapper.views[index].T_tracked, expected, atol=EXACT)
    hosted = mapper.table.hosts == 1
    tracked = keyframe_from(T[1], 1, 1000).moved(ANY).means
    known = np.isin(mapper.table.ids, 1000 + np.arange(len(tracked)))
    rows = mapper.table.ids[hosted & known] - 1000
    np.testing.assert_allclose(
        mapper.table.measured[:, hosted & known].T, tracked[rows], atol=FLOAT32_M
    )


def test_a_correction_counts_once_and_unnamed_keyframes_go_along_or_stay() -> None:
    mapper, T = filled(3), poses(3)
    correction = correction_of({0: T[0], 1: ANY @ T[1]})
    assert mapper.correct(correction) == 2
    planes = mapper.table.planes.copy()
    assert mapper.correct(replace(correction, revision=2)) == 0
    np.testing.assert_array_equal(mapper.table.planes, planes)
    np.testing.assert_allclose(mapper.views[2].T_tracked, ANY @ T[2], atol=EXACT)
    other = filled(3)
    assert other.correct(correction, others_stay=True) == 1
    np.testing.assert_allclose(other.views[2].T_tracked, T[2], atol=EXACT)


def test_moved_views_are_replayed_first() -> None:
    mapper, T = filled(8), poses(8)
    stepped(mapper, 13)  # amidst a round
    moved = {1, 4, 6, 7}
    mapper.correct(correction_of({k: ANY @ T[k] if k in moved else T[k] for k in range(8)}))
    visits = [view.visits for view in mapper.views]
    for chosen in (moved, set(range(8)) - moved):
        stepped(mapper, 4)
        now = [view.visits for view in mapper.views]
        assert {k for k in range(8) if now[k] > visits[k]} == chosen
        visits = now


def along(index: int) -> NDArray[np.float64]:
    """Eight places along the walls, the images of neighbours half the same."""
    return se3.exp(np.array([0.3 * (index - 3.5), 0.02 * (index % 3), 0.0, 0.0, 0.0, 0.0]))


def in_halves(drift: NDArray[np.float64]) -> Mapper:
    """Map from eight places, of which the second half is displaced in the world."""
    mapper = mapper_for()
    for k in range(8):
        tracked = drift @ along(k) if k >= 4 else along(k)
        mapper.insert(keyframe_from(along(k), k, 1000 * k, T_tracked=tracked))
    return mapper


def quality(mapper: Mapper) -> NDArray[np.float64]:
    """PSNR of each view."""
    truths = [view_from(along(k))[0] for k in range(8)]
    views = zip(mapper.views, truths, strict=True)
    return np.array([psnr(mapper, view.T_world_cam, truth) for view, truth in views])


@pytest.mark.slow
def test_after_a_correction_the_seam_becomes_as_good_as_elsewhere() -> None:
    """Two halves of one wall, 8 cm and 3 degrees apart, come together."""
    mapper = in_halves(se3.exp(np.array([0.08, 0.02, -0.03, 0.0, 0.05, 0.02])))
    stepped(mapper, 400)
    before = quality(mapper)
    mapper.correct(correction_of({k: along(k) for k in range(8)}))
    at_once = quality(mapper)
    rows = [at_once]
    for _ in range(6):
        stepped(mapper, 100)
        rows.append(quality(mapper))
    clean = in_halves(np.eye(4))
    stepped(clean, 1000)
    for row in (before, *rows, quality(clean)):
        print(row.round(1), row[3:5].mean().round(1), row[[0, 1, 6, 7]].mean().round(1))
    later = rows[-1]
    assert later[3:5].mean() > at_once[3:5].mean() + 3.0
    assert later[3:5].mean() > later[[0, 1, 6, 7]].mean() - 1.0


def test_a_large_map_moves_at_once() -> None:
    rng = np.random.default_rng(0)
    table = SplatTable()
    planes = rng.normal(size=(len(PLANES), GAUSSIANS)).astype(np.float32)
    hosts = np.sort(rng.integers(0, VIEWS, GAUSSIANS)).astype(np.int32)
    table.append(
        Splats(planes), np.arange(GAUSSIANS), 0, planes[:3].copy(),
        np.ones(GAUSSIANS, np.float32),
    )  # fmt: skip
    table.hosts[:] = hosts
    motions = np.array([se3.exp(xi) for xi in rng.normal(scale=0.1, size=(VIEWS, 6))])
    taken = []
    for _ in range(3):
        start = time.perf_counter()
        table.move(motions, motions, np.ones(VIEWS, np.bool_))
        taken.append(time.perf_counter() - start)
    print('s', min(taken))
    assert min(taken) < WORK_S


def test_a_sub_map_far_away_is_mapped_as_well_and_disturbs_nobody() -> None:
    """It shows in no view of the map: not even in those that look towards it past all walls."""
    there = np.eye(4)
    there[:3, 3] = origin(1)
    alone, far, both = mapper_for(), mapper_for(), mapper_for()
    T = poses(2)
    for k in range(2):
        alone.insert(keyframe_from(T[k], k, 1000 * k))
        far.insert(keyframe_from(T[k], k, 1000 * k, T_tracked=there @ T[k]))
        both.insert(keyframe_from(T[k], k, 1000 * k))
    for k in range(2):
        both.insert(keyframe_from(T[k], 2 + k, 1000 * (2 + k), T_tracked=there @ T[k]))
    for mapper in (alone, far):
        stepped(mapper, 2 * STEPS)
    truth = view_from(T[0])[0]
    here_db, there_db = (psnr(m, m.views[0].T_world_cam, truth) for m in (alone, far))
    print('dB', here_db, there_db)
    assert there_db > here_db - 0.5
    towards = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0]))  # its z is the world's x
    towards[:3, 3] = 10.0, 0.0, 0.0  # beyond the walls
    np.testing.assert_array_equal(both.render(towards).transmittance, 1.0)
    count = len(both.table)
    both.prune()
    assert len(both.table) == count
