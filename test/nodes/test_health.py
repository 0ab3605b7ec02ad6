# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the log of a node says, and how often."""

from __future__ import annotations

import pytest

from dcgs_ros.nodes import health
from dcgs_ros.nodes.health import News, Throttle


class Clock:
    now_s = 50.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(health, 'time', clock)
    return clock


def test_a_message_is_not_hidden_by_another(clock: Clock) -> None:
    throttle = Throttle()
    texts = [
        'frame refused: stamp lies 0.033 s before', 'the camera changed from 640x480: a new map',
        "frame refused: depth in 'x'", 'lost, 0.2 s after the last frame: looking',
    ]  # fmt: skip
    assert all(throttle.admits(text) for text in texts)
    assert not any(throttle.admits(text) for text in texts)


def test_a_message_that_repeats_is_said_every_five_seconds_whatever_its_numbers(
    clock: Clock,
) -> None:
    throttle, said = Throttle(), list[float]()
    for k in range(400):
        clock.now_s = 0.1 * k
        if throttle.admits(f"frame refused: {k} of 'camera {k}' at {-0.5 * k:.2f} s"):
            said.append(clock.now_s)
    assert said == pytest.approx([0, 5, 10, 15, 20, 25, 30, 35], abs=0.15)


def test_any_number_of_kinds_is_no_flood(clock: Clock) -> None:
    throttle = Throttle()
    said = sum(throttle.admits('refused: ' + chr(1000 + k)) for k in range(5000))
    assert said <= 100


def test_a_cause_that_lasts_is_told_once_and_again_a_minute_after_its_end(clock: Clock) -> None:
    news, told = News(), list[tuple[int, str]]()
    for second in range(200):
        clock.now_s = 1000.0 + second
        lasting = [f'no images for {second}.5 s'] if second < 80 or second > 150 else []
        for text in [*lasting, 'degenerate', *(['no colour'] if second == 9 else [])]:
            if news.is_new(text):
                told.append((second, text.split()[0]))
    assert told == [(1, 'no'), (1, 'degenerate'), (152, 'no')]  # what was seen once is no news
