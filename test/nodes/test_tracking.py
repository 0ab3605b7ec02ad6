# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracking goes on whatever happens to the camera, its clock and its map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip('sensor_msgs')

from dcgs_ros.core import jit, se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config import Config, override
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.mapper import Keyframe, MapUpdate
from dcgs_ros.core.tracker import TrackingState, TrackResult
from dcgs_ros.datasets.synthetic import SyntheticSource
from dcgs_ros.nodes.ids import EPOCH, EPOCHS
from dcgs_ros.nodes.map_mirror import Resumable
from dcgs_ros.nodes.messages.clouds import MAP_GAUSSIAN
from dcgs_ros.nodes.tracking import Tracking, new_epoch

SECOND = 1_000_000_000
FRAMES = 14
NEAR_M, NEAR_RAD = 0.01, np.radians(0.5)
NO_IDS = np.empty(0, np.int64)
SOURCE = SyntheticSource.from_address(f'synthetic:room?frames={FRAMES}&sensor=ideal')
FULL = SOURCE.camera
T_BASE_CAM = se3.exp(np.array([0.1, 0.0, 0.2, 0.3, -1.2, 0.4]))


def smaller(camera: PinholeCamera) -> PinholeCamera:
    """Every second pixel of it."""
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


class Follower:
    """Feeds a `Tracking` as the node does, and remembers."""

    def __init__(self, config: Config = CONFIG) -> None:
        self.said: list[str] = []
        self.tracking = Tracking(config, T_BASE_CAM, self.said.append)
        self.keyframes: list[tuple[int, Keyframe]] = []  # with their epochs

    def feed(
        self, frames: Sequence[RgbdFrame], camera: PinholeCamera = HALF, by_ns: int = 0
    ) -> list[TrackResult | None]:
        results = []
        for frame in frames:
            frame = shifted(frame, by_ns)
            result = self.tracking.track(frame, camera)
            results.append(result)
            if result is not None:
                made = self.tracking.keyframes(frame, result)
                self.keyframes += [(self.tracking.epoch, keyframe) for keyframe in made]
        return results

    @property
    def names(self) -> list[int]:
        return [keyframe.frame.stamp_ns for _, keyframe in self.keyframes]

    def assert_keyframes_are_whole(self) -> None:
        """Every name once, and every Gaussian of a map handed over once."""
        assert len(set(self.names)) == len(self.names)
        ids = [(epoch, id) for epoch, k in self.keyframes for id in k.ids.tolist()]
        assert len(set(ids)) == len(ids)


def states(results: Sequence[TrackResult | None]) -> list[TrackingState | None]:
    return [None if result is None else result.state for result in results]


def assert_true(
    results: Sequence[TrackResult | None], frames: Sequence[RgbdFrame], T_world_first: NDArray
) -> None:
    """Where the camera really went, since the first frame of all."""
    start = se3.inverse(SOURCE.pose(frames_of(FULL)[0].stamp_ns))
    for result, frame in zip(results, frames, strict=True):
        assert result is not None and result.state is TrackingState.OK
        expected = T_world_first @ start @ SOURCE.pose(frame.stamp_ns)
        xi = se3.log(se3.inverse(expected) @ result.T_world_cam)
        assert np.linalg.norm(xi[:3]) < NEAR_M and np.linalg.norm(xi[3:]) < NEAR_RAD


@pytest.fixture(autouse=True)
def restored_threads() -> Iterator[None]:
    yield
    jit.set_threads(None)


def test_epochs_are_many_and_never_none() -> None:
    drawn = {new_epoch() for _ in range(200)}
    assert len(drawn) > 195 and all(0 < epoch < EPOCHS for epoch in drawn)


def test_a_camera_is_followed_and_what_it_saw_is_handed_over() -> None:
    follower, frames = Follower(), frames_of(HALF)
    results = follower.feed(frames)
    assert_true(results, frames, T_BASE_CAM)
    first = results[0]
    assert first is not None
    np.testing.assert_array_equal(first.T_world_cam, T_BASE_CAM)
    follower.assert_keyframes_are_whole()
    assert {epoch for epoch, _ in follower.keyframes} == {follower.tracking.epoch}
    assert set(follower.names) <= {frame.stamp_ns for frame in frames}
    assert not follower.said and follower.tracking.counts == {'ok': len(frames)}
    tracker = follower.tracking.tracker
    assert tracker is not None
    ids = np.concatenate([keyframe.ids for _, keyframe in follower.keyframes])
    assert set(ids.tolist()) == set(tracker.gaussians.ids.tolist())
    assert follower.tracking.alive(ids).all()


def test_another_camera_begins_another_map_at_the_last_pose() -> None:
    """A resolution that changes while the robot drives: poses go on, ids do not."""
    follower, halves, full = Follower(), frames_of(HALF), frames_of(FULL)
    before, epoch = follower.feed(halves[:5]), follower.tracking.epoch
    last = before[-1]
    after = follower.feed(full[5:10], FULL)
    assert last is not None and after[0] is not None
    np.testing.assert_array_equal(after[0].T_world_cam, last.T_world_cam)
    assert follower.tracking.epoch != epoch
    start = SOURCE.pose(full[5].stamp_ns)  # of the new map, at the old pose
    T = last.T_world_cam @ se3.inverse(start) @ SOURCE.pose(full[0].stamp_ns)
    assert_true(after, full[5:10], T)
    assert len(follower.said) == 1
    for number in ('320x240', '640x480', '262.5', '525.0'):
        assert number in follower.said[0]
    follower.assert_keyframes_are_whole()


def test_intrinsics_alone_make_another_camera_and_equal_ones_none() -> None:
    follower, frames = Follower(), frames_of(HALF)
    follower.feed(frames[:3])
    epoch = follower.tracking.epoch
    follower.feed(frames[3:5], replace(HALF))
    assert follower.tracking.epoch == epoch
    follower.feed(frames[5:7], replace(HALF, fx=HALF.fx + 0.01))
    assert follower.tracking.epoch != epoch


def test_a_camera_that_never_gave_a_frame_leaves_no_pose_behind() -> None:
    """Its first camera_info was of another mode: the base still begins where it is."""
    follower = Follower()
    assert follower.feed(frames_of(HALF)[:2], FULL) == [None, None]
    results = follower.feed(frames_of(HALF)[2:4])
    assert results[0] is not None
    np.testing.assert_array_equal(results[0].T_world_cam, T_BASE_CAM)


@pytest.mark.parametrize('back_s', [1.5, 60.0, 1e6])
def test_a_clock_that_jumps_back_costs_neither_map_nor_place(back_s: float) -> None:
    follower, frames = Follower(), frames_of(HALF)
    first = follower.feed(frames[:6])
    epoch, size = follower.tracking.epoch, len(follower.keyframes)
    again = follower.feed(frames[6:], by_ns=-int(back_s * SECOND))
    assert_true(first, frames[:6], T_BASE_CAM)
    assert_true(again, frames[6:], T_BASE_CAM)
    assert follower.tracking.epoch == epoch and len(follower.keyframes) > size
    assert len(follower.said) == 1 and 'went back' in follower.said[0]
    follower.assert_keyframes_are_whole()


def test_a_recording_that_is_played_again_gives_its_keyframes_other_names() -> None:
    """Equal stamps, other keyframes: the mapper would take the later ones for repeated."""
    follower = Follower()
    frames = [shifted(frame, k * SECOND // 5) for k, frame in enumerate(frames_of(HALF))]
    for _ in range(3):
        follower.feed(frames)
    follower.assert_keyframes_are_whole()
    stamps = np.array([frame.stamp_ns for frame in frames])
    off = np.array([np.abs(stamps - name).min() for name in follower.names])
    assert (off < 3).all() and {0, 1, 2} == set(off.tolist())
    assert len(follower.said) == 2 and follower.tracking.counts['refused'] == 0


def test_after_a_reset_the_same_frames_have_other_names_and_another_epoch() -> None:
    follower, frames = Follower(), frames_of(HALF)
    follower.feed(frames[:5])
    epoch = follower.tracking.epoch
    follower.tracking.reset()
    assert follower.tracking.epoch != epoch
    assert not follower.tracking.alive(np.arange(5)).any()
    results = follower.feed(frames[:5])
    assert_true(results, frames[:5], T_BASE_CAM)
    follower.assert_keyframes_are_whole()
    follower.tracking.reset()
    results = follower.feed(frames[:5], by_ns=-60 * SECOND)
    assert_true(results, frames[:5], T_BASE_CAM)
    assert not follower.said


def test_frames_that_are_late_are_refused_and_nothing_else_happens() -> None:
    follower, frames = Follower(), frames_of(HALF)
    follower.feed(frames[:5])
    epoch = follower.tracking.epoch
    late = [frames[3], frames[4], shifted(frames[0], -SECOND // 2)]
    assert follower.feed(late) == [None] * 3
    assert follower.tracking.counts['refused'] == 3 == len(follower.said)
    assert follower.tracking.epoch == epoch
    assert_true(follower.feed(frames[5:8]), frames[5:8], T_BASE_CAM)


def test_frames_of_another_size_than_camera_info_says_are_refused() -> None:
    follower = Follower()
    follower.feed(frames_of(HALF)[:4])
    assert follower.feed(frames_of(FULL)[4:6]) == [None, None]
    assert '640x480' in follower.said[0]
    assert_true(follower.feed(frames_of(HALF)[6:8]), frames_of(HALF)[6:8], T_BASE_CAM)


def update_of(ids: Sequence[int], removed: Sequence[int]) -> MapUpdate:
    n = len(ids)
    return MapUpdate(
        np.array(ids, np.int64), np.empty((0, 3), np.float32),
        np.tile(np.array([0, 0, -1], np.float32), (n, 1)), np.full(n, 0.5, np.float32),
        np.array(removed, np.int64),
    )  # fmt: skip


def test_an_answer_is_taken_if_it_is_of_this_map() -> None:
    follower = Follower()
    tracking = follower.tracking
    tracking.answer(update_of([1], [2]), tracking.epoch)  # before there is any map
    follower.feed(frames_of(HALF)[:3])
    assert tracking.tracker is not None
    gaussians, asked = tracking.tracker.gaussians, np.array([3, 4, 5, -1, 10**9], np.int64)
    assert tracking.alive(asked).tolist() == [True, True, True, False, False]
    tracking.answer(update_of([4, 10**9], [3]), tracking.epoch % (EPOCHS - 1) + 1)
    assert tracking.alive(asked).tolist() == [True, True, True, False, False]
    tracking.answer(update_of([4, 10**9, -7], [3, 3, -1, 10**9]), tracking.epoch)
    assert tracking.alive(asked).tolist() == [False, True, True, False, False]
    assert gaussians.flatness[gaussians.ids == 4] == 0.5
    tracking.reset()
    tracking.answer(update_of([4], [5]), tracking.epoch)


def test_settings_that_change_hold_at_once_and_for_the_next_map() -> None:
    follower, frames = Follower(), frames_of(HALF)
    follower.feed(frames[:3])
    follower.tracking.reconfigure(EAGER)
    results = follower.feed(frames[3:7])
    assert all(result is not None and result.keyframe for result in results)
    follower.tracking.reset()
    results = follower.feed(frames[7:10])
    assert all(result is not None and result.keyframe for result in results)


# Going on in a map that another tracker made.


def resumable_of(follower: Follower, stamps_ns: Sequence[int] = ()) -> Resumable:
    """The map as the mapper would have it: discs across the normals."""
    tracker = follower.tracking.tracker
    assert tracker is not None
    gaussians = tracker.gaussians
    rows = np.zeros(len(gaussians), MAP_GAUSSIAN)
    rows['id'] = follower.tracking.epoch * EPOCH + gaussians.ids
    for k, axis in enumerate('xyz'):
        rows[axis] = gaussians.means[:, k]
    rows['scale_0'] = rows['scale_1'] = 0.02
    rows['scale_2'] = 0.001
    n = gaussians.normals.astype(float)  # (0, 0, 1) turned there about the axis between
    quats = np.column_stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    for k in range(4):
        rows[f'rot_{k}'] = quats[:, k]
    visited = [keyframe.T_world_cam for _, keyframe in follower.keyframes]
    found = Resumable.of(rows, visited, stamps_ns)
    assert found is not None
    return found


def test_how_often_views_are_mapped_changes_at_once() -> None:
    follower = Follower(override(CONFIG, {'mapping.view_interval': 1000}))
    frames = frames_of(HALF)
    follower.feed(frames[:4])
    before = len(follower.keyframes)
    follower.tracking.reconfigure(override(CONFIG, {'mapping.view_interval': 1}))
    follower.feed(frames[4:8])
    assert before < 4 and len(follower.keyframes) == before + 4


def test_a_tracker_that_starts_again_goes_on_in_the_same_map() -> None:
    frames, before = frames_of(HALF), Follower()
    before.feed(frames[:8])
    stamps = [frame.stamp_ns for frame in frames[6:10]]
    found, after = resumable_of(before, stamps), Follower(EAGER)
    after.tracking.resume(found)
    results = after.feed(frames[7:])
    assert_true(results, frames[7:], T_BASE_CAM)
    assert after.tracking.epoch == before.tracking.epoch
    highest = max(int(keyframe.ids.max(initial=0)) for _, keyframe in before.keyframes)
    ids = np.concatenate([keyframe.ids for _, keyframe in after.keyframes])
    assert len(ids) and ids.min() > highest
    assert not set(after.names) & set(stamps)  # the mapper has keyframes of these names
    after.assert_keyframes_are_whole()


def test_in_a_map_of_another_place_nothing_is_found_and_nothing_is_made() -> None:
    """Rather lost than wrong; a reset then begins anew."""
    before = Follower()
    before.feed(frames_of(HALF)[:8])
    elsewhere = SyntheticSource.from_address('synthetic:zigzag?frames=4&sensor=ideal')
    frames = [
        replace(f, color=f.color[::2, ::2].copy(), depth_m=f.depth_m[::2, ::2].copy())
        for f in elsewhere
    ]
    after = Follower()
    after.tracking.resume(resumable_of(before))
    assert states(after.feed(frames)) == [TrackingState.LOST] * 4
    assert not after.keyframes
    after.tracking.reset()
    assert states(after.feed(frames[:2], by_ns=SECOND)) == [TrackingState.OK] * 2
    assert after.tracking.epoch != before.tracking.epoch


def test_a_reset_before_the_first_frame_is_no_going_on() -> None:
    before, after = Follower(), Follower()
    before.feed(frames_of(HALF)[:4])
    after.tracking.resume(resumable_of(before))
    after.tracking.reset()
    results = after.feed(frames_of(HALF)[:4])
    assert_true(results, frames_of(HALF)[:4], T_BASE_CAM)
    assert after.tracking.epoch != before.tracking.epoch


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
    """Nothing raises; another map has another epoch; every name and every id is given once."""
    follower, camera, at, by_ns = Follower(), HALF, 0, 0
    tracking = follower.tracking
    epochs = [tracking.epoch]
    for event in events:
        frame, other = frames_of(camera)[at % FRAMES], HALF if camera == FULL else FULL
        cameras = tracking.tracker.camera if tracking.tracker is not None else None
        if event in ('full', 'half'):
            camera = FULL if event == 'full' else HALF
            follower.feed([frames_of(camera)[at % FRAMES]], camera, by_ns)
            if cameras not in (None, camera):
                assert tracking.epoch != epochs[-1]
                epochs.append(tracking.epoch)
        elif event == 'reset':
            tracking.reset()
            assert tracking.epoch != epochs[-1]
            epochs.append(tracking.epoch)
        elif event == 'answer':
            tracking.answer(update_of([1, 5, 10**6], [2, 3]), tracking.epoch)
        elif event == 'no answer':
            tracking.answer(update_of([1], list(range(1000))), 0)
        elif event == 'settings':
            tracking.reconfigure(override(CONFIG, {'registration.radius_m': 0.05}))
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
            follower.feed([frame], camera, by_ns)
        assert tracking.epoch == epochs[-1]
    assert len(set(epochs)) == len(epochs)
    follower.assert_keyframes_are_whole()
