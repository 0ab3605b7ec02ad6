# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracking goes on whatever happens to the camera, its clock and its map."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip('sensor_msgs')

from dcgs_ros.core import se3
from dcgs_ros.core.backend.back_end import BackEnd
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels import jit
from dcgs_ros.core.keyframe import Correction, Keyframe, MapUpdate
from dcgs_ros.core.tracking.expectation import ExpectedPlace
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.io.known_places import VIEW_DEPTH_UNIT_M, KnownView, features_of
from dcgs_ros.io.saved_tracker import SavedTracker
from dcgs_ros.nodes.messages.clouds import MAP_GAUSSIAN
from dcgs_ros.nodes.messages.ids import EPOCH, EPOCHS, epoch_of_file, same_tracker
from dcgs_ros.nodes.messages.packet import KeyframePacket
from dcgs_ros.nodes.tracking.back_end_worker import BackEndWorker, KnownKeyframes
from dcgs_ros.nodes.tracking.known_map import KnownMap, preferred, save
from dcgs_ros.nodes.tracking.map_mirror import Resumable
from dcgs_ros.nodes.tracking.session import TrackingSession

SECOND = 1_000_000_000
HANGS_S = 60.0  # only a failure takes so long
FRAMES = 14
NEAR_M, NEAR_RAD = 0.01, np.radians(0.5)
SOURCE = SyntheticSource.from_address(f'synthetic:room?frames={FRAMES}&sensor=ideal')
FULL = SOURCE.camera
T_BASE_CAM = se3.exp(np.array([0.1, 0.0, 0.2, 0.3, -1.2, 0.4]))


def smaller(camera: PinholeCamera) -> PinholeCamera:
    """Return the camera with every second pixel."""
    fx, fy, cx, cy = (value / 2 for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return PinholeCamera(camera.width // 2, camera.height // 2, fx, fy, cx, cy)


HALF = smaller(FULL)
CONFIG = override(replace(Config(), sensor=SOURCE.sensor), {'mapping.view_interval': 2})
EAGER = override(CONFIG, {'keyframes.min_interval_s': 0, 'keyframes.translation_m': 1e-6})


@cache
def frames_of(camera: PinholeCamera) -> tuple[RgbdFrame, ...]:
    if camera == FULL:
        return tuple(SOURCE)
    return tuple(
        replace(frame, color=frame.color[::2, ::2].copy(), depth_m=frame.depth_m[::2, ::2].copy())
        for frame in frames_of(FULL)
    )


def shifted(frame: RgbdFrame, by_ns: int) -> RgbdFrame:
    return replace(
        frame, stamp_ns=frame.stamp_ns + by_ns, depth_stamp_ns=frame.depth_stamp_ns + by_ns
    )


class Feeder:
    """Feeds a `TrackingSession` as the node does, and keeps what comes out."""

    def __init__(self, config: Config = CONFIG) -> None:
        self.warnings: list[str] = []
        self.session = TrackingSession(config, T_BASE_CAM, self.warnings.append)
        self.packets: list[KeyframePacket] = []

    def feed(
        self, frames: Sequence[RgbdFrame], camera: PinholeCamera = HALF, by_ns: int = 0
    ) -> list[TrackResult | None]:
        results = []
        for frame in frames:
            frame = shifted(frame, by_ns)
            result = self.session.track(frame, camera)
            results.append(result)
            if result is not None:
                self.packets += self.session.packets(frame, result, 'optical')
        return results

    @property
    def stamps(self) -> list[int]:
        return [packet.stamp_ns for packet in self.packets]

    @property
    def ids(self) -> list[tuple[int, int]]:
        """Epoch and id of every Gaussian that the mapper gets."""
        keyframes = [(p.epoch, p.posed) for p in self.packets if isinstance(p.posed, Keyframe)]
        return [(epoch, id) for epoch, keyframe in keyframes for id in keyframe.ids.tolist()]

    def assert_keyframes_are_whole(self) -> None:
        """Every stamp once, and every Gaussian of a map once."""
        assert len(set(self.stamps)) == len(self.stamps)
        assert len(set(self.ids)) == len(self.ids)


def states(results: Sequence[TrackResult | None]) -> list[TrackingState | None]:
    return [None if result is None else result.state for result in results]


def assert_true(
    results: Sequence[TrackResult | None],
    frames: Sequence[RgbdFrame],
    T_world_first: NDArray[np.float64],
    found: int = 0,
) -> None:
    """Compare with the true motion since the first frame; the first `found` are relocalised."""
    start = se3.inverse(SOURCE.pose(frames_of(FULL)[0].stamp_ns))
    expected_states = [TrackingState.RELOCALISED] * found
    expected_states += [TrackingState.OK] * (len(results) - found)
    assert states(results) == expected_states
    for result, frame in zip(results, frames, strict=True):
        assert result is not None
        expected = T_world_first @ start @ SOURCE.pose(frame.stamp_ns)
        xi = se3.log(se3.inverse(expected) @ result.T_world_cam)
        assert np.linalg.norm(xi[:3]) < NEAR_M and np.linalg.norm(xi[3:]) < NEAR_RAD


@pytest.fixture(autouse=True)
def restored_threads() -> Iterator[None]:
    yield
    jit.set_threads(None)


def test_a_camera_is_tracked_and_the_mapper_gets_all_gaussians() -> None:
    feeder, frames = Feeder(), frames_of(HALF)
    results = feeder.feed(frames)
    assert_true(results, frames, T_BASE_CAM)
    first = results[0]
    assert first is not None
    np.testing.assert_array_equal(first.T_world_cam, T_BASE_CAM)
    feeder.assert_keyframes_are_whole()
    assert {packet.epoch for packet in feeder.packets} == {feeder.session.epoch}
    assert set(feeder.stamps) <= {frame.stamp_ns for frame in frames}
    assert not feeder.warnings and feeder.session.counts == {'ok': len(frames)}
    tracker = feeder.session.tracker
    assert tracker is not None
    ids = np.array([id for _, id in feeder.ids])
    assert set(ids.tolist()) == set(tracker.gaussians.ids.tolist())
    assert feeder.session.alive(ids).all()


def test_another_camera_begins_another_map_at_the_last_pose() -> None:
    """The resolution changes while the robot drives: poses go on, ids do not."""
    feeder, halves, full = Feeder(), frames_of(HALF), frames_of(FULL)
    before, epoch = feeder.feed(halves[:5]), feeder.session.epoch
    last = before[-1]
    after = feeder.feed(full[5:10], FULL)
    assert last is not None and after[0] is not None
    np.testing.assert_array_equal(after[0].T_world_cam, last.T_world_cam)
    assert feeder.session.epoch != epoch
    start = SOURCE.pose(full[5].stamp_ns)  # of the new map, at the old pose
    T = last.T_world_cam @ se3.inverse(start) @ SOURCE.pose(full[0].stamp_ns)
    assert_true(after, full[5:10], T)
    assert len(feeder.warnings) == 1
    for number in ('320x240', '640x480', '262.5', '525.0'):
        assert number in feeder.warnings[0]
    feeder.assert_keyframes_are_whole()


def test_intrinsics_alone_make_another_camera_and_equal_ones_none() -> None:
    feeder, frames = Feeder(), frames_of(HALF)
    feeder.feed(frames[:3])
    epoch = feeder.session.epoch
    feeder.feed(frames[3:5], replace(HALF))
    assert feeder.session.epoch == epoch
    feeder.feed(frames[5:7], replace(HALF, fx=HALF.fx + 0.01))
    assert feeder.session.epoch != epoch


def test_a_camera_that_never_gave_a_frame_leaves_no_pose_behind() -> None:
    """The first camera_info was of another mode: the first pose is still that of the base."""
    feeder = Feeder()
    assert feeder.feed(frames_of(HALF)[:2], FULL) == [None, None]
    results = feeder.feed(frames_of(HALF)[2:4])
    assert results[0] is not None
    np.testing.assert_array_equal(results[0].T_world_cam, T_BASE_CAM)


@pytest.mark.parametrize('back_s', [1.5, 60.0, 1e6])
def test_a_clock_that_jumps_back_costs_neither_map_nor_place(back_s: float) -> None:
    feeder, frames = Feeder(), frames_of(HALF)
    first = feeder.feed(frames[:6])
    epoch, size = feeder.session.epoch, len(feeder.packets)
    again = feeder.feed(frames[6:], by_ns=-int(back_s * SECOND))
    assert_true(first, frames[:6], T_BASE_CAM)
    assert_true(again, frames[6:], T_BASE_CAM, found=5)
    assert feeder.session.epoch == epoch and len(feeder.packets) > size
    assert len(feeder.warnings) == 1 and 'went back' in feeder.warnings[0]
    feeder.assert_keyframes_are_whole()


def test_a_gap_is_named_once_and_costs_neither_map_nor_place() -> None:
    """The camera stood still meanwhile."""
    feeder, frames = Feeder(), frames_of(HALF)
    feeder.feed(frames[:6])
    epoch = feeder.session.epoch
    again = feeder.feed(frames[6:], by_ns=2 * SECOND)
    assert_true(again, frames[6:], T_BASE_CAM, found=5)
    assert feeder.session.epoch == epoch
    assert len(feeder.warnings) == 1 and '2.0 s after' in feeder.warnings[0]


def test_a_covered_lens_is_named_once_and_a_repeated_frame_is_not() -> None:
    feeder, frames = Feeder(), frames_of(HALF)
    feeder.feed(frames[:4])
    repeated = [shifted(frames[3], 20_000_000), frames[4]]
    assert states(feeder.feed(repeated)) == [TrackingState.OK] * 2
    assert not feeder.warnings
    covered = [replace(f, depth_m=np.full_like(f.depth_m, 0.35) + k * 1e-3)
               for k, f in enumerate(frames[5:8])]  # fmt: skip
    assert states(feeder.feed(covered)) == [TrackingState.LOST] * 3
    assert states(feeder.feed(frames[8:10])) == [TrackingState.RELOCALISED] * 2
    assert len(feeder.warnings) == 1 and 'lost, 0.0 s' in feeder.warnings[0]


def test_a_recording_that_is_played_again_gives_its_keyframes_other_stamps() -> None:
    """With equal stamps the mapper would take new keyframes for repeated ones."""
    feeder = Feeder(override(CONFIG, {'mapping.view_interval': 1}))
    frames = [shifted(frame, k * SECOND // 5) for k, frame in enumerate(frames_of(HALF))]
    for _ in range(3):
        feeder.feed(frames)
    feeder.assert_keyframes_are_whole()
    stamps = np.array([frame.stamp_ns for frame in frames])
    off = np.array([np.abs(stamps - name).min() for name in feeder.stamps])
    assert (off < 3).all() and {0, 1, 2} == set(off.tolist())
    assert len(feeder.warnings) == 2 and feeder.session.counts['refused'] == 0


def test_after_a_reset_the_same_frames_have_other_stamps_and_another_epoch() -> None:
    feeder, frames = Feeder(), frames_of(HALF)
    feeder.feed(frames[:5])
    epoch = feeder.session.epoch
    feeder.session.reset()
    assert feeder.session.epoch != epoch and same_tracker(feeder.session.epoch, epoch)
    assert not feeder.session.alive(np.arange(5)).any()
    results = feeder.feed(frames[:5])
    assert_true(results, frames[:5], T_BASE_CAM)
    feeder.assert_keyframes_are_whole()
    feeder.session.reset()
    results = feeder.feed(frames[:5], by_ns=-60 * SECOND)
    assert_true(results, frames[:5], T_BASE_CAM)
    assert not feeder.warnings


def test_frames_that_are_late_are_refused_and_nothing_else_happens() -> None:
    feeder, frames = Feeder(), frames_of(HALF)
    feeder.feed(frames[:5])
    epoch = feeder.session.epoch
    late = [frames[3], frames[4], shifted(frames[0], -SECOND // 2)]
    assert feeder.feed(late) == [None] * 3
    assert feeder.session.counts['refused'] == 3 == len(feeder.warnings)
    assert feeder.session.epoch == epoch
    assert_true(feeder.feed(frames[5:8]), frames[5:8], T_BASE_CAM)


def test_frames_of_another_size_than_camera_info_says_are_refused() -> None:
    feeder = Feeder()
    feeder.feed(frames_of(HALF)[:4])
    assert feeder.feed(frames_of(FULL)[4:6]) == [None, None]
    assert '640x480' in feeder.warnings[0]
    assert_true(feeder.feed(frames_of(HALF)[6:8]), frames_of(HALF)[6:8], T_BASE_CAM)


def update_of(ids: Sequence[int], removed: Sequence[int]) -> MapUpdate:
    n = len(ids)
    return MapUpdate(
        np.array(ids, np.int64), np.empty((0, 3), np.float32),
        np.tile(np.array([0, 0, -1], np.float32), (n, 1)), np.full(n, 0.5, np.float32),
        np.array(removed, np.int64),
    )  # fmt: skip


def test_an_answer_is_taken_if_it_is_of_this_map() -> None:
    feeder = Feeder()
    session = feeder.session
    session.apply(update_of([1], [2]), session.epoch)  # before there is any map
    feeder.feed(frames_of(HALF)[:3])
    assert session.tracker is not None
    gaussians, asked = session.tracker.gaussians, np.array([3, 4, 5, -1, 10**9], np.int64)
    assert session.alive(asked).tolist() == [True, True, True, False, False]
    session.apply(update_of([4, 10**9], [3]), session.epoch % (EPOCHS - 1) + 1)
    assert session.alive(asked).tolist() == [True, True, True, False, False]
    session.apply(update_of([4, 10**9, -7], [3, 3, -1, 10**9]), session.epoch)
    assert session.alive(asked).tolist() == [False, True, True, False, False]
    assert gaussians.flatness[gaussians.ids == 4] == 0.5
    session.reset()
    session.apply(update_of([4], [5]), session.epoch)


def test_settings_that_change_hold_at_once_and_for_the_next_map() -> None:
    feeder, frames = Feeder(), frames_of(HALF)
    feeder.feed(frames[:3])
    feeder.session.reconfigure(EAGER)
    results = feeder.feed(frames[3:7])
    assert all(result is not None and result.keyframe for result in results)
    feeder.session.reset()
    results = feeder.feed(frames[7:10])
    assert all(result is not None and result.keyframe for result in results)


# Going on in a map that another tracker made.


def resumable_of(feeder: Feeder, stamps_ns: Sequence[int] = ()) -> Resumable:
    """Return the map as the mapper would have it: discs across the normals."""
    tracker = feeder.session.tracker
    assert tracker is not None
    gaussians = tracker.gaussians
    rows = np.zeros(len(gaussians), MAP_GAUSSIAN)
    rows['id'] = feeder.session.epoch * EPOCH + gaussians.ids
    for k, axis in enumerate('xyz'):
        rows[axis] = gaussians.means[:, k]
    rows['scale_0'] = rows['scale_1'] = 0.02
    rows['scale_2'] = 0.001
    n = gaussians.normals.astype(float)  # (0, 0, 1) turned there about the axis between
    quats = np.column_stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    for k in range(4):
        rows[f'rot_{k}'] = quats[:, k]
    visited = [packet.posed.T_world_cam for packet in feeder.packets]
    found = Resumable.of(rows, visited, stamps_ns or range(-len(visited), 0))
    assert found is not None
    return found


def test_how_often_views_are_mapped_changes_at_once() -> None:
    feeder = Feeder(override(CONFIG, {'mapping.view_interval': 1000}))
    frames = frames_of(HALF)
    feeder.feed(frames[:4])
    before = len(feeder.packets)
    feeder.session.reconfigure(override(CONFIG, {'mapping.view_interval': 1}))
    feeder.feed(frames[4:8])
    assert before < 4 and len(feeder.packets) == before + 4


def test_a_tracker_that_starts_again_goes_on_in_the_same_map() -> None:
    frames, before = frames_of(HALF), Feeder()
    before.feed(frames[:8])
    stamps = [frame.stamp_ns for frame in frames[6:10]]
    found, after = resumable_of(before, stamps), Feeder(EAGER)
    after.session.resume(found)
    results = after.feed(frames[7:])
    assert_true(results, frames[7:], T_BASE_CAM, found=5)
    assert after.session.epoch == before.session.epoch
    highest = max(id for _, id in before.ids)
    assert after.ids and min(id for _, id in after.ids) > highest
    assert not set(after.stamps) & set(stamps)  # the mapper has keyframes with these stamps
    after.assert_keyframes_are_whole()


def test_where_the_camera_is_said_to_be_it_is_looked_for_once_there_is_a_tracker() -> None:
    """Far from all keyframes it is not found otherwise."""
    frames, before = frames_of(HALF), Feeder()
    before.feed(frames[:8])
    far = se3.exp(np.array([9.0, 0, 0, 0, 0, 0]))
    found = replace(resumable_of(before), poses=[far], stamps_ns=(1,), submaps=())
    true = T_BASE_CAM @ se3.inverse(SOURCE.pose(frames_of(FULL)[0].stamp_ns))
    place = ExpectedPlace(true @ SOURCE.pose(frames[7].stamp_ns), np.zeros((6, 6)))
    for expecting in (False, True):
        after = Feeder()
        after.session.resume(found)
        if expecting:
            after.session.expect(place)
        results = after.feed(frames[7:9])
        if expecting:
            assert_true(results, frames[7:9], T_BASE_CAM, found=2)
        else:
            assert states(results) == [TrackingState.LOST] * 2
            after.session.expect(place)
            assert 'around' in after.warnings[-1]
            assert_true(after.feed(frames[9:10]), frames[9:10], T_BASE_CAM, found=1)


def test_without_a_map_there_is_nowhere_to_look_for_the_camera() -> None:
    feeder = Feeder()
    feeder.session.expect(ExpectedPlace(T_BASE_CAM, np.eye(6)))
    assert 'no map yet' in feeder.warnings[0]
    assert_true(feeder.feed(frames_of(HALF)[:1]), frames_of(HALF)[:1], T_BASE_CAM)


def test_in_a_map_of_another_place_nothing_is_found_and_nothing_is_made() -> None:
    """The tracker is lost rather than wrong; a reset begins a new map."""
    before = Feeder()
    before.feed(frames_of(HALF)[:8])
    elsewhere = SyntheticSource.from_address('synthetic:zigzag?frames=4&sensor=ideal')
    frames = [
        replace(f, color=f.color[::2, ::2].copy(), depth_m=f.depth_m[::2, ::2].copy())
        for f in elsewhere
    ]
    after = Feeder()
    after.session.resume(resumable_of(before))
    assert states(after.feed(frames)) == [TrackingState.LOST] * 4
    assert not after.packets
    after.session.reset()
    assert states(after.feed(frames[:2], by_ns=SECOND)) == [TrackingState.OK] * 2
    assert after.session.epoch != before.session.epoch


def test_a_reset_before_the_first_frame_is_no_going_on() -> None:
    before, after = Feeder(), Feeder()
    before.feed(frames_of(HALF)[:4])
    after.session.resume(resumable_of(before))
    after.session.reset()
    results = after.feed(frames_of(HALF)[:4])
    assert_true(results, frames_of(HALF)[:4], T_BASE_CAM)
    assert after.session.epoch != before.session.epoch


def test_a_camera_that_was_assumed_elsewhere_begins_a_right_map() -> None:
    """The base's poses go on in the world that is meant: the base where tracking began."""
    feeder, frames = Feeder(), frames_of(HALF)
    before = feeder.feed(frames[:6])
    epoch, T_base_cam = feeder.session.epoch, se3.exp(np.array([0.3, -0.2, 0.5, 1.0, 0.2, -0.7]))
    feeder.session.remount(T_base_cam, frames[6])
    after = feeder.feed(frames[6:9])
    assert feeder.session.epoch != epoch
    assert len(feeder.warnings) == 1 and 'elsewhere' in feeder.warnings[0]
    assert_true(before, frames[:6], T_BASE_CAM)
    assert_true(after, frames[6:9], T_base_cam)
    feeder.session.reset()
    again = feeder.feed(frames[9:11])[0]
    assert again is not None
    np.testing.assert_array_equal(again.T_world_cam, T_base_cam)
    feeder.assert_keyframes_are_whole()


def test_before_the_first_frame_and_in_the_map_of_another_tracker_the_world_stays() -> None:
    before, after = Feeder(), Feeder()
    before.session.remount(T_BASE_CAM @ T_BASE_CAM, frames_of(HALF)[0])
    first = before.feed(frames_of(HALF)[:8])[0]
    assert first is not None
    np.testing.assert_array_equal(first.T_world_cam, T_BASE_CAM @ T_BASE_CAM)
    after.session.resume(resumable_of(before))
    after.feed(frames_of(HALF)[7:10])
    after.session.remount(np.eye(4), frames_of(HALF)[10])
    assert after.session.epoch == before.session.epoch and not before.warnings
    after.session.reset()
    assert not same_tracker(after.session.epoch, before.session.epoch)


def test_whether_a_camera_was_ever_tracked_is_known_for_each_map() -> None:
    feeder, frames = Feeder(), frames_of(HALF)
    depth_m = np.zeros_like(frames[0].depth_m)
    depth_m[100:104, 100:104] = 1.0  # hardly anything
    blind = replace(frames[0], depth_m=depth_m)
    assert states(feeder.feed([blind])) == [TrackingState.LOST]
    tracked = [feeder.session.ever_tracked]
    feeder.feed(frames[1:3])
    tracked.append(feeder.session.ever_tracked)
    feeder.session.reset()
    assert [*tracked, feeder.session.ever_tracked] == [False, True, False]
    feeder.feed(frames_of(FULL)[3:4])
    assert '640x480' in feeder.session.refusal


EVENTS = st.lists(
    st.sampled_from(
        ['next', 'next', 'next', 'same', 'dark', 'holes', 'full', 'half', 'wrong size', 'back',
         'forth', 'reset', 'answer', 'no answer', 'settings']
    ),
    min_size=1,
    max_size=14,
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(EVENTS)
def test_whatever_comes_it_goes_on(events: list[str]) -> None:
    """Nothing raises; each map has its own epoch; every stamp and every id is used once."""
    feeder, camera, at, by_ns = Feeder(), HALF, 0, 0
    session = feeder.session
    epochs = [session.epoch]
    for event in events:
        frame, other = frames_of(camera)[at % FRAMES], HALF if camera == FULL else FULL
        cameras = session.tracker.camera if session.tracker is not None else None
        if event in ('full', 'half'):
            camera = FULL if event == 'full' else HALF
            feeder.feed([frames_of(camera)[at % FRAMES]], camera, by_ns)
            if cameras not in (None, camera):
                assert session.epoch != epochs[-1]
                epochs.append(session.epoch)
        elif event == 'reset':
            session.reset()
            assert session.epoch != epochs[-1]
            epochs.append(session.epoch)
        elif event == 'answer':
            session.apply(update_of([1, 5, 10**6], [2, 3]), session.epoch)
        elif event == 'no answer':
            session.apply(update_of([1], list(range(1000))), 0)
        elif event == 'settings':
            session.reconfigure(override(CONFIG, {'registration.radius_m': 0.05}))
        elif event in ('back', 'forth'):
            by_ns += 7 * SECOND * (-1 if event == 'back' else 1)
        else:
            at += event == 'next'
            if event == 'wrong size':
                frame = frames_of(other)[at % FRAMES]
            elif event in ('dark', 'holes'):
                depth_m = np.zeros_like(frame.depth_m)
                depth_m[::40, ::40] = 1.0
                color = frame.color // 50 if event == 'dark' else frame.color
                frame = replace(frame, depth_m=depth_m, color=color)
            feeder.feed([frame], camera, by_ns)
        assert session.epoch == epochs[-1]
    assert len(set(epochs)) == len(epochs)
    feeder.assert_keyframes_are_whole()


ASIDE = se3.exp(np.array([0.3, 0.1, 0.0, 0.0, 0.0, 0.2]))


def corrected_all(feeder: Feeder, revision: int = 1) -> Correction:
    """Correct the keyframes that a back end was given: all of them, by the same motion."""
    keyframes = [p.posed for p in feeder.packets if isinstance(p.posed, Keyframe)]
    stamps = np.array([keyframe.frame.stamp_ns for keyframe in keyframes], np.int64)
    n = len(stamps)
    T = ASIDE @ np.array([keyframe.T_world_cam for keyframe in keyframes])
    return Correction(revision, stamps, T, np.zeros((n, 6, 6)), np.zeros(n, np.int32))


def test_after_a_correction_tracking_goes_on_in_the_corrected_world() -> None:
    feeder, frames = Feeder(EAGER), frames_of(HALF)
    feeder.feed(frames[:6])
    done = feeder.session.correct(corrected_all(feeder), feeder.session.epoch)
    assert done is not None
    np.testing.assert_allclose(done.here, ASIDE, atol=1e-9)
    assert len(done.motions) > 3
    np.testing.assert_allclose(done.motions, ASIDE[None].repeat(len(done.motions), 0), atol=1e-9)
    assert feeder.session.figures()['revision'] == 1
    results = feeder.feed(frames[6:])
    assert_true(results, frames[6:], ASIDE @ T_BASE_CAM)


def test_a_correction_of_another_map_is_none() -> None:
    feeder = Feeder(EAGER)
    feeder.feed(frames_of(HALF)[:4])
    correction, epoch = corrected_all(feeder), feeder.session.epoch
    feeder.session.reset()
    assert feeder.session.correct(correction, epoch) is None


def test_the_mapper_is_told_by_the_names_that_it_has_keyframes_under() -> None:
    """Where a recording is played again those are others than the tracker's own stamps."""
    feeder, frames = Feeder(EAGER), frames_of(HALF)
    feeder.feed(frames[:4])
    feeder.session.reset()
    feeder.packets.clear()
    feeder.feed(frames[:6])
    views = [p for p in feeder.packets if not isinstance(p.posed, Keyframe)]
    done = feeder.session.correct(corrected_all(feeder), feeder.session.epoch)
    assert done is not None and not views
    assert done.named.stamps_ns.tolist() == feeder.stamps
    assert done.applied.stamps_ns.tolist() != feeder.stamps


def test_a_view_refers_to_a_keyframe_that_the_mapper_has() -> None:
    feeder = Feeder()  # a view every second frame, keyframes rarely
    frames = frames_of(HALF)
    feeder.feed(frames[:4])
    feeder.session.reset()
    feeder.packets.clear()
    feeder.feed(frames)
    keyframes = {p.stamp_ns: p for p in feeder.packets if isinstance(p.posed, Keyframe)}
    views = [p.posed for p in feeder.packets if not isinstance(p.posed, Keyframe)]
    assert views
    for view in views:
        assert view.reference is not None
        named = keyframes[view.reference.stamp_ns]
        np.testing.assert_allclose(view.reference.T_world_cam, named.posed.T_world_cam, atol=1e-9)


def test_normals_from_before_a_correction_are_not_taken() -> None:
    feeder = Feeder(EAGER)
    feeder.feed(frames_of(HALF)[:4])
    session, tracker = feeder.session, feeder.session.tracker
    assert tracker is not None
    session.correct(corrected_all(feeder), session.epoch)
    ids = tracker.gaussians.ids[:3].copy()
    before = tracker.gaussians.of(ids)[1].copy()
    turned = np.roll(before, 1, axis=1)
    flat, gone = np.full(3, 0.5, np.float32), tracker.gaussians.ids[5:7].copy()
    means = np.zeros((3, 3), np.float32)
    session.apply(MapUpdate(ids, means, turned, flat, gone), session.epoch)
    np.testing.assert_array_equal(tracker.gaussians.of(ids)[1], before)
    assert not session.alive(gone).any()  # what was removed is gone in any world
    session.apply(MapUpdate(ids, means, turned, flat, gone, 1), session.epoch)
    assert np.abs(tracker.gaussians.of(ids)[1] - before).max() > 1e-3


class Listening:
    """A back end's place, where only what it is given counts."""

    def __init__(self) -> None:
        self.heard: list[str | int] = []
        self.known: KnownKeyframes | None = None

    def begin(
        self, camera: PinholeCamera, config: Config, epoch: int, known: KnownKeyframes | None
    ) -> None:
        self.heard.append('begin')
        self.known = known

    def leave(self) -> None:
        self.heard.append('leave')

    def add(self, keyframe: Keyframe) -> None:
        assert keyframe.odometry is not None
        self.heard.append(keyframe.odometry.keyframe)


def test_the_back_end_gets_every_keyframe_of_each_map_in_order() -> None:
    listening, frames = Listening(), frames_of(HALF)
    feeder = Feeder(EAGER)
    feeder.session._loops = listening
    feeder.feed(frames[:4])
    feeder.session.reset()
    feeder.feed(frames[4:6])
    assert listening.heard == ['begin', 0, 1, 2, 'begin', 0]


def test_the_back_end_gets_the_keyframes_of_a_map_that_is_gone_on_in(tmp_path: Path) -> None:
    frames, before = frames_of(HALF), Feeder(EAGER)
    before.feed(frames[:8])
    known, found = KnownMap.read(saved_by(before, tmp_path)), resumable_of(before)
    for resumed in (known, found):
        listening, after = Listening(), Feeder(EAGER)
        after.session._loops = listening
        after.session.resume(resumed)
        after.feed(frames[6:])
        got, count = listening.known, len(resumed.stamps_ns)
        assert got is not None and len(got.T_world_cam) == len(got.submaps) == count
        assert tuple(got.stamps_ns) == tuple(resumed.stamps_ns)
        numbers = [n for n in listening.heard if isinstance(n, int)]
        assert listening.heard[0] == 'begin' and numbers and numbers[0] == count
        after.session.reset()
        after.feed(frames[6:8], by_ns=SECOND)
        assert listening.known is None  # a new map


def test_the_submaps_of_a_resumed_map_are_its_own() -> None:
    frames, before = frames_of(HALF), Feeder(EAGER)
    before.feed(frames[:8])
    found, after = resumable_of(before), Feeder(EAGER)
    after.session._loops = listening = Listening()
    submaps = (1,) * len(found.poses)
    after.session.resume(replace(found, submaps=submaps))
    result = after.feed(frames[7:8])[0]
    assert result is not None and result.submap == 1  # its place in the map is not known
    assert listening.known is not None and tuple(listening.known.submaps) == submaps


def with_images(known: KnownMap, frames: Sequence[RgbdFrame]) -> KnownMap:
    """Add the images of the keyframes, as the mapper saves them."""
    by_stamp, views = {frame.stamp_ns: frame for frame in frames}, []
    for k, stamp_ns in enumerate(known.stamps_ns):
        frame = by_stamp[stamp_ns]
        depth = np.rint(frame.depth_m / VIEW_DEPTH_UNIT_M).astype(np.uint16)
        jpeg, png = (
            cv2.imencode(kind, image)[1].tobytes()
            for kind, image in (('.jpg', frame.color[..., ::-1]), ('.png', depth))
        )
        views.append(KnownView(k, jpeg, png))
    features = features_of(views, known.camera, EAGER.sensor)
    return replace(known, views=tuple(views), features=tuple(features))


def test_the_back_end_takes_in_the_keyframes_of_a_file(tmp_path: Path) -> None:
    frames, before = frames_of(HALF), Feeder(EAGER)
    before.feed(frames[:8])
    known = with_images(KnownMap.read(saved_by(before, tmp_path)), frames)
    after, made = Feeder(EAGER), list[BackEnd]()

    def make(camera: PinholeCamera, config: Config) -> BackEnd:
        made.append(BackEnd(camera, config))
        return made[-1]

    worker = BackEndWorker(make, lambda *_: None, after.warnings.append)
    after.session._loops = worker
    after.session.resume(known)
    after.feed(frames[6:])
    tracker, back_end = after.session.tracker, made[0]
    assert tracker is not None
    end_s = time.monotonic() + HANGS_S
    while back_end.keyframes < tracker.keyframes and time.monotonic() < end_s:
        time.sleep(0.01)
    worker.close()
    assert not after.warnings and tracker.recogniser is not None
    count = len(known.stamps_ns)
    assert back_end.keyframes == tracker.keyframes > count
    assert tracker.recogniser.knows(0) and tracker.recogniser.knows(count)
    found = {one.keyframe for one in tracker.recogniser.recognise(frames[2])}
    assert found & set(range(count))  # by the images of the file
    kept = after.session.known
    assert isinstance(kept, KnownMap) and not kept.views
    poses = tracker.corrected_poses.T_world_cam
    np.testing.assert_allclose(back_end.poses[:count], poses[:count], atol=1e-9)


def test_keyframes_of_the_tracker_before_are_told_of_once_they_move() -> None:
    frames, before = frames_of(HALF), Feeder(EAGER)
    before.feed(frames[:8])
    stamps = [7, 7, *range(8, 6 + len(before.packets))]
    found, after = resumable_of(before, stamps), Feeder(EAGER)
    after.session.resume(found)
    after.feed(frames[6:])
    tracker = after.session.tracker
    assert tracker is not None
    own, theirs = len(after.session._names), len(found.stamps_ns)
    now = tracker.corrected_poses
    stays = after.session.correct(replace(now, revision=1), after.session.epoch)
    assert own and stays is not None and len(stays.named.stamps_ns) == own
    T = ASIDE @ now.T_world_cam
    moved = after.session.correct(replace(now, revision=2, T_world_cam=T), after.session.epoch)
    assert moved is not None and len(moved.named.stamps_ns) == own + theirs - 2
    np.testing.assert_allclose(moved.named.T_world_cam[0], T[2], atol=1e-9)
    assert moved.named.stamps_ns[0] == 8  # 7 names two


def saved_by(feeder: Feeder, folder: Path) -> Path:
    text = save(feeder.session.tracker, folder, ())
    return Path(text.rpartition(' in ')[2]) / 'map.dcgs'


def test_a_saved_map_is_gone_on_in_with_the_ids_after_its_own(tmp_path: Path) -> None:
    feeder, frames = Feeder(EAGER), frames_of(HALF)
    feeder.feed(frames[:8])
    path = saved_by(feeder, tmp_path)
    known, again = KnownMap.read(path), Feeder(EAGER)
    again.session.resume(known)
    results = again.feed(frames[6:])
    assert_true(results, frames[6:], T_BASE_CAM, found=5)  # in the world of the map
    assert again.session.epoch == known.epoch == epoch_of_file(path)
    fresh = [id for _, id in again.ids]
    assert fresh and min(fresh) >= known.tracker.next_id > known.tracker.ids.max()
    assert not set(again.stamps) & set(known.stamps_ns)


def test_where_it_only_localises_nothing_is_sent_and_the_map_is_never_left(
    tmp_path: Path,
) -> None:
    feeder, frames = Feeder(EAGER), frames_of(HALF)
    feeder.feed(frames[:8])
    known, again = KnownMap.read(saved_by(feeder, tmp_path)), Feeder(EAGER)
    again.session = TrackingSession(EAGER, T_BASE_CAM, again.warnings.append, localize_only=True)
    again.session.resume(known)
    again.feed(frames[4:9])
    assert 'looking for the camera in the map' in again.session.reset()
    again.feed(frames_of(FULL)[9:11], FULL)  # another camera
    results = again.feed(frames[9:], by_ns=SECOND)
    assert states(results)[-1] is not TrackingState.LOST and not again.packets
    assert again.session.tracker is not None
    assert any('the map was made with another camera' in line for line in again.warnings)
    assert known.tracker.is_same_map(SavedTracker.of(again.session.tracker))


def test_a_reset_leaves_a_map_that_was_loaded(tmp_path: Path) -> None:
    feeder, frames = Feeder(EAGER), frames_of(HALF)
    feeder.feed(frames[:8])
    path = saved_by(feeder, tmp_path)
    known, again, data = KnownMap.read(path), Feeder(EAGER), path.read_bytes()
    again.session.load(known)
    again.feed(frames[6:8])
    assert 'begins a new map' in again.session.reset()
    results = again.feed(frames[8:10])
    assert states(results) == [TrackingState.OK] * 2
    assert results[0] is not None
    np.testing.assert_allclose(results[0].T_world_cam, T_BASE_CAM, atol=1e-9)
    assert again.session.epoch != known.epoch and again.session.known is None
    assert path.read_bytes() == data


def test_another_map_is_loaded_while_tracking(tmp_path: Path) -> None:
    feeder, frames = Feeder(EAGER), frames_of(HALF)
    feeder.feed(frames[:8])
    known, again = KnownMap.read(saved_by(feeder, tmp_path)), Feeder(EAGER)
    again.feed(frames[:3])
    again.session.load(known)
    results = again.feed(frames[3:])
    assert states(results)[-1] in (TrackingState.OK, TrackingState.RELOCALISED)
    assert again.session.epoch == known.epoch


def test_of_a_living_mapper_and_a_file_the_newer_map_is_gone_on_in(tmp_path: Path) -> None:
    feeder = Feeder(EAGER)
    feeder.feed(frames_of(HALF)[:8])
    known = KnownMap.read(saved_by(feeder, tmp_path))
    rows = np.zeros(2, MAP_GAUSSIAN)

    def living(epoch: int, newest: int) -> Resumable:
        rows['id'] = epoch * EPOCH + newest
        return Resumable(epoch, rows.copy(), [np.eye(4)], (1,))

    same = living(known.epoch, known.tracker.next_id - 1)
    extended = living(known.epoch, known.tracker.next_id)
    other = living(known.epoch + 1, 0)
    assert preferred(None, known) is preferred(same, known) is known
    for found in (extended, other):
        assert preferred(found, known) is found
    assert preferred(other, None) is other and preferred(None, None) is None


def test_a_map_that_is_none_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(DcgsError, match='there is no map yet'):
        save(None, tmp_path, ())
    (tmp_path / 'a').write_bytes(b'')
    for path in (tmp_path / 'a', tmp_path / 'nowhere'):
        with pytest.raises(DcgsError, match=str(path)):
            KnownMap.read(path)
