# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""When the back end works, and who is told what: with one that only keeps the books."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import loop_closing
from dcgs_ros.core.backend.closure import Loop
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction, Keyframe
from dcgs_ros.core.loop_closing import ClosingInLockstep, ClosingOnline, NoClosing
from dcgs_ros.core.slam import MappingMode
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
PATIENCE_S = 60.0
BEST = np.stack([np.eye(4), 2.0 * np.eye(4)])


class DeliberateError(Exception):
    """What a back end of these tests raises."""


def keyframe(stamp_ns: int) -> Keyframe:
    frame = RgbdFrame(stamp_ns, stamp_ns, np.zeros((2, 2), np.uint8), np.ones((2, 2), 'f4'))
    none = np.empty((0, 3), np.float32)
    return Keyframe(frame, np.eye(4), np.eye(4), np.empty(0, np.int64), none, none)


def result(*keyframes: int) -> TrackResult:
    made = tuple(keyframe(stamp_ns) for stamp_ns in keyframes)
    return TrackResult(
        0, np.eye(4), np.eye(4), np.eye(6), np.eye(6), TrackingState.OK, None, 1, 1, 1,
        bool(made), made, 0.0,
    )  # fmt: skip


def correction(revision: int) -> Correction:
    return Correction(revision, np.arange(2), BEST, np.zeros((2, 6, 6)), np.zeros(2, np.int32))


class FakeBackEnd:
    """Answers every second keyframe with a correction."""

    places = 'the places'

    def __init__(self, camera: PinholeCamera, config: Config) -> None:
        self.added: list[int] = []
        self.done = 0
        self.threads: set[str] = set()
        self.hook: Callable[[], object] = lambda: None
        self.loops = (Loop(0, 1, np.eye(4), np.eye(6), 30),)

    def add(self, keyframe: Keyframe) -> None:
        self.added.append(keyframe.frame.stamp_ns)

    def work(self) -> Correction | None:
        self.hook()
        self.threads.add(threading.current_thread().name)
        before, self.done = self.done, len(self.added)
        return correction(self.done // 2) if self.done // 2 > before // 2 else None

    def optimised(self) -> Correction:
        return correction(99)


class FakeTracker:
    def __init__(self) -> None:
        self.camera, self.config = CAMERA, Config()
        self.recogniser: Any = None
        self.revisions: list[int] = []

    def correct(self, correction: Correction) -> None:
        self.revisions.append(correction.revision)

    @property
    def corrected_poses(self) -> Correction:
        return correction(100 + self.revisions[-1])


class FakeMapping:
    def __init__(self) -> None:
        self.revisions: list[int] = []

    def correct(self, correction: Correction) -> None:
        self.revisions.append(correction.revision)


@pytest.fixture(autouse=True)
def fake_back_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_closing, 'BackEnd', FakeBackEnd)


Parts = tuple[FakeTracker, FakeMapping, FakeBackEnd]


def lockstep() -> tuple[ClosingInLockstep, Parts]:
    tracker, mapping = FakeTracker(), FakeMapping()
    closing = ClosingInLockstep(cast(Tracker, tracker), cast(MappingMode, mapping))
    return closing, (tracker, mapping, cast(Any, closing)._back_end)


def online() -> tuple[ClosingOnline, Parts]:
    tracker, mapping = FakeTracker(), FakeMapping()
    closing = ClosingOnline(cast(Tracker, tracker), cast(MappingMode, mapping))
    return closing, (tracker, mapping, cast(Any, closing)._back_end)


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def after(closing: ClosingOnline) -> bool:
    """Pass a frame; never true."""
    closing.after(result())
    return False


def assert_best(poses: NDArray[np.float64] | None) -> None:
    assert poses is not None
    np.testing.assert_array_equal(poses, BEST)


def test_in_lockstep_all_work_is_done_before_the_next_frame() -> None:
    closing, (tracker, mapping, back_end) = lockstep()
    for k in range(5):
        closing.after(result(k))
        closing.after(result())
        assert back_end.done == k  # `after` does no work
        closing.advance()
        assert back_end.done == k + 1
    assert tracker.revisions == [1, 2]
    assert mapping.revisions == [101, 102]  # what the tracker made of them
    closing.after(result(5))
    assert_best(closing.finish())
    assert tracker.revisions == [1, 2, 3] and mapping.revisions[-1] == 103
    assert tracker.recogniser == 'the places' and closing.loops == [(0, 1)]


def test_online_the_tracker_never_waits_and_takes_corrections_itself() -> None:
    closing, (tracker, mapping, back_end) = online()
    gate = threading.Event()
    back_end.hook = lambda: gate.wait(PATIENCE_S)
    for k in range(4):
        start = time.monotonic()
        closing.after(result(k))
        closing.advance()
        assert time.monotonic() - start < 0.5 * PATIENCE_S
    assert not tracker.revisions
    gate.set()
    wait_for(lambda: after(closing) or tracker.revisions)
    assert_best(closing.finish())
    assert back_end.added == [0, 1, 2, 3] and back_end.done == 4
    assert tracker.revisions[-1] == 2 and mapping.revisions[-1] == 102
    assert 'back end' in back_end.threads


def test_online_what_the_back_end_raises_is_raised_by_the_next_frame_and_at_the_end() -> None:
    closing, (_, _, back_end) = online()

    def fail() -> None:
        raise DeliberateError

    back_end.hook = fail
    closing.after(result(0))
    with pytest.raises(DeliberateError):
        wait_for(lambda: after(closing))
    with pytest.raises(DeliberateError):
        closing.finish()


def test_online_without_keyframes_just_ends() -> None:
    closing, _ = online()
    closing.after(result())
    assert_best(closing.finish())


def test_without_a_back_end_nothing_is_corrected() -> None:
    closing = NoClosing()
    closing.after(result(0))
    closing.advance()
    closing.finish()
    assert closing.loops == []
