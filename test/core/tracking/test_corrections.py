# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A map that moves with its keyframes, and sub-maps that are joined by that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction
from dcgs_ros.core.tracking.claims import Clocks, PoseClaims
from dcgs_ros.core.tracking.gaussian_map import GaussianMap
from dcgs_ros.core.tracking.hosting import Hosts
from dcgs_ros.core.tracking.relocalization import Recognition
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.tracking.visited import UNKNOWN, Visited, origin
from dcgs_ros.datasets.synthetic.source import SyntheticSource

ROOM = 'synthetic:room?frames=24&sensor=kinect&speed=2'
ELSEWHERE = 'synthetic:zigzag?frames=30&sensor=kinect'
KEYFRAMES = {'keyframes.min_interval_s': 0.0, 'keyframes.translation_m': 0.03}
SAME_M, SAME_RAD = 1e-3, np.radians(0.05)  # float32 numbers of another world are rounded otherwise
G = se3.exp(np.array([0.3, -0.2, 0.1, 0.05, 0.4, -0.1]))
SHIFT = se3.exp(np.array([0.05, 0.0, 0.02, 0.0, 0.03, 0.0]))


@cache
def source_of(address: str) -> SyntheticSource:
    return SyntheticSource.from_address(address)


@cache
def frames_of(address: str) -> tuple[RgbdFrame, ...]:
    return tuple(source_of(address))


def tracker_for(**settings: float | None) -> Tracker:
    source = source_of(ROOM)
    return Tracker(
        source.camera, override(Config(sensor=source.sensor), {**KEYFRAMES, **settings})
    )


def correction(tracker: Tracker, motions: NDArray[np.float64], submap: int = 0) -> Correction:
    """Move the first keyframes of a tracker by `motions` (K, 4, 4)."""
    count = len(motions)
    return Correction(
        1, np.arange(count), motions @ tracker.keyframe_poses[:count],
        np.tile(1e-6 * np.eye(6), (count, 1, 1)), np.full(count, submap, np.int32),
    )  # fmt: skip


def assert_same(T: NDArray[np.float64], other: NDArray[np.float64]) -> None:
    xi = se3.log(se3.inverse(T) @ other)
    assert np.linalg.norm(xi[:3]) < SAME_M and np.linalg.norm(xi[3:]) < SAME_RAD


def test_a_map_that_moves_as_a_whole_changes_nothing_else() -> None:
    frames, biased = frames_of(ROOM), {'sensor.depth_bias': 0.01}
    still, moved = tracker_for(**biased), tracker_for(**biased)
    for frame in frames[:14]:
        expected, found = still.track(frame), moved.track(frame)
    assert moved.keyframes >= 3
    moved.correct(correction(moved, np.tile(G, (moved.keyframes, 1, 1))))
    assert_same(moved.T_world_cam, G @ still.T_world_cam)
    limit = cast(Any, moved)._claims.limit  # what it leads to shows where nothing is measured
    np.testing.assert_allclose(limit.T_world_cam, moved.T_world_cam, atol=1e-9)
    for frame in frames[14:]:
        expected, found = still.track(frame), moved.track(frame)
        assert found.state is expected.state and found.keyframe == expected.keyframe
        assert_same(found.T_world_cam, G @ expected.T_world_cam)
        assert found.landmarks == pytest.approx(expected.landmarks, abs=6)
        assert found.reference is not None and found.reference.revision == 1
        assert_same(found.reference.T_uncorrected_world @ found.T_world_cam, expected.T_world_cam)
        np.testing.assert_allclose(
            np.sqrt(np.diag(found.covariance)), np.sqrt(np.diag(expected.covariance)), rtol=0.02
        )
        for keyframe, other in zip(found.keyframes, expected.keyframes, strict=True):
            assert keyframe.odometry is not None and other.odometry is not None
            assert_same(keyframe.odometry.T_host_cam[0], other.odometry.T_host_cam[0])

    assert still.depth_bias.any()
    np.testing.assert_allclose(moved.depth_bias, still.depth_bias, atol=2e-4)


def test_a_correction_alone_makes_no_keyframe() -> None:
    """The next one waits until the camera has moved, from where the last one is now."""
    usual = {'keyframes.translation_m': 0.3, 'keyframes.rotation_rad': 0.5}
    usual |= {'keyframes.overlap': 0.3, 'keyframes.landmarks': 0.1}
    still, moved = tracker_for(**usual), tracker_for(**usual)
    frames = frames_of(ROOM)
    for frame in frames[:4]:
        still.track(frame)
        moved.track(frame)
    moved.correct(correction(moved, np.tile(G, (moved.keyframes, 1, 1))))
    expected, found = (
        [tracker.track(frame).keyframe for frame in frames[4:9]] for tracker in (still, moved)
    )
    assert found == expected and not any(found)


class MeasuresNothing:
    """The uncertainty of a frame that tells nothing of its pose."""

    bias_evidence = (0.0, 1.0)

    def covariance(self, *_: object) -> NDArray[np.float64]:
        return 1e4 * np.eye(6)


def test_what_the_motion_so_far_leaves_open_does_not_depend_on_the_world() -> None:
    """Where a frame measures nothing, the covariance is that of the motion since the last one."""
    T, later = se3.exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, 0.2])), SHIFT
    found = []
    for motion in (np.eye(4), G):
        claims = PoseClaims(source_of(ROOM).camera, Config())
        claims.begin(T, 0)
        claims.move(motion)
        nothing: Any = MeasuresNothing()
        clocks = Clocks(0.0, np.zeros(6))
        found.append(claims.advance(motion @ T @ later, 33_000_000, nothing, clocks))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6, atol=1e-12)


class KnowsPlaces:
    """Knows the looks of every place, or of none, and recognises none of them."""

    def __init__(self, all_of_them: bool) -> None:
        self._all = all_of_them
        self.asked = 0

    def knows(self, keyframe: int) -> bool:
        return self._all

    def recognise(self, frame: RgbdFrame) -> list[Recognition]:
        self.asked += 1
        return []


@pytest.mark.parametrize('known', [True, False])
def test_depth_alone_finds_no_place_that_is_known_by_its_looks(known: bool) -> None:
    frames, other = frames_of(ROOM), tracker_for()
    visited = [other.track(frame).T_world_cam for frame in frames[:12]]
    visited.append(visited[0] @ se3.exp(np.array([1.0, 0.5, 0.0, 0.0, 2.0, 0.0])))
    tracker = tracker_for()
    tracker.resume(other.gaussians, visited, range(len(visited)))
    tracker.recogniser = places = KnowsPlaces(known)
    tracker.interrupt()
    states = [tracker.track(frame).state for frame in frames[12:20]]
    assert (TrackingState.RELOCALISED in states) is not known
    assert places.asked > 0 or not known


def test_what_a_frame_is_relative_to_its_keyframe_survives_corrections() -> None:
    frames, tracker = frames_of(ROOM), tracker_for()
    results = [tracker.track(frame) for frame in frames[:14]]
    motions = np.stack([se3.exp(0.01 * k * np.ones(6)) for k in range(tracker.keyframes)])
    before = tracker.keyframe_poses
    tracker.correct(correction(tracker, motions))
    for result in results[1:]:
        reference = result.reference
        assert reference is not None
        k = reference.keyframe
        np.testing.assert_allclose(
            tracker.keyframe_poses[k] @ reference.T_keyframe_cam,
            motions[k] @ before[k] @ reference.T_keyframe_cam, atol=1e-9,
        )  # fmt: skip
        np.testing.assert_allclose(
            before[k] @ reference.T_keyframe_cam, result.T_world_cam, atol=1e-9
        )
    last = results[-1].reference
    assert last is not None
    np.testing.assert_allclose(
        tracker.T_world_cam, motions[last.keyframe] @ results[-1].T_world_cam, atol=1e-9
    )


def test_later_keyframes_move_with_the_last_one_that_is_known() -> None:
    frames, tracker = frames_of(ROOM), tracker_for()
    for frame in frames[:14]:
        tracker.track(frame)
    before, known = tracker.keyframe_poses, tracker.keyframes - 1
    motions = np.tile(np.eye(4), (known, 1, 1))
    motions[-1] = SHIFT
    tracker.correct(correction(tracker, motions))
    np.testing.assert_allclose(tracker.keyframe_poses[-1], SHIFT @ before[-1], atol=1e-9)
    np.testing.assert_allclose(tracker.keyframe_poses[:-2], before[:-2], atol=1e-9)


def test_gaussians_move_with_their_hosts_and_viewpoints_with_who_observed_last() -> None:
    rng, gaussians = np.random.default_rng(1), GaussianMap(0.06)
    means = rng.uniform(-1, 1, (6, 3)).astype(np.float32)
    normals = (means / np.linalg.norm(means, axis=1, keepdims=True)).astype(np.float32)
    for host in range(2):
        part = slice(3 * host, 3 * host + 3)
        gaussians.add(means[part], normals[part], np.ones(3, np.float32), np.full(3, host), host)
    gaussians.remove(np.array([1]))
    depth_m, camera = np.full((480, 640), 9.0, np.float32), source_of(ROOM).camera
    T = np.eye(4)
    T[:3, 3] = means[3] - (0, 0, 9)  # sees the fourth one at 9 m
    gaussians.refresh(T, depth_m, camera, source_of(ROOM).sensor, 0)
    np.testing.assert_allclose(gaussians.viewpoints[3], T[:3, 3])
    viewpoints = gaussians.viewpoints.copy()
    observed = np.all(viewpoints == T[:3, 3].astype(np.float32), axis=1)
    assert observed[3] and not observed.all()
    gaussians.move(np.stack([G, SHIFT]))
    for k, motion in ((0, G), (2, G), (3, SHIFT), (4, SHIFT), (5, SHIFT)):
        np.testing.assert_allclose(
            gaussians.means[k], se3.transform(motion, means[k : k + 1])[0], atol=1e-6
        )
        np.testing.assert_allclose(gaussians.normals[k], motion[:3, :3] @ normals[k], atol=1e-6)
        by = G if observed[k] else motion
        np.testing.assert_allclose(
            gaussians.viewpoints[k], by[:3, :3] @ viewpoints[k] + by[:3, 3], atol=1e-5
        )
        assert gaussians.index.nearest(gaussians.means, gaussians.means[k : k + 1], 1e-3)[0] == k
    assert gaussians.index.nearest(gaussians.means, means[1:2], 1e-3)[0] == -1


def visited_of(submaps: list[int]) -> Visited:
    visited = Visited()
    for k, submap in enumerate(submaps):
        T = se3.exp(np.array([0.1 * k, 0, 0, 0, 0, 0]))
        T[:3, 3] += origin(submap)
        odometry = visited.odometry(T, submap, np.eye(6), Hosts.none())
        visited.add(k, T, odometry, 1e-4 * np.eye(6))
    return visited


def test_a_keyframe_knows_where_it_is_relative_to_its_hosts() -> None:
    visited = visited_of([0, 0, 0])
    T = se3.exp(np.array([0.4, 0.1, 0, 0, 0.2, 0]))
    hosts = Hosts(np.array([0, 2], np.int32), np.array([[[0.75]], [[0.25]]]) * np.eye(6))
    found = visited.odometry(T, 0, np.eye(6), hosts)
    assert found.keyframe == 3 and found.hosts.tolist() == [0, 2]
    np.testing.assert_array_equal(found.information, hosts.information)
    np.testing.assert_allclose(visited.poses[2] @ found.T_host_cam[1], T, atol=1e-12)
    alone = visited.odometry(T, 0, np.eye(6), Hosts.none())
    assert alone.T_host_cam.shape == (0, 4, 4) and not len(alone.hosts)


def test_beside_the_old_part_of_its_map_a_camera_is_not_sure_where_it_is() -> None:
    """What it matches there says nothing, in the world either, until a loop tells."""
    tracker, frames = tracker_for(), frames_of(ROOM)
    for frame in frames[:12]:
        tracker.track(frame)
    assert tracker.keyframes >= 3
    drifted = tracker.visited._chain.covariances.copy()
    drifted[1:] = 0.04 * np.eye(6)
    tracker.visited._chain._covariances = drifted
    in_world = tracker.track(frames[12]).covariance_world
    assert np.linalg.eigvalsh(in_world[:3, :3]).min() > 0.02


def test_joined_sub_maps_have_one_number_and_later_keyframes_go_with_their_own() -> None:
    visited = visited_of([0, 0, 1, 0, 1, 2])
    before = list(visited.poses)
    targets = np.array([*before[:2], SHIFT @ before[2]])
    known = Correction(
        3, np.arange(3), targets, np.tile(np.eye(6), (3, 1, 1)), np.zeros(3, np.int32)
    )
    motions = visited.correct(known)
    assert visited.submaps == [0, 0, 0, 0, 0, 2]
    for k, motion in enumerate([np.eye(4), np.eye(4), SHIFT, np.eye(4), SHIFT, np.eye(4)]):
        np.testing.assert_allclose(motions[k], motion, atol=1e-9)
        np.testing.assert_allclose(visited.poses[k], motion @ before[k], atol=1e-9)


def _on(frames: tuple[RgbdFrame, ...], start_ns: int) -> list[RgbdFrame]:
    """Return frames of another sequence as if they came from `start_ns` on."""
    later = start_ns - frames[0].stamp_ns
    return [
        replace(f, stamp_ns=f.stamp_ns + later, depth_stamp_ns=f.depth_stamp_ns + later)
        for f in frames
    ]


def _into_the_unknown(tracker: Tracker) -> tuple[list[TrackResult], list[TrackResult]]:
    """Track a room, and then a place that has nothing to do with it."""
    frames = frames_of(ROOM)
    here = [tracker.track(frame) for frame in frames]
    there = _on(frames_of(ELSEWHERE), frames[-1].stamp_ns + 10**9)
    return here, [tracker.track(frame) for frame in there]


def test_in_unknown_surroundings_a_sub_map_begins_after_a_while() -> None:
    tracker = tracker_for(**{'keyframes.new_submap_s': 0.4})
    here, there = _into_the_unknown(tracker)
    states = [result.state for result in there]
    begin = next(k for k, state in enumerate(states) if state is not TrackingState.LOST)
    assert 10 <= begin <= 12, states  # the gap counts as 0.2 s, and five frames have to confirm
    first, last = there[begin].reference, there[-1].reference
    assert first is not None and last is not None and first.submap == last.submap == 1
    assert there[begin].keyframe and there[-1].state is not TrackingState.LOST
    assert here[-1].reference is not None and here[-1].reference.submap == 0
    np.testing.assert_allclose(there[begin].covariance_world, UNKNOWN)
    assert there[-1].covariance_world[0, 0] > 1e5 > 1.0 > there[-1].covariance[0, 0]
    apart = there[begin].T_world_cam[:3, 3] - here[-1].T_world_cam[:3, 3]
    np.testing.assert_allclose(apart, origin(1), atol=1e-9)
    ids = [i for r in [*here, *there] for keyframe in r.keyframes for i in keyframe.ids]
    assert len(ids) == len(set(ids)) == len(tracker.gaussians)  # nothing of the first is lost


def _garbage(frame: RgbdFrame) -> RgbdFrame:
    rng = np.random.default_rng(frame.stamp_ns)
    return replace(frame, depth_m=rng.uniform(0.5, 4.0, frame.depth_m.shape).astype(np.float32))


def _covered(frame: RgbdFrame) -> RgbdFrame:
    """Something close and flat, not quite at rest."""
    depth_m = np.full_like(frame.depth_m, 0.5 + 1e-3 * (frame.stamp_ns // 33_000_000 % 3))
    return replace(frame, depth_m=depth_m, color=np.full_like(frame.color, 30))


@pytest.mark.parametrize('spoilt', [_garbage, _covered])
def test_a_frame_that_no_other_confirms_begins_no_sub_map(
    spoilt: Callable[[RgbdFrame], RgbdFrame],
) -> None:
    """Nor do many; what follows after them begins one, and only with frames of its own."""
    tracker, frames = tracker_for(**{'keyframes.new_submap_s': 0.2}), frames_of(ROOM)
    for frame in frames[:6]:
        tracker.track(frame)
    tracker.interrupt()
    assert tracker.track(frames[6]).state is TrackingState.RELOCALISED  # not confirmed yet
    count, size = tracker.keyframes, len(tracker.gaussians)
    there = _on(frames_of(ELSEWHERE), frames[6].stamp_ns + 10**9)
    lost = [tracker.track(spoilt(frame)) for frame in there[:8]]
    assert all(result.state is TrackingState.LOST for result in lost)
    after = [tracker.track(frame) for frame in there[8:16]]
    begun = [result.keyframe for result in after]
    first = begun.index(True)
    assert first in (5, 6), begun
    assert all(result.state is TrackingState.OK for result in after[first:])
    assert tracker.keyframes == count + 1 and len(tracker.gaussians) > size


def test_a_correction_joins_sub_maps() -> None:
    tracker = tracker_for(**{'keyframes.new_submap_s': 0.4})
    _here, there = _into_the_unknown(tracker)
    submaps = tracker.keyframe_submaps
    back = np.eye(4)
    back[:3, 3] = -origin(1)
    motions = np.where((submaps == 1)[:, None, None], back, np.eye(4))
    tracker.correct(correction(tracker, motions))
    np.testing.assert_array_equal(tracker.keyframe_submaps, np.zeros_like(submaps))
    np.testing.assert_allclose(tracker.T_world_cam, back @ there[-1].T_world_cam, atol=1e-9)
    assert np.nanmax(np.abs(tracker.gaussians.means)) < 100.0


def test_without_a_limit_a_lost_camera_is_always_looked_for() -> None:
    tracker = tracker_for(**{'keyframes.new_submap_s': None})
    _, there = _into_the_unknown(tracker)
    assert all(result.state is TrackingState.LOST for result in there)
