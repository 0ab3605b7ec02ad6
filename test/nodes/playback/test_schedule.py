# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""When a recording's items are due, and what the clock says then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from itertools import islice
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dcgs_ros.datasets.source import SourceError
from dcgs_ros.nodes.playback import schedule as module
from dcgs_ros.nodes.playback.schedule import Pacer, ScheduledItem, schedule

FIRST_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000
GAP_NS = 33_333_333
LATE_S = 0.02  # a thread wakes up late, never early
ROUNDING_S = 1e-6
TICK_S = 0.025
STEPS = st.lists(st.integers(-10_000_000, SECOND_NS), min_size=1, max_size=30)

Items = list[tuple[int, int]]


class Clock:
    """Time that passes only while somebody waits, always a little longer than he wanted."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def wait(self, timeout_s: float) -> bool:
        self.now_s += timeout_s + LATE_S
        return False

    def pace(self, rate: float, tick: Callable[[int], None]) -> Pacer:
        stop = SimpleNamespace(wait=self.wait, is_set=lambda: False)
        return Pacer(rate, tick, cast(threading.Event, stop))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(module, 'time', clock)
    return clock


def items_every(interval_ns: int, count: int) -> Items:
    return [(FIRST_NS + k * interval_ns, k) for k in range(count)]


@pytest.mark.slow
@given(STEPS)
def test_every_item_comes_once_in_order_and_time_never_goes_back(steps: list[int]) -> None:
    stamps = FIRST_NS + np.cumsum(steps)
    cues = list(schedule(lambda: zip(stamps.tolist(), range(len(stamps)), strict=True)))
    assert [cue.item for cue in cues] == list(range(len(stamps)))
    assert [cue.clock_ns for cue in cues] == np.maximum.accumulate(stamps).tolist()
    for cue in cues:
        assert cue.clock_ns - cue.elapsed_ns == stamps[0]
        assert cue.shift_ns == 0


@given(st.integers(0, 12), st.integers(0, 12))
def test_start_and_duration_cut_a_half_open_interval(start: int, duration: int) -> None:
    items = items_every(SECOND_NS, 10)
    expected = range(start, min(10, start + duration) if duration else 10)
    if not expected:
        with pytest.raises(SourceError, match=f'no frame from {start} s on'):
            list(schedule(lambda: items, float(start), float(duration)))
        return
    cues = list(schedule(lambda: items, float(start), float(duration)))
    assert [cue.item for cue in cues] == list(expected)
    assert cues[0].elapsed_ns == 0
    assert cues[0].clock_ns == FIRST_NS + start * SECOND_NS


@pytest.mark.parametrize('continuous', [False, True])
def test_a_loop_begins_again_a_frame_after_the_last(continuous: bool) -> None:
    items = items_every(SECOND_NS, 3)
    cues = list(islice(schedule(lambda: items, loop=True, continuous_stamps=continuous), 9))
    assert [cue.item for cue in cues] == 3 * [0, 1, 2]
    elapsed = np.array([cue.elapsed_ns for cue in cues])
    assert set(np.diff(elapsed)) == {SECOND_NS, GAP_NS}
    if continuous:
        assert [cue.clock_ns for cue in cues] == (FIRST_NS + elapsed).tolist()
    else:
        assert [cue.clock_ns for cue in cues] == 3 * [stamp for stamp, _ in items]
    for cue in cues:  # the clock says when an item is due by the stamp it is sent with
        assert cue.clock_ns == items[cue.item][0] + cue.shift_ns


def test_a_loop_reads_the_recording_anew_each_time() -> None:
    begun: list[int] = []

    def begin() -> Items:
        begun.append(len(begun))
        return items_every(GAP_NS, 2)

    list(islice(schedule(begin, loop=True), 6))
    assert begun == [0, 1, 2]


def test_an_empty_recording_is_told_even_in_a_loop() -> None:
    with pytest.raises(SourceError, match='nothing to replay'):
        next(schedule(lambda: [], loop=True))


@pytest.mark.parametrize('rate', [1.0, 4.0])
def test_nothing_is_early_and_lateness_does_not_add_up(rate: float, clock: Clock) -> None:
    pace, start = clock.pace(rate, lambda _: None), clock.now_s
    for cue in schedule(lambda: items_every(GAP_NS, 12)):
        assert pace.wait(cue)
        late_s = clock.now_s - start - 1e-9 * cue.elapsed_ns / rate
        assert -ROUNDING_S < late_s < LATE_S + ROUNDING_S


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, SECOND_NS), min_size=1, max_size=8), st.sampled_from([0, 2, 50]))
def test_the_clock_goes_on_between_items_and_never_back(
    clock: Clock, steps: list[int], rate: float
) -> None:
    ticks: list[int] = []
    pace = clock.pace(rate, ticks.append)
    stamps = (FIRST_NS + np.cumsum(steps)).tolist()
    for cue in schedule(lambda: zip(stamps, stamps, strict=True)):
        assert pace.wait(cue)
        assert ticks[-1] == cue.item
    assert ticks[0] == stamps[0]
    assert (np.diff(ticks) >= 0).all()
    if rate:
        most_ns = 1e9 * rate * (TICK_S + LATE_S + ROUNDING_S)
        assert np.diff([stamps[0], *ticks]).max() <= most_ns


def test_a_wait_ends_when_stopped() -> None:
    stop = threading.Event()
    pace = Pacer(1.0, lambda _: None, stop)
    assert pace.wait(ScheduledItem(0, 0, 0, None))
    timer = threading.Timer(0.05, stop.set)
    timer.start()
    start = time.monotonic()
    assert not pace.wait(ScheduledItem(60 * SECOND_NS, 60 * SECOND_NS, 0, None))
    assert time.monotonic() - start < 50
    timer.join()
