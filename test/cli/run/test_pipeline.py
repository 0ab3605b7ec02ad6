# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a run keeps of its frames."""

from __future__ import annotations

from typing import cast

import numpy as np

from dcgs_ros.cli.run.pipeline import NoMapping, Pipeline
from dcgs_ros.cli.run.progress import Progress
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe
from dcgs_ros.core.loop_closing import NoClosing
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.evaluation.report import RunRecord


class OnlyKeyframes:
    """A tracker to which each frame is a keyframe."""

    gaussians = ()

    def track(self, frame: RgbdFrame) -> TrackResult:
        none = np.empty((0, 3), np.float32)
        made = Keyframe(frame, np.eye(4), np.eye(4), np.empty(0, np.int64), none, none)
        return TrackResult(
            frame.stamp_ns, np.eye(4), np.eye(4), np.eye(6), np.eye(6), TrackingState.OK, None, 9,
            9, 9, True, (made,), 0.0,
        )  # fmt: skip


class Closing(NoClosing):
    """Remembers the keyframes that are handed over."""

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []

    def after(self, result: TrackResult) -> None:
        self.keyframes += result.keyframes


def test_the_record_does_not_hold_the_keyframes_images() -> None:
    """They are for mapper and back end: a walk of ten minutes has gigabytes of them."""
    color, depth_m = np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), np.float32)
    frames = [RgbdFrame(stamp_ns, stamp_ns, color, depth_m) for stamp_ns in range(3)]
    record, closing = RunRecord('', 'full'), Closing()
    tracker = cast(Tracker, OnlyKeyframes())
    pipeline = Pipeline(tracker, NoMapping(), closing, None, online=False)
    with Progress(len(frames)) as progress:
        pipeline.process(frames, record, progress, lambda: False)
    assert len(closing.keyframes) == 3
    assert [tracked.result.keyframe for tracked in record.tracked] == [True] * 3
    assert all(tracked.result.keyframes == () for tracked in record.tracked)
