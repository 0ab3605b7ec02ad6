# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames arrive at the pace of their stamps, and only the newest that is due is yielded."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from dcgs_ros.cli.run.pacing import DroppedFrame, at_recorded_pace, on_demand
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.source import BadFrame

INTERVAL_NS = 20_000_000
PATIENCE_S = 60.0  # only a failure takes so long
START_NS = 5_000_000_000


def frame(index: int) -> RgbdFrame:
    stamp_ns = START_NS + index * INTERVAL_NS
    return RgbdFrame(
        stamp_ns, stamp_ns, np.zeros((16, 16), np.uint8), np.ones((16, 16), np.float32)
    )


def index_of(item: RgbdFrame | DroppedFrame) -> int:
    return (item.stamp_ns - START_NS) // INTERVAL_NS


def test_no_frame_comes_before_its_time() -> None:
    times_s, start_s = [], time.monotonic()
    with closing(at_recorded_pace(frame(k) for k in range(6))) as items:
        for _ in items:
            times_s.append(time.monotonic())
    assert len(times_s) == 6
    assert np.all(np.array(times_s) >= start_s + 1e-9 * INTERVAL_NS * np.arange(6))


def test_a_slow_consumer_gets_the_newest_and_the_others_as_dropped() -> None:
    begun, came, go_on = threading.Event(), threading.Event(), threading.Event()

    def camera() -> Iterator[RgbdFrame]:
        for k in range(10):
            if k == 1:
                assert begun.wait(PATIENCE_S)
            elif k == 6:
                came.set()  # all up to 5 have
                assert go_on.wait(PATIENCE_S)
            yield frame(k)

    kinds: dict[int, type] = {}
    with closing(at_recorded_pace(camera())) as items:
        for item in items:
            assert not isinstance(item, BadFrame)
            if not kinds:  # busy with the first one meanwhile
                begun.set()
                assert came.wait(PATIENCE_S)
            kinds[index_of(item)] = type(item)
            if index_of(item) == 5:
                go_on.set()
    assert list(kinds) == list(range(10))  # none is lost, and they keep their order
    assert [kinds[k] for k in range(6)] == [RgbdFrame, *[DroppedFrame] * 4, RgbdFrame]
    assert kinds[9] is RgbdFrame


def test_a_source_that_is_late_drops_none() -> None:
    asked = threading.Semaphore(1)

    def slowly() -> Iterator[RgbdFrame]:
        for k in range(4):
            assert asked.acquire(timeout=PATIENCE_S)  # until who tracks waits for it
            time.sleep(2e-9 * INTERVAL_NS)
            yield frame(k)

    kinds = []
    with closing(at_recorded_pace(slowly())) as items:
        for item in items:
            kinds.append(type(item))
            asked.release()
    assert kinds == [RgbdFrame] * 4


def test_bad_frames_pass_in_their_place() -> None:
    bad = BadFrame('2.png', 'is cut off')
    given: list[RgbdFrame | BadFrame] = [bad, frame(0), bad, frame(1)]
    with closing(at_recorded_pace(given)) as items:
        assert [isinstance(item, BadFrame) for item in items] == [True, False, True, False]


def test_an_error_is_raised_after_the_frames_before_it() -> None:
    def failing() -> Iterator[RgbdFrame]:
        yield frame(0)
        raise OSError('unplugged')

    seen = []
    with pytest.raises(OSError, match='unplugged'), closing(at_recorded_pace(failing())) as items:
        for item in items:
            seen.append(item)
    assert len(seen) == 1


def test_closing_early_waits_for_no_frame_and_ends_the_thread() -> None:
    before = set(threading.enumerate())
    start = time.monotonic()
    frames = iter([frame(0), frame(10_000)])  # 200 s later
    with closing(at_recorded_pace(frames)) as items:
        next(items)
    assert time.monotonic() - start < PATIENCE_S
    assert set(threading.enumerate()) <= before


def test_without_pacing_every_frame_comes_at_once() -> None:
    frames = [frame(0), frame(10_000)]
    assert list(on_demand(iter(frames))) == frames
