# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Keyframes reach a mapper whatever happens to it; nobody waits for that."""

from __future__ import annotations

import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.mapper import Keyframe
from dcgs_ros.nodes import offers as module
from dcgs_ros.nodes.offers import Offer, Offers

CAMERA = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
PLENTY_MB = 100.0
NOTHING_MB = 1e-6  # every keyframe is one too many
SOON_S = 120.0  # only a failure takes so long
JPEG_LEVELS = 6.0  # of 255, of a smooth image


def offer_of(stamp_ns: int, ids: range, epoch: int = 1, frame: RgbdFrame | None = None) -> Offer:
    """Offer a keyframe whose rows tell their ids; without ids it is a view."""
    numbers = np.array(ids, np.int64)
    rows = np.repeat(numbers[:, None], 3, axis=1).astype(np.float32)
    if frame is None:
        color = np.full((24, 32, 3), stamp_ns % 256, np.uint8)
        frame = RgbdFrame(stamp_ns, stamp_ns, color, np.full((24, 32), 1.0, np.float32))
    keyframe = Keyframe(frame, np.eye(4), np.eye(4), numbers, rows, -rows)
    return Offer(epoch, CAMERA, keyframe)


def everybody(ids: NDArray) -> NDArray[np.bool_]:
    return np.ones(len(ids), np.bool_)


class Mapper:
    """Takes offers as the mapper node does: one of each stamp, a new epoch begins anew."""

    def __init__(self) -> None:
        self.epoch = 0
        self.stamps: set[int] = set()
        self.ids: set[int] = set()

    def take(self, offer: Offer) -> None:
        if not len(offer.keyframe.ids):
            return
        if offer.epoch != self.epoch:
            self.epoch, self.stamps, self.ids = offer.epoch, set(), set()
        stamp = offer.keyframe.frame.stamp_ns
        if stamp not in self.stamps:
            self.stamps.add(stamp)
            self.ids |= set(offer.keyframe.ids.tolist())


class Wire:
    """A link whose messages arrive when the test says so."""

    def __init__(self, up: bool = True) -> None:
        self.up, self.raises = up, False
        self.waiting: deque[Offer] = deque()
        self.sent: list[Offer] = []
        self.on_send: Callable[[], object] = lambda: None

    def connected(self) -> bool:
        return self.up

    def send(self, offer: Offer) -> None:
        self.on_send()
        if self.raises:
            raise RuntimeError('the context is no longer valid')
        self.sent.append(offer)
        self.waiting.append(offer)

    def stamps(self) -> list[int]:
        return [offer.keyframe.frame.stamp_ns for offer in list(self.sent)]


@pytest.fixture(autouse=True, scope='module')
def impatient() -> Iterator[None]:
    """What takes seconds over a network takes milliseconds here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, '_PATIENCE_S', 0.02)
        patch.setattr(module, '_TICK_S', 0.001)
        yield


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is given up as lost while the test runs."""
    monkeypatch.setattr(module, '_PATIENCE_S', SOON_S)


@contextmanager
def running(
    wire: Wire,
    memory_mb: float = PLENTY_MB,
    alive: Callable[[NDArray], NDArray[np.bool_]] = everybody,
) -> Iterator[Offers]:
    offers = Offers(wire, memory_mb, alive)
    try:
        yield offers
    finally:
        offers.close()


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def settle(wire: Wire, offers: Offers, mapper: Mapper, newest: int) -> None:
    """Deliver all, and tell what came, until the newest is there and nothing more is missing."""

    def exchange() -> bool:
        while wire.waiting:
            mapper.take(wire.waiting.popleft())
        offers.acknowledge(list(mapper.stamps))
        return newest in mapper.stamps and offers.missing == 0

    wait_for(exchange)


def test_a_keyframe_goes_out_at_once_as_it_is(patient: None) -> None:
    wire, sent = Wire(), offer_of(7, range(3))
    with running(wire) as offers:
        offers.put(sent)
        wait_for(lambda: bool(wire.sent))
        assert wire.sent[0] is sent
        assert (offers.offered, offers.offered_again) == (1, 0)


EVENTS = st.lists(
    st.sampled_from(
        ['keyframe', 'keyframe', 'keyframe', 'view', 'deliver', 'lose', 'tell', 'restart', 'down',
         'up', 'raise', 'wait']
    ),
    max_size=60,
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(EVENTS, st.sampled_from([PLENTY_MB, 0.01, NOTHING_MB]))
def test_in_the_end_the_mapper_has_every_gaussian(events: list[str], memory_mb: float) -> None:
    """Whatever is lost, late or restarted, and however little memory there is."""
    wire, mapper = Wire(), Mapper()
    given_out = 0
    with running(wire, memory_mb) as offers:
        for stamp, event in enumerate(events):
            if event == 'keyframe':
                offers.put(offer_of(stamp, range(given_out, given_out + 3)))
                given_out += 3
            elif event == 'view':
                offers.put(offer_of(stamp, range(0)))
            elif event == 'deliver' and wire.waiting:
                mapper.take(wire.waiting.popleft())
            elif event == 'lose':
                wire.waiting.clear()
            elif event == 'tell':
                offers.acknowledge(list(mapper.stamps))
            elif event == 'restart':
                mapper = Mapper()
                wire.waiting.clear()
                offers.acknowledge([])
            elif event in ('up', 'down'):
                wire.up = event == 'up'
            elif event == 'raise':
                wire.raises = not wire.raises
            else:
                time.sleep(0.002)
        wire.up, wire.raises = True, False
        newest = len(events)
        offers.put(offer_of(newest, range(given_out, given_out + 1)))
        settle(wire, offers, mapper, newest)
        assert mapper.ids == set(range(given_out + 1))
        mapper = Mapper()  # and once more
        offers.acknowledge([])
        settle(wire, offers, mapper, newest)
        assert mapper.ids == set(range(given_out + 1))


@given(count=st.integers(1, 40))
@settings(max_examples=20, deadline=None)
def test_thinning_keeps_every_id_with_its_own_row_and_the_newest_keyframes(count: int) -> None:
    wire, mapper = Wire(up=False), Mapper()
    with running(wire, NOTHING_MB) as offers:
        for k in range(count):
            offers.put(offer_of(k, range(5 * k, 5 * k + k % 5 + 1)))
        wait_for(lambda: offers._queue.empty())
        wire.up = True
        settle(wire, offers, mapper, count - 1)
    ids = np.concatenate([offer.keyframe.ids for offer in wire.sent])
    assert set(ids.tolist()) == {5 * k + n for k in range(count) for n in range(k % 5 + 1)}
    for offer in wire.sent:
        keyframe = offer.keyframe
        rows = np.repeat(keyframe.ids[:, None], 3, axis=1)
        np.testing.assert_array_equal(keyframe.means, rows)
        np.testing.assert_array_equal(keyframe.normals, -rows)
    assert {count - 1, max(count - 2, 0)} <= set(wire.stamps())
    assert len(set(wire.stamps())) <= 4


def test_what_the_mapper_has_is_thinned_too_and_comes_back_if_it_restarts() -> None:
    wire, mapper = Wire(), Mapper()
    with running(wire, NOTHING_MB) as offers:
        for k in range(30):
            offers.put(offer_of(k, range(3 * k, 3 * k + 3)))
            settle(wire, offers, mapper, k)
        before, mapper = len(wire.sent), Mapper()
        offers.acknowledge([])
        settle(wire, offers, mapper, 29)
    assert mapper.ids == set(range(90))
    assert len(set(wire.stamps()[before:])) <= 4


@pytest.mark.parametrize('told', [[0], [1], [0, 1], []])
def test_thinning_gives_nothing_to_a_keyframe_that_will_not_be_offered(told: list[int]) -> None:
    """The mapper that has one of two keyframes is still given the other's Gaussians."""
    wire, mapper = Wire(), Mapper()
    with running(wire, 600e-6) as offers:  # two keyframes fit, three do not
        for k in range(2):
            offers.put(offer_of(k, range(3 * k, 3 * k + 3)))
        wait_for(lambda: len(wire.stamps()) >= 2 and offers.missing == 2)
        for offer in list(wire.sent)[:2]:
            if offer.keyframe.frame.stamp_ns in told:
                mapper.take(offer)
        wire.waiting.clear()
        offers.acknowledge(list(mapper.stamps))
        wire.up = False
        time.sleep(0.05)  # what is on its way is given up
        for k in range(2, 6):
            offers.put(offer_of(k, range(3 * k, 3 * k + 3)))
        wait_for(lambda: offers._queue.empty())
        wire.up = True
        settle(wire, offers, mapper, 5)
    assert mapper.ids == set(range(18))


def test_what_is_offered_again_is_what_it_was() -> None:
    """But for the JPEG; depth as the wire has it, to the millimetre, and none beyond its range."""
    v, u = np.mgrid[:24, :32]
    color = np.stack([200 + u, 3 * v, 60 - u], axis=-1).astype(np.uint8)
    depth_m = (0.5 + 0.0301 * u + 0.0007 * v).astype(np.float32)
    depth_m[0, :6] = 0.0, np.nan, np.inf, 65.535, 65.5361, 70.0
    expected = np.rint(np.float32(1000) * depth_m)
    expected[0, :6] = 0, 0, 0, 65535, 0, 0
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    for image in (color, color[..., 0]):
        frame = RgbdFrame(5, 6, np.ascontiguousarray(image), depth_m)
        first = offer_of(5, range(4), epoch=9, frame=frame)
        first = replace(first, keyframe=replace(first.keyframe, T_world_cam=T, T_colour_depth=T))
        wire = Wire(up=False)
        with running(wire) as offers:
            offers.put(first)
            wait_for(lambda: offers.missing == 1)
            wire.up = True
            wait_for(lambda: bool(wire.sent))  # noqa: B023
        again, keyframe = wire.sent[0], wire.sent[0].keyframe
        assert (again.epoch, again.camera) == (9, CAMERA)
        assert (keyframe.frame.stamp_ns, keyframe.frame.depth_stamp_ns) == (5, 6)
        np.testing.assert_array_equal(keyframe.T_world_cam, T)
        np.testing.assert_array_equal(keyframe.T_colour_depth, T)
        np.testing.assert_array_equal(keyframe.ids, range(4))
        seen = keyframe.frame.color
        assert seen.shape == image.shape and seen.flags['C_CONTIGUOUS']
        assert np.abs(seen.astype(float) - image).max() < JPEG_LEVELS
        assert keyframe.frame.depth_m.dtype == np.float32
        np.testing.assert_array_equal(np.rint(1000 * keyframe.frame.depth_m), expected)


def test_images_are_not_kept_as_they_were() -> None:
    """They would take many times the memory that was allowed."""
    wire, sent = Wire(up=False), offer_of(5, range(4))
    images: list[weakref.ref[Any]] = [
        weakref.ref(sent.keyframe.frame.color),
        weakref.ref(sent.keyframe.frame.depth_m),
    ]
    with running(wire) as offers:
        offers.put(sent)
        del sent
        wait_for(lambda: offers.missing == 1)
        wait_for(lambda: all(image() is None for image in images))


def test_gaussians_that_are_gone_are_not_offered_again() -> None:
    wire = Wire(up=False)
    with running(wire, alive=lambda ids: ids % 2 == 0) as offers:
        offers.put(offer_of(5, range(10)))
        wait_for(lambda: offers.missing == 1)
        wire.up = True
        wait_for(lambda: bool(wire.sent))
    keyframe = wire.sent[0].keyframe
    np.testing.assert_array_equal(keyframe.ids, range(0, 10, 2))
    np.testing.assert_array_equal(keyframe.means[:, 1], range(0, 10, 2))


def test_the_oldest_that_is_missing_comes_first_and_a_few_at_a_time(patient: None) -> None:
    wire = Wire(up=False)
    with running(wire) as offers:
        for k in (4, 1, 3, 0, 2):
            offers.put(offer_of(k, range(k, k + 1)))
        wait_for(lambda: offers.missing == 5)
        wire.up = True
        wait_for(lambda: len(wire.sent) == 2)
        time.sleep(0.02)
        assert wire.stamps() == [0, 1]
        offers.acknowledge([0])
        wait_for(lambda: len(wire.sent) == 3)
        time.sleep(0.02)
        assert wire.stamps() == [0, 1, 2]
        assert offers.missing == 4


def test_what_a_mapper_has_is_not_offered_again(patient: None) -> None:
    wire = Wire()
    with running(wire) as offers:
        offers.put(offer_of(3, range(2)))
        wait_for(lambda: offers.missing == 1)
        offers.acknowledge([3])
        assert offers.missing == 0
        time.sleep(0.05)
        assert wire.stamps() == [3]


def test_views_are_sent_once_or_not_at_all() -> None:
    wire = Wire()
    with running(wire) as offers:
        offers.put(offer_of(1, range(0)))
        wait_for(lambda: bool(wire.sent))
        wire.up = False
        offers.put(offer_of(2, range(0)))
        wait_for(lambda: offers.left_out == 1)
        wire.up = True
        time.sleep(0.06)
        assert wire.stamps() == [1] and offers.missing == 0


def test_views_give_way_to_keyframes_that_are_on_their_way(patient: None) -> None:
    wire = Wire()
    with running(wire) as offers:
        for k in range(6):
            offers.put(offer_of(k, range(k, k + 1)))
        wait_for(lambda: offers.missing == 6)
        offers.put(offer_of(10, range(0)))
        wait_for(lambda: offers.left_out == 1)
        assert wire.stamps() == [0, 1, 2, 3]
        offers.acknowledge(range(6))
        offers.put(offer_of(11, range(0)))
        wait_for(lambda: 11 in wire.stamps())


def test_putting_never_waits_for_a_link_that_does() -> None:
    """Views beyond a few are left out, keyframes never."""
    wire, go_on = Wire(), threading.Event()
    wire.on_send = lambda: go_on.wait(SOON_S)
    with running(wire) as offers:
        for k in range(100):
            offers.put(offer_of(k, range(0)))
        for k in range(100, 150):
            offers.put(offer_of(k, range(k, k + 1)))
        assert not wire.sent  # it still waits
        assert 100 - 2 * module._QUEUED < offers.left_out < 100
        assert isinstance(offers.missing, int)
        offers.acknowledge([])
        go_on.set()
        wait_for(lambda: offers.missing == 50)


def test_closing_does_not_wait_for_what_waits() -> None:
    wire, go_on = Wire(), threading.Event()
    wire.on_send = lambda: go_on.wait(SOON_S)
    offers = Offers(wire, PLENTY_MB, everybody)
    for k in range(200):
        offers.put(offer_of(k, range(k, k + 1)))
    closing = threading.Thread(target=offers.close)
    closing.start()
    wait_for(lambda: offers._closed)
    go_on.set()
    closing.join(SOON_S)
    assert not closing.is_alive() and not offers._thread.is_alive()
    assert len(wire.sent) <= 1  # the one that was on its way
    offers.close()  # twice is once


def test_a_link_that_raises_is_told_of_and_used_again() -> None:
    wire, mapper = Wire(), Mapper()
    wire.raises = True
    with running(wire) as offers:
        for k in range(5):
            offers.put(offer_of(k, range(k, k + 1)))
        offers.put(offer_of(9, range(0)))
        wait_for(lambda: offers.missing == 5 and offers.failed > 0)
        assert 'no longer valid' in str(offers.failure)
        wire.raises = False
        settle(wire, offers, mapper, 4)
        assert mapper.ids == set(range(5))


@pytest.mark.parametrize('fault', ['made', 'sent'])
def test_one_keyframe_that_cannot_be_offered_holds_no_other_up(fault: str) -> None:
    class Choosy(Wire):
        def send(self, offer: Offer) -> None:
            if fault == 'sent' and 0 in offer.keyframe.ids:
                raise ValueError('it does not fit into a message')
            super().send(offer)

    def alive(ids: NDArray) -> NDArray[np.bool_]:
        if fault == 'made' and 0 in ids:
            raise IndexError('nobody knows')
        return everybody(ids)

    wire, mapper = Choosy(up=False), Mapper()
    with running(wire, alive=alive) as offers:
        for k in range(4):
            offers.put(offer_of(k, range(k, k + 1)))
        wait_for(lambda: offers.missing == 4)
        wire.up = True

        def others_are_there() -> bool:
            while wire.waiting:
                mapper.take(wire.waiting.popleft())
            offers.acknowledge(list(mapper.stamps))
            return mapper.ids == {1, 2, 3}

        wait_for(others_are_there)
        assert offers.missing == 1 and offers.failed > 0


@pytest.mark.parametrize('told', [True, False])
def test_of_a_map_that_is_over_nothing_is_offered_any_more(told: bool) -> None:
    """Neither what was kept nor what still waited for the sender; the next map tells it too."""
    wire, mapper = Wire(), Mapper()
    busy, go_on = threading.Event(), threading.Event()

    def hold() -> None:
        busy.set()
        go_on.wait(SOON_S)

    wire.on_send = hold
    with running(wire) as offers:
        for k in range(5):
            offers.put(offer_of(k, range(k, k + 1), epoch=1))
        assert busy.wait(SOON_S)
        if told:
            offers.forget()
            assert offers.missing == 0
        offers.put(offer_of(7, range(100, 103), epoch=2))
        go_on.set()
        wait_for(lambda: 7 in wire.stamps())
        settle(wire, offers, mapper, 7)
        time.sleep(0.06)
        assert wire.stamps()[0] == 0 and set(wire.stamps()[1:]) == {7}
        assert (mapper.epoch, mapper.ids) == (2, {100, 101, 102})
        assert offers.missing == 0
