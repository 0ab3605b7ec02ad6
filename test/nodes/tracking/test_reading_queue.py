# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Readings are there when their frame is tracked, and nobody waits long for them."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from dcgs_ros.core.priors.readings import AngularRate, BasePose
from dcgs_ros.nodes.tracking.reading_queue import ReadingQueue

MS = 1_000_000
START = 1_700_000_000 * 10**9
SOON_S = 0.015  # less than a frame waits at most


def queue() -> ReadingQueue:
    return ReadingQueue({'gyro': 5 * MS, 'wheels': 20 * MS})


def rate(ms: int) -> AngularRate:
    return AngularRate(START + ms * MS, np.zeros(3))


def pose(ms: int) -> BasePose:
    return BasePose(START + ms * MS, np.eye(4))


def taken(one: ReadingQueue, ms: int) -> tuple[list[int], float]:
    """Return the stamps that a frame gets, in ms, and how long it waits, in seconds."""
    start = time.monotonic()
    stamps = [(reading.stamp_ns - START) // MS for reading in one.take(START + ms * MS)]
    return stamps, time.monotonic() - start


def test_readings_come_in_the_order_of_their_stamps_and_once() -> None:
    one = queue()
    for ms in (0, 20, 40):
        one.put('wheels', pose(ms))
    for ms in range(0, 45, 5):
        one.put('gyro', rate(ms))
    stamps, waited_s = taken(one, 33)
    assert stamps == sorted([*range(0, 45, 5), 0, 20, 40])
    assert waited_s < SOON_S
    assert taken(one, 40)[0] == []


def test_a_frame_waits_for_the_readings_of_its_time() -> None:
    one = queue()
    one.put('gyro', rate(0))
    threading.Timer(0.005, lambda: one.put('gyro', rate(30))).start()
    assert taken(one, 33)[0] == [0, 30]


@pytest.mark.parametrize('lag_ms', [60, 5_000, -5_000])
def test_it_does_not_wait_long_for_what_does_not_come(lag_ms: int) -> None:
    """For a sensor that lags by far, or is of another clock, not at all."""
    one = queue()
    one.put('gyro', rate(0))
    stamps, waited_s = taken(one, lag_ms)
    assert stamps == [0]
    assert waited_s < (0.2 if lag_ms == 60 else SOON_S)


def test_a_sensor_that_is_silent_is_not_waited_for() -> None:
    one = queue()
    assert taken(one, 0)[1] < SOON_S
    one.put('gyro', rate(0))
    time.sleep(0.12)
    assert taken(one, 60)[1] < SOON_S


def test_a_clock_that_jumps_back_keeps_the_order_of_arrival() -> None:
    one = queue()
    for ms in (9_000, 9_005, 0, 5):
        one.put('gyro', rate(ms))
    assert taken(one, 5)[0] == [9_000, 9_005, 0, 5]


def test_without_frames_the_newest_are_kept() -> None:
    one = queue()
    for ms in range(2500):
        one.put('gyro', rate(ms))
    assert taken(one, 2500)[0] == list(range(500, 2500))
