# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Keyframes reach the mapper whatever happens to it, and the tracker never waits for that."""

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

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction, Keyframe, PosedFrame
from dcgs_ros.nodes.messages.packet import KeyframePacket
from dcgs_ros.nodes.tracking import keyframe_sender as module
from dcgs_ros.nodes.tracking.keyframe_sender import KeyframeSender

CAMERA = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
PLENTY_MB = 100.0
NOTHING_MB = 1e-6  # every keyframe is one too many
SOON_S = 120.0  # only a failure takes so long
JPEG_LEVELS = 6.0  # of 255, of a smooth image


def packet_of(
    stamp_ns: int, ids: range, epoch: int = 1, frame: RgbdFrame | None = None
) -> KeyframePacket:
    """Pack a keyframe whose rows tell their ids; without ids it is a view."""
    if frame is None:
        color = np.full((24, 32, 3), stamp_ns % 256, np.uint8)
        frame = RgbdFrame(stamp_ns, stamp_ns, color, np.full((24, 32), 1.0, np.float32))
    posed = PosedFrame(frame, np.eye(4), np.eye(4))
    if ids:
        numbers = np.array(ids, np.int64)
        rows = np.repeat(numbers[:, None], 3, axis=1).astype(np.float32)
        posed = Keyframe(frame, np.eye(4), np.eye(4), numbers, rows, -rows)
    return KeyframePacket(epoch, CAMERA, posed, 'optical')


def keyframe_of(packet: KeyframePacket) -> Keyframe:
    assert isinstance(packet.posed, Keyframe)
    return packet.posed


def all_alive(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.ones(len(ids), np.bool_)


class Mapper:
    """Takes packets as the mapper node does: one of each stamp, a new epoch begins anew."""

    def __init__(self) -> None:
        self.epoch = 0
        self.stamps: set[int] = set()
        self.ids: set[int] = set()

    def take(self, packet: KeyframePacket) -> None:
        if not isinstance(packet.posed, Keyframe):
            return
        if packet.epoch != self.epoch:
            self.epoch, self.stamps, self.ids = packet.epoch, set(), set()
        stamp = packet.stamp_ns
        if stamp not in self.stamps:
            self.stamps.add(stamp)
            self.ids |= set(packet.posed.ids.tolist())


class Wire:
    """A transport whose messages arrive when the test says so."""

    def __init__(self, up: bool = True) -> None:
        self.up, self.raises = up, False
        self.waiting: deque[KeyframePacket] = deque()
        self.sent: list[KeyframePacket] = []
        self.on_send: Callable[[], object] = lambda: None

    def connected(self) -> bool:
        return self.up

    def send(self, packet: KeyframePacket) -> None:
        self.on_send()
        if self.raises:
            raise RuntimeError('the context is no longer valid')
        self.sent.append(packet)
        self.waiting.append(packet)

    def stamps(self) -> list[int]:
        return [packet.stamp_ns for packet in list(self.sent)]


@pytest.fixture(autouse=True, scope='module')
def impatient() -> Iterator[None]:
    """Shorten the waiting times from seconds to milliseconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, '_PATIENCE_S', 0.02)
        patch.setattr(module, '_TICK_S', 0.001)
        yield


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no packet count as lost while the test runs."""
    monkeypatch.setattr(module, '_PATIENCE_S', SOON_S)


@contextmanager
def running(
    wire: Wire,
    memory_mb: float = PLENTY_MB,
    alive: Callable[[NDArray[np.int64]], NDArray[np.bool_]] = all_alive,
) -> Iterator[KeyframeSender]:
    sender = KeyframeSender(wire, memory_mb, alive)
    try:
        yield sender
    finally:
        sender.close()


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + SOON_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)


def settle(wire: Wire, sender: KeyframeSender, mapper: Mapper, newest: int) -> None:
    """Deliver and acknowledge everything until the newest has come and nothing is missing."""

    def exchange() -> bool:
        while wire.waiting:
            mapper.take(wire.waiting.popleft())
        sender.acknowledge(list(mapper.stamps))
        return newest in mapper.stamps and sender.missing == 0

    wait_for(exchange)


def test_a_keyframe_goes_out_at_once_as_it_is(patient: None) -> None:
    wire, sent = Wire(), packet_of(7, range(3))
    with running(wire) as sender:
        sender.put(sent)
        wait_for(lambda: bool(wire.sent))
        assert wire.sent[0] is sent
        assert (sender.sent, sender.resent) == (1, 0)


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
    """With any losses, delays and restarts, and with hardly any memory."""
    wire, mapper = Wire(), Mapper()
    given_out = 0
    with running(wire, memory_mb) as sender:
        for stamp, event in enumerate(events):
            if event == 'keyframe':
                sender.put(packet_of(stamp, range(given_out, given_out + 3)))
                given_out += 3
            elif event == 'view':
                sender.put(packet_of(stamp, range(0)))
            elif event == 'deliver' and wire.waiting:
                mapper.take(wire.waiting.popleft())
            elif event == 'lose':
                wire.waiting.clear()
            elif event == 'tell':
                sender.acknowledge(list(mapper.stamps))
            elif event == 'restart':
                mapper = Mapper()
                wire.waiting.clear()
                sender.acknowledge([])
            elif event in ('up', 'down'):
                wire.up = event == 'up'
            elif event == 'raise':
                wire.raises = not wire.raises
            else:
                time.sleep(0.002)
        wire.up, wire.raises = True, False
        newest = len(events)
        sender.put(packet_of(newest, range(given_out, given_out + 1)))
        settle(wire, sender, mapper, newest)
        assert mapper.ids == set(range(given_out + 1))
        mapper = Mapper()  # and once more
        sender.acknowledge([])
        settle(wire, sender, mapper, newest)
        assert mapper.ids == set(range(given_out + 1))


@given(count=st.integers(1, 40))
@settings(max_examples=20, deadline=None)
def test_thinning_keeps_every_id_with_its_own_row_and_the_newest_keyframes(count: int) -> None:
    wire, mapper = Wire(up=False), Mapper()
    with running(wire, NOTHING_MB) as sender:
        for k in range(count):
            sender.put(packet_of(k, range(5 * k, 5 * k + k % 5 + 1)))
        wait_for(lambda: sender._queue.empty())
        wire.up = True
        settle(wire, sender, mapper, count - 1)
    ids = np.concatenate([keyframe_of(packet).ids for packet in wire.sent])
    assert set(ids.tolist()) == {5 * k + n for k in range(count) for n in range(k % 5 + 1)}
    for packet in wire.sent:
        keyframe = keyframe_of(packet)
        rows = np.repeat(keyframe.ids[:, None], 3, axis=1)
        np.testing.assert_array_equal(keyframe.means, rows)
        np.testing.assert_array_equal(keyframe.normals, -rows)
    assert {count - 1, max(count - 2, 0)} <= set(wire.stamps())
    assert len(set(wire.stamps())) <= 4


def test_what_the_mapper_has_is_thinned_too_and_comes_back_if_it_restarts() -> None:
    wire, mapper = Wire(), Mapper()
    with running(wire, NOTHING_MB) as sender:
        for k in range(30):
            sender.put(packet_of(k, range(3 * k, 3 * k + 3)))
            settle(wire, sender, mapper, k)
        before, mapper = len(wire.sent), Mapper()
        sender.acknowledge([])
        settle(wire, sender, mapper, 29)
    assert mapper.ids == set(range(90))
    assert len(set(wire.stamps()[before:])) <= 4


def in_submap(packet: KeyframePacket, submap: int) -> KeyframePacket:
    return replace(packet, posed=replace(keyframe_of(packet), submap=submap))


def test_gaussians_of_two_sub_maps_never_share_a_keyframe() -> None:
    """They move with it when the sub-maps are joined."""
    wire, mapper = Wire(up=False), Mapper()
    with running(wire, NOTHING_MB) as sender:
        for k in range(12):
            sender.put(in_submap(packet_of(k, range(3 * k, 3 * k + 3)), int(k >= 5)))
        wait_for(lambda: sender._queue.empty())
        wire.up = True
        settle(wire, sender, mapper, 11)
    assert mapper.ids == set(range(36))
    for packet in wire.sent:
        assert len({id >= 15 for id in keyframe_of(packet).ids.tolist()}) == 1


def test_what_is_kept_moves_with_a_correction_and_is_not_sent_for_it() -> None:
    """Else thinning would join Gaussians of the old world to a keyframe of the new one."""
    wire, mapper, T = Wire(), Mapper(), se3.exp(np.arange(6.0))
    with running(wire, PLENTY_MB) as sender:
        for k in range(2):
            sender.put(packet_of(k, range(3 * k, 3 * k + 3)))
        settle(wire, sender, mapper, 1)
        before = len(wire.sent)
        correction = Correction(
            1, np.array([1, 7]), np.array([T, T]), np.zeros((2, 6, 6)), np.zeros(2, np.int32)
        )
        sender.correct(correction)
        wait_for(lambda: sender._queue.empty())
        time.sleep(0.05)
        assert len(wire.sent) == before  # nothing that the mapper cannot move itself
        mapper = Mapper()
        sender.acknowledge([])
        settle(wire, sender, mapper, 1)
    still, moved = (keyframe_of(p) for p in sorted(wire.sent[-2:], key=lambda p: p.stamp_ns))
    np.testing.assert_array_equal(still.T_world_cam, np.eye(4))
    np.testing.assert_allclose(moved.T_world_cam, T, atol=1e-12)
    expected = se3.transform(T, np.repeat(moved.ids[:, None], 3, axis=1).astype(float))
    np.testing.assert_allclose(moved.means, expected, rtol=1e-6)


@pytest.mark.parametrize('told', [[0], [1], [0, 1], []])
def test_thinning_gives_nothing_to_a_keyframe_that_will_not_be_sent(told: list[int]) -> None:
    """A mapper that has one of two keyframes still gets the other's Gaussians."""
    wire, mapper = Wire(), Mapper()
    with running(wire, 600e-6) as sender:  # two keyframes fit, three do not
        for k in range(2):
            sender.put(packet_of(k, range(3 * k, 3 * k + 3)))
        wait_for(lambda: len(wire.stamps()) >= 2 and sender.missing == 2)
        for packet in list(wire.sent)[:2]:
            if packet.stamp_ns in told:
                mapper.take(packet)
        wire.waiting.clear()
        sender.acknowledge(list(mapper.stamps))
        wire.up = False
        time.sleep(0.05)  # what is on its way is given up
        for k in range(2, 6):
            sender.put(packet_of(k, range(3 * k, 3 * k + 3)))
        wait_for(lambda: sender._queue.empty())
        wire.up = True
        settle(wire, sender, mapper, 5)
    assert mapper.ids == set(range(18))


def test_what_is_sent_again_is_what_it_was() -> None:
    """Except for the JPEG; depth in millimetres, as it is sent, and 0 beyond the range."""
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
        first = packet_of(5, range(4), epoch=9, frame=frame)
        first = replace(first, posed=replace(first.posed, T_world_cam=T, T_cam_cam_at_depth=T))
        wire = Wire(up=False)
        with running(wire) as sender:
            sender.put(first)
            wait_for(lambda: sender.missing == 1)
            wire.up = True
            wait_for(lambda: bool(wire.sent))  # noqa: B023
        again, keyframe = wire.sent[0], keyframe_of(wire.sent[0])
        assert (again.epoch, again.camera, again.camera_frame) == (9, CAMERA, 'optical')
        assert (keyframe.frame.stamp_ns, keyframe.frame.depth_stamp_ns) == (5, 6)
        np.testing.assert_array_equal(keyframe.T_world_cam, T)
        np.testing.assert_array_equal(keyframe.T_cam_cam_at_depth, T)
        np.testing.assert_array_equal(keyframe.ids, range(4))
        seen = keyframe.frame.color
        assert seen.shape == image.shape and seen.flags['C_CONTIGUOUS']
        assert np.abs(seen.astype(float) - image).max() < JPEG_LEVELS
        assert keyframe.frame.depth_m.dtype == np.float32
        np.testing.assert_array_equal(np.rint(1000 * keyframe.frame.depth_m), expected)


def test_images_are_not_kept_as_they_were() -> None:
    """They would take many times the allowed memory."""
    wire, sent = Wire(up=False), packet_of(5, range(4))
    images: list[weakref.ref[Any]] = [
        weakref.ref(sent.posed.frame.color),
        weakref.ref(sent.posed.frame.depth_m),
    ]
    with running(wire) as sender:
        sender.put(sent)
        del sent
        wait_for(lambda: sender.missing == 1)
        wait_for(lambda: all(image() is None for image in images))


def test_gaussians_that_are_gone_are_not_sent_again() -> None:
    wire = Wire(up=False)
    with running(wire, alive=lambda ids: ids % 2 == 0) as sender:
        sender.put(packet_of(5, range(10)))
        wait_for(lambda: sender.missing == 1)
        wire.up = True
        wait_for(lambda: bool(wire.sent))
    keyframe = keyframe_of(wire.sent[0])
    np.testing.assert_array_equal(keyframe.ids, range(0, 10, 2))
    np.testing.assert_array_equal(keyframe.means[:, 1], range(0, 10, 2))


def test_the_oldest_that_is_missing_comes_first_and_a_few_at_a_time(patient: None) -> None:
    wire = Wire(up=False)
    with running(wire) as sender:
        for k in (4, 1, 3, 0, 2):
            sender.put(packet_of(k, range(k, k + 1)))
        wait_for(lambda: sender.missing == 5)
        wire.up = True
        wait_for(lambda: len(wire.sent) == 2)
        time.sleep(0.02)
        assert wire.stamps() == [0, 1]
        sender.acknowledge([0])
        wait_for(lambda: len(wire.sent) == 3)
        time.sleep(0.02)
        assert wire.stamps() == [0, 1, 2]
        assert sender.missing == 4


def test_what_a_mapper_has_is_not_sent_again(patient: None) -> None:
    wire = Wire()
    with running(wire) as sender:
        sender.put(packet_of(3, range(2)))
        wait_for(lambda: sender.missing == 1)
        sender.acknowledge([3])
        assert sender.missing == 0
        time.sleep(0.05)
        assert wire.stamps() == [3]


def test_views_are_sent_once_or_not_at_all() -> None:
    wire = Wire()
    with running(wire) as sender:
        sender.put(packet_of(1, range(0)))
        wait_for(lambda: bool(wire.sent))
        wire.up = False
        sender.put(packet_of(2, range(0)))
        wait_for(lambda: sender.left_out == 1)
        wire.up = True
        time.sleep(0.06)
        assert wire.stamps() == [1] and sender.missing == 0


def test_views_give_way_to_keyframes_that_are_on_their_way(patient: None) -> None:
    wire = Wire()
    with running(wire) as sender:
        for k in range(6):
            sender.put(packet_of(k, range(k, k + 1)))
        wait_for(lambda: sender.missing == 6)
        sender.put(packet_of(10, range(0)))
        wait_for(lambda: sender.left_out == 1)
        assert wire.stamps() == [0, 1, 2, 3]
        sender.acknowledge(range(6))
        sender.put(packet_of(11, range(0)))
        wait_for(lambda: 11 in wire.stamps())


def test_putting_never_waits_for_a_transport_that_does() -> None:
    """Views beyond a few are left out, keyframes never."""
    wire, go_on = Wire(), threading.Event()
    wire.on_send = lambda: go_on.wait(SOON_S)
    with running(wire) as sender:
        for k in range(100):
            sender.put(packet_of(k, range(0)))
        for k in range(100, 150):
            sender.put(packet_of(k, range(k, k + 1)))
        assert not wire.sent  # it still waits
        assert 100 - 2 * module._QUEUED < sender.left_out < 100
        assert isinstance(sender.missing, int)
        sender.acknowledge([])
        go_on.set()
        wait_for(lambda: sender.missing == 50)


def test_closing_does_not_wait_for_what_waits() -> None:
    wire, go_on = Wire(), threading.Event()
    wire.on_send = lambda: go_on.wait(SOON_S)
    sender = KeyframeSender(wire, PLENTY_MB, all_alive)
    for k in range(200):
        sender.put(packet_of(k, range(k, k + 1)))
    closing = threading.Thread(target=sender.close)
    closing.start()
    wait_for(lambda: sender._closed)
    go_on.set()
    closing.join(SOON_S)
    assert not closing.is_alive() and not sender._thread.is_alive()
    assert len(wire.sent) <= 1  # the one that was on its way
    sender.close()  # twice is once


def test_a_transport_that_raises_is_counted_and_used_again() -> None:
    wire, mapper = Wire(), Mapper()
    wire.raises = True
    with running(wire) as sender:
        for k in range(5):
            sender.put(packet_of(k, range(k, k + 1)))
        sender.put(packet_of(9, range(0)))
        wait_for(lambda: sender.missing == 5 and sender.failed > 0)
        assert 'no longer valid' in str(sender.failure)
        wire.raises = False
        settle(wire, sender, mapper, 4)
        assert mapper.ids == set(range(5))


@pytest.mark.parametrize('fault', ['made', 'sent'])
def test_one_keyframe_that_cannot_be_sent_holds_no_other_up(fault: str) -> None:
    class Choosy(Wire):
        def send(self, packet: KeyframePacket) -> None:
            if fault == 'sent' and 0 in keyframe_of(packet).ids:
                raise ValueError('it does not fit into a message')
            super().send(packet)

    def alive(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        if fault == 'made' and 0 in ids:
            raise IndexError('nobody knows')
        return all_alive(ids)

    wire, mapper = Choosy(up=False), Mapper()
    with running(wire, alive=alive) as sender:
        for k in range(4):
            sender.put(packet_of(k, range(k, k + 1)))
        wait_for(lambda: sender.missing == 4)
        wire.up = True

        def others_are_there() -> bool:
            while wire.waiting:
                mapper.take(wire.waiting.popleft())
            sender.acknowledge(list(mapper.stamps))
            return mapper.ids == {1, 2, 3}

        wait_for(others_are_there)
        assert sender.missing == 1 and sender.failed > 0


@pytest.mark.parametrize('told', [True, False])
def test_of_a_map_that_is_over_nothing_is_sent_any_more(told: bool) -> None:
    """Neither what was kept nor what still waited, also if only the next map tells the sender."""
    wire, mapper = Wire(), Mapper()
    busy, go_on = threading.Event(), threading.Event()

    def hold() -> None:
        busy.set()
        go_on.wait(SOON_S)

    wire.on_send = hold
    with running(wire) as sender:
        for k in range(5):
            sender.put(packet_of(k, range(k, k + 1), epoch=1))
        assert busy.wait(SOON_S)
        if told:
            sender.forget()
            assert sender.missing == 0
        sender.put(packet_of(7, range(100, 103), epoch=2))
        go_on.set()
        wait_for(lambda: 7 in wire.stamps())
        settle(wire, sender, mapper, 7)
        time.sleep(0.06)
        assert wire.stamps()[0] == 0 and set(wire.stamps()[1:]) == {7}
        assert (mapper.epoch, mapper.ids) == (2, {100, 101, 102})
        assert sender.missing == 0
