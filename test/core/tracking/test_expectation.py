# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A place that somebody tells is looked at first, and taken only where the frame agrees."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tracked_room import SEEN, SOURCE, frames, tracker  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels import jit
from dcgs_ros.core.tracking import expectation, search
from dcgs_ros.core.tracking.expectation import ExpectedPlace
from dcgs_ros.core.tracking.relocalization import Recognition
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker

NEAR_M, NEAR_RAD = 0.01, np.radians(0.5)
STEP_NS = 200_000_000  # as long as a frame counts in a search
RVIZ = np.diag([0.25, 0.0, 0.25, 0.0, 0.0685, 0.0])  # 0.5 m, 15 deg, about the camera's y: upright
SURE = np.zeros((6, 6))
OK, LOST, FOUND = TrackingState.OK, TrackingState.LOST, TrackingState.RELOCALISED
FAR = se3.exp(np.array([40.0, 0, 0, 0, 0, 0]))


@pytest.fixture(autouse=True)
def restored_threads() -> Iterator[None]:
    yield
    jit.set_threads(None)


def true_pose(frame: RgbdFrame) -> NDArray[np.float64]:
    start = SOURCE.pose(frames()[0].stamp_ns)
    return np.asarray(se3.inverse(start) @ SOURCE.pose(frame.stamp_ns))


def lost_in_the_map() -> Tracker:
    """Return a tracker in the room's map that was last, and has its only keyframe, far away."""
    known, one = tracker(), Tracker(SOURCE.camera, tracker().config)
    one.resume(deepcopy(known.gaussians), [FAR], [0], usual=known.usual)
    return one


def again(count: int, step_ns: int = STEP_NS) -> list[RgbdFrame]:
    """Return the next frames in turns, at a steady pace."""
    some, made = frames()[SEEN:], []
    for k in range(count):
        frame = some[k % len(some)]
        stamp_ns = some[0].stamp_ns + k * step_ns
        late_ns = frame.depth_stamp_ns - frame.stamp_ns
        made.append(replace(frame, stamp_ns=stamp_ns, depth_stamp_ns=stamp_ns + late_ns))
    return made


def assert_true(result: TrackResult, frame: RgbdFrame) -> None:
    at = frames()[SEEN:][[f.color is frame.color for f in frames()[SEEN:]].index(True)]
    xi = se3.log(se3.inverse(result.T_world_cam) @ true_pose(at))
    assert np.linalg.norm(xi[:3]) < NEAR_M and np.linalg.norm(xi[3:]) < NEAR_RAD


def test_a_lost_camera_is_found_near_where_it_is_said_to_be() -> None:
    one, given = lost_in_the_map(), again(8, 33_000_000)
    off = se3.exp(np.array([0.2, 0.02, -0.15, 0.01, 0.1, -0.01]))
    assert one.expect(ExpectedPlace(true_pose(given[0]) @ off, RVIZ))
    for frame in given:
        result = one.track(frame)
        if result.state is not LOST:
            break
    assert result.state is FOUND
    assert_true(result, frame)


def test_it_is_not_taken_to_be_where_the_frame_does_not_fit() -> None:
    one, given = lost_in_the_map(), again(4)
    turned = true_pose(given[0]) @ se3.exp(np.array([0, 0, 0, 0, 2.0, 0]))
    assert one.expect(ExpectedPlace(turned, RVIZ))
    assert all(one.track(frame).state is LOST for frame in given)


def test_it_is_not_taken_to_be_beside_the_place_though_it_is_found_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before it is looked for everywhere: then it is where it was last."""
    monkeypatch.setattr(search, '_EXPECTED_S', 1.0)
    monkeypatch.setattr(expectation, '_WITHIN', 2.0)  # narrower than registration reaches
    one, given = deepcopy(tracker()), again(12)
    aside = true_pose(given[0]) @ se3.exp(np.array([0.0, 0, -0.2, 0, 0, 0]))
    assert one.expect(ExpectedPlace(aside, SURE))
    results = [one.track(frame) for frame in given]
    tracked = [k for k, result in enumerate(results) if result.state is not LOST]
    assert 5 <= tracked[0] < 12
    assert_true(results[tracked[0]], given[tracked[0]])
    assert all(result.submap == 0 for result in results)


class Recogniser:
    """Takes every frame for one at `T_world_cam`, in the only keyframe."""

    def __init__(self, T_world_cam: NDArray[np.float64]) -> None:
        none, floats = np.zeros((0, 3)), np.zeros((0, 2), np.float32)
        T = se3.inverse(FAR) @ T_world_cam
        self._found = Recognition(0, T, none, floats, np.zeros(0, np.float32))

    def knows(self, keyframe: int) -> bool:
        return True

    def recognise(self, frame: RgbdFrame) -> list[Recognition]:
        return [self._found]


def test_where_places_are_known_by_their_looks_depth_alone_is_not_believed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Though it is found there by it: one corner may be like another."""
    for knows in (False, True):
        one, given = lost_in_the_map(), again(3, 33_000_000)
        one.recogniser = Recogniser(FAR @ FAR)
        monkeypatch.setattr(one.recogniser, 'knows', lambda _, knows=knows: knows)
        assert one.expect(ExpectedPlace(true_pose(given[0]), SURE))
        states = {one.track(frame).state for frame in given}
        assert states == {LOST} if knows else FOUND in states


@pytest.mark.parametrize(('aside_m', 'tried'), [(0.3, 1), (3.0, 0)])
def test_what_a_frame_looks_like_counts_within_the_place(aside_m: float, tried: int) -> None:
    one, (frame,) = lost_in_the_map(), again(1)
    one.recogniser = Recogniser(true_pose(frame) @ se3.exp(aside_m * np.eye(6)[0]))
    one.expect(ExpectedPlace(true_pose(frame), RVIZ))
    assert one._search is not None
    known: Any = SimpleNamespace(recogniser=one.recogniser, config=one.config)
    assert len(one._search._recognised(frame, known)) == tried


def test_a_camera_that_is_tracked_there_is_left_alone() -> None:
    one, (first, second) = deepcopy(tracker()), frames()[SEEN : SEEN + 2]
    assert one.track(first).state is OK
    assert not one.expect(ExpectedPlace(one.T_world_cam, SURE))
    assert one.track(second).state is OK


def test_before_there_is_a_map_there_is_nowhere_to_look() -> None:
    one = Tracker(SOURCE.camera, tracker().config)
    assert not one.expect(ExpectedPlace(FAR, RVIZ))
    assert one.track(frames()[0]).state is OK


def test_a_place_admits_what_its_covariance_does() -> None:
    """And at least 10 cm and 5 degrees, 4.5 times."""
    place = ExpectedPlace(FAR, np.diag([1.0, 0, 0, 0, 0, 0.25]))
    for axis, sigma in ((0, np.hypot(1, 0.1)), (1, 0.1), (5, np.hypot(0.5, np.radians(5)))):
        for share, admitted in ((4.4, True), (4.6, False)):
            T = FAR @ se3.exp(share * sigma * np.eye(6)[axis])
            assert place.admits(T) == admitted


def test_what_is_tried_is_spread_as_the_place_is() -> None:
    place = ExpectedPlace(FAR, RVIZ)
    tried = place.poses()
    xi = np.array([se3.log(se3.inverse(FAR) @ T) for T in tried])
    least = np.square(np.repeat([0.1, np.radians(5)], 3))
    np.testing.assert_allclose(np.cov(xi.T).diagonal(), RVIZ.diagonal() + least, rtol=0.25)
    for one, same in zip(tried, place.poses(), strict=True):
        np.testing.assert_array_equal(one, same)
