# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which frames the mapper gets, told by the results alone."""

from __future__ import annotations

from itertools import count

import numpy as np
import pytest

from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.selector import KeyframeSelector

OK, LOST, DEGENERATE = TrackingState.OK, TrackingState.LOST, TrackingState.DEGENERATE
RELOCALISED = TrackingState.RELOCALISED


class Frames:
    """Results of a tracker that finishes its first keyframe with the second frame."""

    def __init__(self, interval: int) -> None:
        self.selector = KeyframeSelector(interval)
        self._stamps, self._held = count(), list[Keyframe]()

    def selected(self, keyframe: bool = False, state: TrackingState = OK) -> list[int]:
        """Return the stamps of what is selected when one more frame is tracked."""
        stamp_ns = next(self._stamps)
        pose, motion = np.eye(4), np.eye(4)
        pose[0, 3], motion[1, 3] = stamp_ns, -stamp_ns
        color = np.zeros((2, 2, 3), np.uint8)
        frame = RgbdFrame(stamp_ns, stamp_ns, color, np.ones((2, 2), np.float32))
        if keyframe:
            points = np.ones((1, 3), np.float32)
            self._held.append(Keyframe(frame, pose, motion, np.zeros(1, int), points, points))
        finished = tuple(self._held) if stamp_ns else ()
        if stamp_ns:
            self._held.clear()
        result = TrackResult(
            stamp_ns, pose, motion, np.eye(6), np.eye(6), state, None, 100, 100, 50, keyframe,
            finished, 0.0,
        )  # fmt: skip
        chosen = self.selector.select(frame, result)
        for posed in chosen:
            at = posed.frame.stamp_ns
            assert (posed.T_world_cam[0, 3], posed.T_cam_cam_at_depth[1, 3]) == (at, -at)
        return [posed.frame.stamp_ns for posed in chosen]


def test_keyframes_come_as_soon_as_the_tracker_has_finished_them() -> None:
    frames = Frames(interval=10)
    assert frames.selected(keyframe=True) == []
    assert [frames.selected(), frames.selected()] == [[0], []]
    assert frames.selected(keyframe=True) == [3]


def test_a_second_frame_that_is_a_keyframe_comes_right_behind_the_first() -> None:
    frames = Frames(interval=3)
    assert [frames.selected(keyframe=True), frames.selected(keyframe=True)] == [[], [0, 1]]


def test_views_between_keyframes_come_at_their_interval() -> None:
    """Counted from the last selected frame, for whatever reason it was."""
    frames = Frames(interval=3)
    found = [frames.selected(keyframe=k in (0, 6, 7)) for k in range(14)]
    assert [stamp for stamps in found for stamp in stamps] == [0, 4, 6, 7, 10, 13]


def test_the_interval_may_change_at_any_time() -> None:
    frames = Frames(interval=100)
    assert [frames.selected(keyframe=k == 0) for k in range(6)] == [[], [0], [], [], [], []]
    frames.selector.interval = 2
    assert [frames.selected() for _ in range(3)] == [[6], [], [8]]


@pytest.mark.parametrize('state', [LOST, RELOCALISED])
def test_a_frame_whose_place_is_not_sure_is_never_selected_and_does_not_count(
    state: TrackingState,
) -> None:
    frames = Frames(interval=2)
    assert frames.selected(keyframe=True) == []
    assert frames.selected(state=state) == [0]  # the first keyframe waits for any second frame
    assert [frames.selected(state=state) for _ in range(5)] == [[]] * 5
    assert [frames.selected(), frames.selected(state=DEGENERATE)] == [[], [8]]
