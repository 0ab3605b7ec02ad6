# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The back end, with loops that are given instead of found."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from walks import LOOP, ODOMETRY, Loop, Walk, first, keyframe, relative, round_block  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.backend.back_end import BackEnd, BackEndError
from dcgs_ros.core.backend.features import Features
from dcgs_ros.core.backend.places import Places
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.keyframe import Correction, Keyframe
from dcgs_ros.core.tracking.visited import Visited, origin

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
LAP = 60
SIZE_M = (6.0, 3.0)


class Given:
    """Finds the loops that it was given, and knows no places."""

    def __init__(self, loops: Sequence[Loop] = ()) -> None:
        self.loops = loops
        self.keyframes = 0
        self.features: list[Features | None] = []  # that were known
        self.places = Places(CAMERA, Config())

    def add(
        self,
        keyframe: Keyframe,
        camera: PinholeCamera | None = None,
        features: Features | None = None,
    ) -> None:
        self.keyframes += 1
        self.features.append(features)

    def close(self, keyframe: int) -> list[Loop]:
        assert keyframe == self.keyframes - 1
        return [loop for loop in self.loops if loop.b == keyframe]


def two_laps(seed: int, drift: float = 1.0) -> tuple[Walk, list[Loop]]:
    walk = round_block(LAP + 30, seed, SIZE_M, drift)
    rng = np.random.default_rng(seed)
    return walk, [walk.loop(k - LAP, k, rng) for k in range(LAP + 2, LAP + 30, 3)]


def fed(back_end: BackEnd, walk: Walk) -> list[Correction]:
    """Return the corrections of a walk."""
    corrections = []
    for one in walk.keyframes():
        back_end.add(one)
        correction = back_end.work()
        if correction is not None:
            corrections.append(correction)
    return corrections


def test_without_loops_nothing_is_corrected() -> None:
    walk, _ = two_laps(0)
    back_end = BackEnd(CAMERA, Config(), Given())
    assert fed(back_end, walk) == []
    np.testing.assert_allclose(back_end.poses, walk.tracked, atol=1e-9)
    np.testing.assert_allclose(back_end.optimised().T_world_cam, walk.tracked, atol=1e-6)


@pytest.mark.parametrize('seed', range(3))
def test_loops_correct_the_poses(seed: int) -> None:
    walk, loops = two_laps(seed, drift=2.0)
    back_end = BackEnd(CAMERA, Config(), Given(loops))
    corrections = fed(back_end, walk)
    assert [one.revision for one in corrections] == list(range(1, len(corrections) + 1))
    assert len(back_end.loops) == len(loops) and back_end.rejected == ()
    final = back_end.optimised()
    gaps = [
        np.linalg.norm(se3.log(se3.inverse(final.T_world_cam[k - LAP]) @ final.T_world_cam[k]
                               @ se3.inverse(walk.truth[k]) @ walk.truth[k - LAP])[:3])
        for k in range(LAP, LAP + 30)
    ]  # fmt: skip
    assert max(gaps) < 0.15
    assert walk.error_m(final.T_world_cam) < walk.error_m(walk.tracked)
    np.testing.assert_array_equal(final.stamps_ns, 10**9 * np.arange(1, LAP + 31))


def test_keyframes_that_waited_are_corrected_at_once() -> None:
    """The loops are of some in the middle, none of the last one."""
    walk, loops = two_laps(1, drift=2.0)
    back_end = BackEnd(CAMERA, Config(), Given(loops[:4]))
    for one in walk.keyframes():
        back_end.add(one)
    assert back_end.keyframes == 0
    correction = back_end.work()
    assert correction is not None and len(correction.stamps_ns) == LAP + 30
    assert back_end.work() is None


def test_later_keyframes_start_from_the_back_ends_own_poses() -> None:
    """Not from the tracker's world, to which no correction was applied here."""
    walk, loops = two_laps(1, drift=2.0)
    back_end = BackEnd(CAMERA, Config(), Given(loops[:4]))
    fed(back_end, walk)
    last = walk.odometry[-1]
    expected = back_end.poses[last.hosts[0]] @ last.T_host_cam[0]
    np.testing.assert_allclose(back_end.poses[-1], expected, atol=1e-9)
    assert np.abs(back_end.poses[-1] - walk.tracked[-1]).max() > 0.02


@pytest.mark.parametrize('error_m', [5e-4, 3.2e-3])
def test_what_is_not_notable_in_the_map_is_not_told(error_m: float) -> None:
    """Loops that agree with the odometry to a millimetre, or within its sigma, count all the same.

    The latter move the poses.
    """
    walk, _ = two_laps(2)
    T, error = walk.tracked, se3.exp(np.repeat([error_m, 0.0], 3))
    loops = [
        Loop(k - LAP, k, se3.inverse(T[k - LAP]) @ T[k] @ error, LOOP, inliers=100)
        for k in range(LAP + 2, LAP + 20, 3)
    ]
    back_end = BackEnd(CAMERA, Config(), Given(loops))
    assert fed(back_end, walk) == []
    assert len(back_end.loops) == len(loops)


def test_a_correction_makes_the_end_surer() -> None:
    walk, loops = two_laps(3, drift=2.0)
    without, closed = BackEnd(CAMERA, Config(), Given()), BackEnd(CAMERA, Config(), Given(loops))
    for back_end in (without, closed):
        fed(back_end, walk)
    before, after = (one.optimised().covariances for one in (without, closed))
    np.testing.assert_array_equal(before[0], 0.0)
    for covariances in (before, after):
        assert (np.linalg.eigvalsh(covariances[1:])[:, 0] > 0.0).all()
    assert np.trace(after[LAP + 5][3:, 3:]) < 0.5 * np.trace(before[LAP + 5][3:, 3:])


def in_two_submaps(seed: int) -> tuple[list[Keyframe], NDArray[np.float64], list[Loop]]:
    """Return a walk that was lost in the middle, the truth, and loops between its halves."""
    walk = round_block(LAP, seed, (3.0, 1.5))  # two laps of 30
    T = walk.tracked.copy()
    apart = np.eye(4)
    apart[:3, 3] = origin(1)
    T[30:] = apart @ se3.exp(np.array([1.0, 2.0, 0.0, 0.3, 0.0, 0.5])) @ T[30:]
    odometry = list(walk.odometry[:30])
    odometry += [replace(first(30, submap=1))]
    odometry += [relative(k, T[k], T, ODOMETRY, submap=1, begin=30) for k in range(31, LAP)]
    rng = np.random.default_rng(seed)
    loops = [walk.loop(k - 30, k, rng) for k in range(32, LAP)]
    return [keyframe(k, T[k], odometry[k]) for k in range(LAP)], walk.truth, loops


def test_loops_join_submaps() -> None:
    """The younger one moves into the world of the older one, and its covariance is finite."""
    keyframes, truth, loops = in_two_submaps(0)
    back_end = BackEnd(CAMERA, Config(), Given(loops))
    corrections = []
    visited = Visited()
    for one in keyframes:
        odometry = one.odometry
        assert odometry is not None
        T, submap = one.T_world_cam, odometry.submap
        if len(odometry.hosts):  # tracked in the corrected map
            T = visited.poses[odometry.hosts[-1]] @ odometry.T_host_cam[-1]
            submap = visited.submaps[odometry.hosts[-1]]
        visited.add(one.frame.stamp_ns, T, replace(odometry, submap=submap), np.eye(6))
        back_end.add(one)
        correction = back_end.work()
        if correction is not None:
            visited.correct(correction)
            corrections.append(correction)
    joined = next(one for one in corrections if one.submaps.max() == 0)
    assert len(joined.submaps) > 31
    assert np.abs(np.array(visited.poses)[:, :3, 3] - truth[:, :3, 3]).max() < 0.15
    assert set(visited.submaps) == {0}
    final = back_end.optimised()
    assert np.abs(final.T_world_cam[:, :3, 3] - truth[:, :3, 3]).max() < 0.15
    assert final.covariances.max() < 1.0


def test_submaps_stay_apart_until_several_views_join_them() -> None:
    keyframes, _, loops = in_two_submaps(1)
    back_end = BackEnd(CAMERA, Config(), Given(loops[:2]))
    for one in keyframes:
        back_end.add(one)
        assert back_end.work() is None
    final = back_end.optimised()
    assert final.submaps.tolist() == [0] * 30 + [1] * 30
    assert final.covariances[30:, 0, 0].min() >= 1e6


def test_restored_keyframes_stay_as_they_are_to_each_other() -> None:
    walk, loops = two_laps(4, drift=2.0)
    back_end = BackEnd(CAMERA, Config(), Given(loops))
    back_end._finder.keyframes = LAP  # type: ignore[attr-defined]
    back_end.restore([10**9 * (k + 1) for k in range(LAP)], walk.truth[:LAP])
    for k in range(LAP, LAP + 30):
        odometry = relative(k, walk.tracked[k], walk.tracked)
        back_end.add(keyframe(k, walk.tracked[k], odometry))
        back_end.work()
    assert back_end.keyframes == LAP + 30
    final = back_end.optimised().T_world_cam
    np.testing.assert_array_equal(final[:LAP], walk.truth[:LAP])
    assert np.abs(final[LAP + 2 :] - walk.truth[LAP + 2 :])[:, :3, 3].max() < 0.1
    with pytest.raises(BackEndError, match='90 keyframes already'):
        back_end.restore([0], walk.truth[:1])


def test_restored_keyframes_come_with_the_features_that_are_known() -> None:
    walk, _ = two_laps(0)
    known = Features(
        np.zeros((1, 32), np.uint8), np.zeros((1, 2), np.float32), np.ones(1, np.float32)
    )
    finder, stamps = Given(), [10**9 * (k + 1) for k in range(3)]
    BackEnd(CAMERA, Config(), finder).restore(
        stamps, walk.truth[:3], keyframes=list(walk.keyframes())[:3], features={1: known}
    )
    assert finder.features == [None, known, None]


def test_restored_submaps_stay_apart_until_loops_join_them() -> None:
    keyframes, truth, loops = in_two_submaps(0)
    known, new = keyframes[:45], keyframes[45:]
    odometries = [one.odometry for one in known]
    submaps = [0 if one is None else one.submap for one in odometries]
    T = np.array([one.T_world_cam for one in known])
    back_end = BackEnd(CAMERA, Config(), Given(loops))
    back_end._finder.keyframes = 45  # type: ignore[attr-defined]
    back_end.restore([one.frame.stamp_ns for one in known], T, submaps)
    corrections = []
    for one in new:
        back_end.add(one)
        correction = back_end.work()
        corrections += [] if correction is None else [correction]
    joined = corrections[0]
    assert joined.submaps.max() == 0 and joined.covariances.max() < 1.0
    np.testing.assert_array_equal(joined.T_world_cam[:30], T[:30])
    between = se3.inverse(T[30]) @ T[44]
    moved = se3.inverse(joined.T_world_cam[30]) @ joined.T_world_cam[44]
    np.testing.assert_allclose(moved, between, atol=1e-9)  # a sub-map moves as a whole
    assert np.abs(joined.T_world_cam[30:45, :3, 3] - truth[30:45, :3, 3]).max() < 0.3


def test_keyframes_without_images_are_placed_and_no_loop_is_looked_for() -> None:
    walk, loops = two_laps(4, drift=2.0)
    finder = Given(loops)
    back_end = BackEnd(CAMERA, Config(), finder)
    bare = [one.without_image() for one in walk.keyframes()]
    for one in bare[:3]:
        back_end.add(one)
        assert back_end.work() is None
    assert back_end.keyframes == 3 and finder.keyframes == 0
    assert not any(one.has_image for one in bare)


def test_keyframes_come_in_their_order_and_with_odometry() -> None:
    walk, _ = two_laps(0)
    keyframes = list(walk.keyframes())
    back_end = BackEnd(CAMERA, Config(), Given())
    back_end.add(keyframes[1])
    with pytest.raises(BackEndError, match='keyframe 1 follows 0 others'):
        back_end.work()
    back_end.add(replace(keyframes[0], odometry=None))
    with pytest.raises(BackEndError, match='keyframe 0 comes without'):
        back_end.work()


def test_the_same_keyframes_give_the_same_bytes() -> None:
    walk, loops = two_laps(5, drift=2.0)
    runs = []
    for _ in range(2):
        back_end = BackEnd(CAMERA, Config(), Given(loops))
        told = [
            one.T_world_cam.tobytes() + one.covariances.tobytes() for one in fed(back_end, walk)
        ]
        runs.append([*told, back_end.optimised().T_world_cam.tobytes()])
    assert runs[0] == runs[1]


def test_the_warm_up_runs_every_kernel() -> None:
    code = (
        'from dcgs_ros.core.backend.certainty import _relax\n'
        'from dcgs_ros.core.backend.keyframe_graph import warm_up\n'
        'from dcgs_ros.core.backend.linearisation import accumulate, chi2, residuals, step\n'
        'warm_up()\n'
        'for kernel in (_relax, accumulate, chi2, residuals, step):\n'
        '    assert kernel.nopython_signatures, kernel\n'
    )
    subprocess.run([sys.executable, '-c', code], check=True)
