# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Who hands what to whom, and when: with a tracker and a mapper that only keep the books."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config import Config, override
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.gaussian_map import GaussianMap
from dcgs_ros.core.mapper import Keyframe, Mapper, MapUpdate
from dcgs_ros.core.slam import Handover, Lockstep, Online, apply
from dcgs_ros.core.tracker import Tracker, TrackingState, TrackResult
from dcgs_ros.datasets.synthetic import SyntheticSource

PATIENCE_S = 120.0  # far more than any wait here takes
NO_IDS = np.empty(0, np.int64)
OK, LOST, DEGENERATE = TrackingState.OK, TrackingState.LOST, TrackingState.DEGENERATE


class DeliberateError(Exception):
    """What a mapper of these tests raises."""


class FakeTracker:
    """Spawns three Gaussians a keyframe."""

    def __init__(self) -> None:
        self.gaussians = GaussianMap(0.06)
        self.opening_motion = np.eye(4)
        self.keyframes = 0
        self.frames = 0

    def track(
        self, keyframe: bool = False, state: TrackingState = OK
    ) -> tuple[RgbdFrame, TrackResult]:
        """Track a frame that is stamped with how many there were before."""
        spawned = self.spawn() if keyframe else NO_IDS
        self.keyframes += keyframe
        stamp_ns, self.frames = self.frames, self.frames + 1
        pose, motion = np.eye(4), np.eye(4)
        pose[0, 3], motion[1, 3] = stamp_ns, -stamp_ns
        color = np.zeros((2, 2, 3), np.uint8)
        frame = RgbdFrame(stamp_ns, stamp_ns, color, np.ones((2, 2), np.float32))
        result = TrackResult(
            stamp_ns, pose, motion, np.eye(6), state, None, 100, 100, 50, keyframe, spawned, 0.0
        )
        return frame, result

    def spawn(self) -> NDArray[np.int64]:
        means = np.random.default_rng(self.frames).uniform(-1, 1, (3, 3)).astype(np.float32)
        normals = np.tile(np.array([0, 0, -1], np.float32), (3, 1))
        return self.gaussians.add(means, normals, np.zeros(3, 'f4'), np.zeros(3), self.keyframes)


class FakeMapper:
    """Writes down what it is asked to do."""

    def __init__(self, **settings: Any) -> None:
        values = {f'mapping.{name}': value for name, value in settings.items()}
        self.config = override(Config(), values)
        self.views: list[Keyframe] = []
        self.log: list[str] = []
        self.rates: list[float] = []
        self.pending: list[MapUpdate] = []
        self.hook: Callable[[str], None] = lambda what: None

    def insert(self, keyframe: Keyframe) -> None:
        self.hook('insert')
        self.views.append(keyframe)
        self.log.append(f'insert {keyframe.frame.stamp_ns}')

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
        return [keyframe.frame.stamp_ns for keyframe in self.views]


def update(
    ids: NDArray = NO_IDS,
    normal: tuple[float, float, float] = (0, 0, -1),
    removed: NDArray = NO_IDS,
) -> MapUpdate:
    n = len(ids)
    normals, flatness = np.tile(np.array(normal, np.float32), (n, 1)), np.full(n, 0.25, np.float32)
    return MapUpdate(ids, np.full((n, 3), 9.0, np.float32), normals, flatness, removed)


def handover(tracker: FakeTracker, interval: int = 3) -> Handover:
    return Handover(
        cast(Tracker, tracker), override(Config(), {'mapping.view_interval': interval})
    )


def lockstep(tracker: FakeTracker, mapper: FakeMapper) -> Lockstep:
    return Lockstep(cast(Tracker, tracker), cast(Mapper, mapper))


def handed(over: Handover, *tracked: tuple[RgbdFrame, TrackResult]) -> list[list[int]]:
    """Stamps of the keyframes that each frame brought."""
    return [[k.frame.stamp_ns for k in over.after(*pair)] for pair in tracked]


def test_the_first_keyframe_waits_for_the_second_frame() -> None:
    tracker = FakeTracker()
    over = handover(tracker, interval=10)
    assert handed(over, tracker.track(keyframe=True)) == [[]]
    assert handed(over, tracker.track(), tracker.track()) == [[0], []]
    assert over.rest() == []


def test_the_first_keyframe_has_its_gaussians_as_the_second_frame_placed_them() -> None:
    """The tracker may begin its map anew with it: some move, some are no more."""
    tracker = FakeTracker()
    over = handover(tracker)
    frame, result = tracker.track(keyframe=True)
    assert over.after(frame, result) == []
    tracker.gaussians = GaussianMap(0.06)
    means = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    normals = np.array([[0, 1, 0], [1, 0, 0]], np.float32)
    tracker.gaussians.add(means, normals, np.zeros(2, np.float32), np.zeros(3), 0)
    (keyframe,) = over.after(*tracker.track())
    assert keyframe.frame is frame
    np.testing.assert_array_equal(keyframe.ids, [0, 1])
    np.testing.assert_array_equal(keyframe.means, means)
    np.testing.assert_array_equal(keyframe.normals, normals)


def test_a_second_frame_that_is_a_keyframe_comes_right_behind_the_first() -> None:
    tracker = FakeTracker()
    over = handover(tracker)
    assert handed(over, tracker.track(keyframe=True)) == [[]]
    assert handed(over, tracker.track(keyframe=True)) == [[0, 1]]


def test_a_sequence_of_one_frame_leaves_it_to_the_rest() -> None:
    tracker = FakeTracker()
    over = handover(tracker)
    frame, result = tracker.track(keyframe=True)
    over.after(frame, result)
    (keyframe,) = over.rest()
    assert keyframe.frame is frame
    np.testing.assert_array_equal(keyframe.ids, result.spawned)
    assert over.rest() == []


def test_frames_between_keyframes_come_at_their_interval() -> None:
    """Counted from the last one that came, for whatever reason."""
    tracker = FakeTracker()
    over = handover(tracker, interval=3)
    key = {0, 6, 7}
    found = handed(over, tracker.track(keyframe=True))
    found += [handed(over, tracker.track(keyframe=k in key))[0] for k in range(1, 14)]
    came = [stamp for stamps in found for stamp in stamps]
    assert came == [0, 4, 6, 7, 10, 13]


def test_lost_frames_never_come_and_do_not_count() -> None:
    tracker = FakeTracker()
    over = handover(tracker, interval=2)
    assert handed(over, tracker.track(keyframe=True)) == [[]]
    assert handed(over, tracker.track(state=LOST), tracker.track(state=LOST)) == [[], []]
    assert handed(over, tracker.track()) == [[0]]
    assert handed(over, *(tracker.track(state=LOST) for _ in range(5))) == [[]] * 5
    assert handed(over, tracker.track(), tracker.track(state=DEGENERATE)) == [[], [8 + 2]]


def test_a_keyframe_is_what_was_tracked_and_what_is_still_alive_of_it() -> None:
    tracker = FakeTracker()
    over = handover(tracker)
    handed(over, tracker.track(keyframe=True), tracker.track())
    frame, result = tracker.track(keyframe=True)
    tracker.gaussians.remove(result.spawned[1:2])
    (keyframe,) = over.after(frame, result)
    alive = result.spawned[[0, 2]]
    assert keyframe.frame is frame
    np.testing.assert_array_equal(keyframe.T_world_cam, result.T_world_cam)
    np.testing.assert_array_equal(keyframe.T_colour_depth, result.T_colour_depth)
    np.testing.assert_array_equal(keyframe.ids, alive)
    np.testing.assert_array_equal(keyframe.means, tracker.gaussians.means[alive])
    np.testing.assert_array_equal(keyframe.normals, tracker.gaussians.normals[alive])


def test_what_was_handed_over_does_not_change_with_the_trackers_map() -> None:
    """The mapper reads it in another thread."""
    tracker = FakeTracker()
    over = handover(tracker)
    handed(over, tracker.track(keyframe=True), tracker.track())
    (keyframe,) = over.after(*tracker.track(keyframe=True))
    means, normals = keyframe.means.copy(), keyframe.normals.copy()
    tracker.gaussians.reshape(keyframe.ids, np.ones((3, 3), np.float32), np.ones(3, np.float32))
    tracker.gaussians.remove(keyframe.ids)
    np.testing.assert_array_equal(keyframe.means, means)
    np.testing.assert_array_equal(keyframe.normals, normals)


def follow(mapping: Lockstep, tracker: FakeTracker, frames: int, keyframes: set[int]) -> None:
    for k in range(frames):
        mapping.after(*tracker.track(keyframe=k in keyframes))
        mapping.advance()


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


def test_after_alone_does_no_work() -> None:
    tracker, mapper = FakeTracker(), FakeMapper()
    mapping = lockstep(tracker, mapper)
    for k in range(3):
        mapping.after(*tracker.track(keyframe=k == 0))
    assert mapper.log == []
    mapping.advance()
    assert mapper.log[0] == 'insert 0'


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


def test_an_answer_reshapes_and_removes_but_moves_nobody() -> None:
    tracker = FakeTracker()
    for _ in range(3):
        tracker.track(keyframe=True)
    before = tracker.gaussians.means.copy()
    ids, gone = np.array([7, 1, 4], np.int64), np.array([0, 4, 99], np.int64)
    apply(update(ids, (0.6, 0, 0.8), gone), cast(Tracker, tracker))
    alive = tracker.gaussians.alive(np.arange(9))
    np.testing.assert_array_equal(alive, ~np.isin(np.arange(9), gone))
    np.testing.assert_array_equal(tracker.gaussians.means[alive], before[alive])
    changed = np.isin(np.arange(9), [7, 1])
    np.testing.assert_array_equal(tracker.gaussians.flatness[alive & changed], 0.25)
    np.testing.assert_array_equal(tracker.gaussians.flatness[alive & ~changed], 0)
    half = np.array([-0.3, 0, -0.9]) / np.sqrt(0.9)  # of the way, on the side it was
    found = tracker.gaussians.normals[alive & changed]
    np.testing.assert_allclose(found, np.tile(half, (2, 1)), atol=1e-6)


def test_in_lockstep_the_answer_is_the_trackers_at_once() -> None:
    tracker, mapper = FakeTracker(), FakeMapper()
    mapper.pending = [update(removed=np.array([1], np.int64))]
    follow(lockstep(tracker, mapper), tracker, 2, {0})
    np.testing.assert_array_equal(tracker.gaussians.alive(np.arange(3)), [True, False, True])


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


def test_online_the_mapper_goes_on_while_nothing_comes(session: Session) -> None:
    time.sleep(0.02)
    assert session.mapper.log == []  # nothing to work on yet
    session.frame(keyframe=True)
    session.frame()
    eventually(lambda: session.mapper.log.count('step') > 20)
    assert session.mapper.log[:2] == ['insert 0', 'update']


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
    session.mapper.pending = [update(removed=np.array([1])), update(removed=np.array([2]))]
    session.frame(keyframe=True)
    session.frame()
    eventually(lambda: 'update' in session.mapper.log)
    assert session.tracker.gaussians.alive(np.arange(3)).all()  # taken with a frame only
    eventually(lambda: not session.mapping._answers.empty())
    session.frame()
    np.testing.assert_array_equal(
        session.tracker.gaussians.alive(np.arange(3)), [True, False, True]
    )
    session.frame(keyframe=True)
    eventually(lambda: session.mapper.log.count('update') == 2)
    eventually(lambda: not session.mapping._answers.empty())
    session.frame()
    assert not session.tracker.gaussians.alive(np.array([2])).any()


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


KINECT = 'synthetic:room?frames=3&sensor=kinect'


@cache
def opening() -> tuple[SyntheticSource, tuple[RgbdFrame, ...]]:
    """Source whose depth is stamped, and taken, before the colour; its first frames."""
    source = SyntheticSource.from_address(KINECT)
    return source, tuple(source)


def tracker_for(source: SyntheticSource) -> Tracker:
    return Tracker(source.camera, replace(Config(), sensor=source.sensor, threads=1))


def test_the_depth_of_the_first_keyframe_is_placed_as_its_gaussians_are() -> None:
    """By how far the camera went between the stamps; their constant offset is not known yet."""
    source, frames = opening()
    tracker = tracker_for(source)
    over = Handover(tracker, tracker.config)
    assert over.after(frames[0], tracker.track(frames[0])) == []
    (keyframe, *_) = over.after(frames[1], tracker.track(frames[1]))
    taken_ns = keyframe.frame.depth_stamp_ns + round(source.colour_depth_offset_ms * 1e6)
    colour, depth = source.pose(keyframe.frame.stamp_ns), source.pose(taken_ns)
    motion = se3.log(se3.inverse(colour) @ depth)
    error = se3.log(se3.inverse(se3.inverse(colour) @ depth) @ keyframe.T_colour_depth)
    assert np.linalg.norm(error[:3]) < 0.6 * np.linalg.norm(motion[:3])
    assert np.linalg.norm(error[3:]) < 0.6 * np.linalg.norm(motion[3:])


def test_a_mapper_that_removes_almost_everything_does_not_make_the_tracker_start_over() -> None:
    """At the pose of the first frame, with ids that the mapper knows as others'."""
    source, frames = opening()
    start = se3.exp(np.array([5.0, 0, 0, 0, 0, 1.0]))
    config = replace(Config(), sensor=source.sensor, threads=1)
    tracker = Tracker(source.camera, config, start)
    first = tracker.track(frames[0])
    second = tracker.track(frames[1])
    used = int(tracker.gaussians.ids.max())
    apply(update(removed=tracker.gaussians.ids[20:].copy()), tracker)
    third = tracker.track(frames[2])
    assert not len(third.spawned) or third.spawned.min() > used
    there = second.T_world_cam if third.state is LOST else third.T_world_cam
    moved = se3.log(se3.inverse(second.T_world_cam) @ there)
    assert np.linalg.norm(moved[:3]) < 0.05
    assert first.state is OK
