# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Who hands what to whom, and when: with a tracker and a mapper that only keep the books."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction, Keyframe, MapUpdate, PosedFrame
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.slam import Lockstep, Online
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker

PATIENCE_S = 120.0  # far more than any wait here takes
NO_IDS = np.empty(0, np.int64)
OK, LOST, DEGENERATE = TrackingState.OK, TrackingState.LOST, TrackingState.DEGENERATE


class DeliberateError(Exception):
    """What a mapper of these tests raises."""


class FakeTracker:
    """Spawns three Gaussians a keyframe, and holds the first one back for a frame."""

    def __init__(self) -> None:
        self.removed: list[int] = []
        self.held: list[Keyframe] = []
        self.frames = 0

    def track(
        self, keyframe: bool = False, state: TrackingState = OK
    ) -> tuple[RgbdFrame, TrackResult]:
        """Track a frame that is stamped with how many there were before."""
        stamp_ns, self.frames = self.frames, self.frames + 1
        color = np.zeros((2, 2, 3), np.uint8)
        frame = RgbdFrame(stamp_ns, stamp_ns, color, np.ones((2, 2), np.float32))
        if keyframe:
            ids = 3 * stamp_ns + np.arange(3)
            points = np.ones((3, 3), np.float32)
            self.held.append(Keyframe(frame, np.eye(4), np.eye(4), ids, points, points))
        finished = self.flush() if stamp_ns else ()
        result = TrackResult(
            stamp_ns, np.eye(4), np.eye(4), np.eye(6), np.eye(6), state, None, 100, 100, 50,
            keyframe, finished, 0.0,
        )  # fmt: skip
        return frame, result

    def flush(self) -> tuple[Keyframe, ...]:
        held, self.held = tuple(self.held), []
        return held

    def corrected(self, frame: RgbdFrame) -> RgbdFrame:
        return replace(frame, depth_m=2.0 * frame.depth_m)

    def apply(self, update: MapUpdate) -> None:
        self.removed += update.removed.tolist()


class FakeMapper:
    """Writes down what it is asked to do."""

    def __init__(self, **settings: Any) -> None:
        values = {f'mapping.{name}': value for name, value in settings.items()}
        self.config = override(Config(), values)
        self.views: list[PosedFrame] = []
        self.log: list[str] = []
        self.rates: list[float] = []
        self.pending: list[MapUpdate] = []
        self.hook: Callable[[str], None] = lambda what: None

    def insert(self, posed: PosedFrame) -> None:
        self.hook('insert')
        self.views.append(posed)
        self.log.append(f'insert {posed.frame.stamp_ns}')

    def correct(self, correction: Correction) -> None:
        self.hook('correct')
        self.log.append(f'correct {correction.revision}')

    def step(self, rate: float = 1.0, replay: bool = False) -> float:
        self.hook('step')
        self.log.append('replay' if replay else 'step')
        self.rates.append(rate)
        return 0.0

    def update(self) -> MapUpdate:
        self.log.append('update')
        return self.pending.pop(0) if self.pending else update()

    @property
    def inserted(self) -> list[int]:
        return [posed.frame.stamp_ns for posed in self.views]


def update(*removed: int) -> MapUpdate:
    points, flatness = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    return MapUpdate(NO_IDS, points, points, flatness, np.array(removed, np.int64))


def lockstep(tracker: FakeTracker, mapper: FakeMapper) -> Lockstep:
    return Lockstep(cast(Tracker, tracker), cast(Mapper, mapper))


def follow(mapping: Lockstep, tracker: FakeTracker, frames: int, keyframes: set[int]) -> None:
    for k in range(frames):
        mapping.after(*tracker.track(keyframe=k in keyframes))
        mapping.advance()


def test_work_between_steps_is_done_once_at_the_next_frame_or_step() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(steps_per_frame=1.0, final_steps=3)
    mapping, seen = lockstep(tracker, mapper), []

    def work(given: Mapper) -> None:
        assert cast(Any, given) is mapper
        seen.append(len(mapper.log))

    mapping.between_steps(work)
    assert not seen
    follow(mapping, tracker, 3, {0})
    assert len(seen) == 1
    steps = mapping.finish()
    next(steps)
    mapping.between_steps(work)
    done = len(mapper.log)
    assert len(list(steps)) == 2
    assert seen[1:] == [done + 1]


@pytest.mark.parametrize(
    ('per_frame', 'expected'),
    [
        (0.0, [0, 0, 0, 0, 0]),
        (2.0, [0, 2, 4, 6, 8]),
        (0.5, [0, 0, 1, 1, 2]),
        (1.25, [0, 1, 2, 3, 5]),
        (0.2, [0, 0, 0, 0, 0]),
    ],
)
def test_steps_are_counted_by_frames_from_the_first_view_on(
    per_frame: float, expected: list[int]
) -> None:
    tracker, mapper = FakeTracker(), FakeMapper(steps_per_frame=per_frame)
    mapping, steps = lockstep(tracker, mapper), []
    for k in range(5):
        mapping.after(*tracker.track(keyframe=k == 0))
        mapping.advance()
        steps.append(mapper.log.count('step'))
    assert steps == expected


def test_fractions_of_steps_add_up_over_many_frames() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(steps_per_frame=1.7)
    follow(lockstep(tracker, mapper), tracker, 1001, {0})
    assert abs(mapper.log.count('step') - 1700) <= 1


def test_a_lost_frame_has_its_steps_too() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(steps_per_frame=1.0)
    mapping = lockstep(tracker, mapper)
    follow(mapping, tracker, 2, {0})
    mapping.after(*tracker.track(state=LOST))
    mapping.advance()
    assert mapper.log.count('step') == 2


def test_each_keyframe_is_inserted_then_optimised_and_answered() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(steps_per_frame=1.0, view_interval=100)
    follow(lockstep(tracker, mapper), tracker, 4, {0, 2})
    assert mapper.log == ['insert 0', 'step', 'update', 'insert 2', 'step', 'update', 'step']


def correction(revision: int) -> Correction:
    none = np.empty((0, 4, 4))
    return Correction(revision, NO_IDS, none, none, np.empty(0, np.int32))


def test_a_correction_comes_after_what_was_handed_over_before_it() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(steps_per_frame=1.0, final_steps=0)
    mapping = lockstep(tracker, mapper)
    follow(mapping, tracker, 2, {0})
    mapping.after(*tracker.track(keyframe=True))
    mapping.correct(correction(1))
    mapping.after(*tracker.track(keyframe=True))
    mapping.advance()
    tail = ['insert 2', 'correct 1', 'insert 3', 'step', 'update']
    assert mapper.log[-len(tail) :] == tail
    mapping.correct(correction(2))
    assert not list(mapping.finish()) and mapper.log[-1] == 'correct 2'


def test_after_alone_does_no_work() -> None:
    tracker, mapper = FakeTracker(), FakeMapper()
    mapping = lockstep(tracker, mapper)
    for k in range(3):
        mapping.after(*tracker.track(keyframe=k == 0))
    assert mapper.log == []
    mapping.advance()
    assert mapper.log[0] == 'insert 0'


def test_views_between_keyframes_have_the_depth_that_the_tracker_believes() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(view_interval=1)
    follow(lockstep(tracker, mapper), tracker, frames=4, keyframes={0})
    between = [posed for posed in mapper.views if posed.frame.stamp_ns]
    assert between and all((posed.frame.depth_m == 2.0).all() for posed in between)


def test_the_final_steps_replay_with_falling_rates_and_tell_how_many_are_left() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(steps_per_frame=0.0, final_steps=5)
    mapping = lockstep(tracker, mapper)
    follow(mapping, tracker, 3, {0})
    assert list(mapping.finish()) == [4, 3, 2, 1, 0]
    assert mapper.log[-5:] == ['replay'] * 5
    np.testing.assert_allclose(mapper.rates[-5:], np.linspace(1.0, mapper.config.rates.final, 5))


def test_the_final_steps_can_be_abandoned() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(steps_per_frame=0.0, final_steps=1000)
    mapping = lockstep(tracker, mapper)
    follow(mapping, tracker, 2, {0})
    for left in mapping.finish():
        if left == 997:
            break
    assert mapper.log.count('replay') == 3


def test_a_single_frame_is_mapped_in_the_end() -> None:
    tracker, mapper = FakeTracker(), FakeMapper(final_steps=2)
    mapping = lockstep(tracker, mapper)
    follow(mapping, tracker, 1, {0})
    assert mapper.log == []
    assert list(mapping.finish()) == [1, 0]
    assert mapper.log == ['insert 0', 'replay', 'replay']


def test_nothing_tracked_leaves_nothing_to_do() -> None:
    mapper = FakeMapper(final_steps=3)
    mapping = lockstep(FakeTracker(), mapper)
    mapping.advance()
    assert list(mapping.finish()) == [] and mapper.log == []


def test_in_lockstep_the_answer_is_the_trackers_at_once() -> None:
    tracker, mapper = FakeTracker(), FakeMapper()
    mapper.pending = [update(1)]
    follow(lockstep(tracker, mapper), tracker, 2, {0})
    assert tracker.removed == [1]


def eventually(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, 'this should have come true by now'
        time.sleep(0.001)


class Session:
    """A mapping that runs online, and is ended in any case."""

    def __init__(self, **settings: Any) -> None:
        self.tracker, self.mapper = FakeTracker(), FakeMapper(**settings)
        self.paused = threading.Event()
        self.mapper.hook = self._step_by_step
        self.mapping = Online(cast(Tracker, self.tracker), cast(Mapper, self.mapper))

    def _step_by_step(self, what: str) -> None:
        time.sleep(0.0005)  # else the log grows by millions

    def frame(self, keyframe: bool = False, state: TrackingState = OK) -> None:
        self.mapping.after(*self.tracker.track(keyframe, state))
        self.mapping.advance()

    def threads(self) -> list[threading.Thread]:
        return [thread for thread in threading.enumerate() if thread.name == 'mapper']


@pytest.fixture
def session() -> Iterator[Session]:
    made = Session(view_interval=4)
    yield made
    made.mapper.hook = lambda what: None
    try:
        list(made.mapping.finish())
    except DeliberateError:
        pass
    assert not made.threads()


def test_online_every_keyframe_arrives_in_order(session: Session) -> None:
    for k in range(200):
        session.frame(keyframe=k in {0, 6, 7})
    expected = [0, 5, 6, 7, *range(11, 200, 4)]
    eventually(lambda: len(session.mapper.views) == len(expected))
    assert session.mapper.inserted == expected


def test_online_a_correction_keeps_its_place(session: Session) -> None:
    session.frame(keyframe=True)
    session.frame()
    session.mapping.correct(correction(1))
    session.frame(keyframe=True)
    list(session.mapping.finish())
    told = [line for line in session.mapper.log if line[0] in 'ic']
    assert told.index('insert 0') < told.index('correct 1') < told.index('insert 2')


def test_online_the_mapper_goes_on_while_nothing_comes(session: Session) -> None:
    time.sleep(0.02)
    assert session.mapper.log == []  # nothing to work on yet
    session.frame(keyframe=True)
    session.frame()
    eventually(lambda: session.mapper.log.count('step') > 20)
    assert session.mapper.log[:2] == ['insert 0', 'update']


def test_online_work_between_steps_is_done_by_the_mappers_thread(session: Session) -> None:
    seen: list[tuple[str, int]] = []
    session.frame(keyframe=True)
    session.frame()
    for _ in range(3):
        session.mapping.between_steps(
            lambda mapper: seen.append((threading.current_thread().name, len(mapper.views)))
        )
    eventually(lambda: len(seen) == 3)
    assert {name for name, _ in seen} == {'mapper'}


@pytest.mark.parametrize('what', ['step', 'insert'])
def test_online_the_tracker_never_waits_for_the_mapper(session: Session, what: str) -> None:
    busy, go_on, waited = threading.Event(), threading.Event(), threading.Event()

    def slow(now: str) -> None:
        if now == what:
            busy.set()
            go_on.wait(PATIENCE_S)
            waited.set()

    session.mapper.hook = slow
    session.frame(keyframe=True)
    session.frame()
    assert busy.wait(PATIENCE_S)
    for _ in range(8):
        session.frame(keyframe=True)
    assert not waited.is_set()
    session.mapper.hook = lambda now: None
    go_on.set()
    list(session.mapping.finish())
    assert session.mapper.inserted == [0, *range(2, 10)]


def test_online_the_answers_reach_the_tracker(session: Session) -> None:
    session.mapper.pending = [update(1), update(2)]
    session.frame(keyframe=True)
    session.frame()
    eventually(lambda: 'update' in session.mapper.log)
    assert not session.tracker.removed  # taken with a frame only
    eventually(lambda: not session.mapping._answers.empty())
    session.frame()
    assert session.tracker.removed == [1]
    session.frame(keyframe=True)
    eventually(lambda: session.mapper.log.count('update') == 2)
    eventually(lambda: not session.mapping._answers.empty())
    session.frame()
    assert session.tracker.removed == [1, 2]


@pytest.mark.parametrize('what', ['insert', 'step'])
def test_online_what_the_mapper_raises_is_raised_by_the_next_frame_and_by_finishing(
    session: Session, what: str
) -> None:
    def failing(now: str) -> None:
        if now == what:
            raise DeliberateError

    session.mapper.hook = failing
    session.frame(keyframe=True)
    session.frame()
    eventually(lambda: not session.threads())
    for _ in range(2):
        with pytest.raises(DeliberateError):
            session.frame()
    with pytest.raises(DeliberateError):
        list(session.mapping.finish())


def test_online_finishing_inserts_what_was_left_and_ends_the_thread(session: Session) -> None:
    block = threading.Event()
    entered = threading.Event()

    def blocked(what: str) -> None:
        entered.set()
        assert block.wait(PATIENCE_S)

    session.mapper.hook = blocked
    session.frame(keyframe=True)
    session.frame()
    assert entered.wait(PATIENCE_S)
    for _ in range(3):
        session.frame(keyframe=True)
    threading.Timer(0.02, block.set).start()
    session.mapping.finish()  # whether or not anybody asks what is left
    assert session.mapper.inserted == [0, 2, 3, 4]
    assert not session.threads()


def test_online_a_single_frame_is_mapped_in_the_end(session: Session) -> None:
    session.frame(keyframe=True)
    list(session.mapping.finish())
    assert session.mapper.inserted == [0]


def test_online_without_any_frame_just_ends(session: Session) -> None:
    assert list(session.mapping.finish()) == []
    assert session.mapper.log == []
