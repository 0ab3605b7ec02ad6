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


@pytest.mark.parametrize(
    'text',
    ["frame refused: {} of 'camera {}' at -{}.25 s", 'frame refused: (inf, 0.{}, nan) not usable',
     'frame refused: a skew of {}e-321 pixels', 'frame refused: a skew of -inf pixels'],
)  # fmt: skip
def test_a_message_that_repeats_is_said_ever_more_seldom_whatever_its_numbers(
    clock: Clock, text: str
) -> None:
    throttle, said = Throttle(), list[float]()
    for k in range(4000):
        clock.now_s = 0.1 * k
        if throttle.admits(text.format(k, k, k)):
            said.append(clock.now_s)
    assert said == pytest.approx([0, 5, 15, 35, 75, 135, 195, 255, 315, 375], abs=1.0)
    clock.now_s += 200.0
    assert throttle.admits(text) and not throttle.admits(text)
    clock.now_s += 5.1  # after a rest it is as at first
    assert throttle.admits(text)


def test_any_number_of_kinds_is_no_flood(clock: Clock) -> None:
    throttle = Throttle()
    said = sum(throttle.admits('refused: ' + chr(1000 + k)) for k in range(5000))
    assert said <= 8


def test_a_cause_that_lasts_is_told_once_and_again_a_minute_after_its_end(clock: Clock) -> None:
    news, told = News(), list[tuple[int, str]]()
    for second in range(200):
        clock.now_s = 1000.0 + second
        lasting = [f'no images for {second}.5 s'] if second < 80 or second > 150 else []
        for text in [*lasting, 'degenerate', *(['no colour'] if second == 9 else [])]:
            if news.is_new(text):
                told.append((second, text.split()[0]))
    assert told == [(1, 'no'), (1, 'degenerate'), (152, 'no')]  # what was seen once is no news
