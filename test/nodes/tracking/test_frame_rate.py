# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Frames beyond a rate are left out evenly, whatever the clock does."""

from __future__ import annotations

import numpy as np
import pytest

from dcgs_ros.nodes.tracking.frame_rate import FrameRate

SECOND = 1_000_000_000
NOW = 1_700_000_000 * SECOND


def admitted(rate: FrameRate, camera_hz: float, count: int, jitter_s: float = 0.0) -> list[int]:
    """Which of a camera's frames are admitted."""
    jitter = np.random.default_rng(0).uniform(-jitter_s, jitter_s, count)
    stamps = NOW + np.round((np.arange(count) / camera_hz + jitter) * SECOND).astype(np.int64)
    return [k for k, stamp_ns in enumerate(stamps.tolist()) if rate.admits(stamp_ns)]


@pytest.mark.parametrize(
    ('max_hz', 'expected'),
    [(0.0, 300), (30.0, 300), (60.0, 300), (20.0, 200), (15.0, 150), (25.0, 250), (10.0, 100)],
)
@pytest.mark.parametrize('jitter_s', [0.0, 0.002])
def test_the_mean_rate_is_what_is_asked_for_and_even(
    max_hz: float, expected: int, jitter_s: float
) -> None:
    rate = FrameRate(max_hz)
    kept = admitted(rate, 30.0, 300, jitter_s)
    assert len(kept) == pytest.approx(expected, abs=2)
    assert rate.left_out == 300 - len(kept)
    steps = np.diff(kept)
    assert steps.max() - steps.min() <= (300 % expected != 0)


def test_after_a_gap_or_by_another_clock_it_begins_anew() -> None:
    """Without frames in a row to make up for the gap."""
    for jump_ns in (10 * SECOND, -10 * SECOND):
        rate = FrameRate(10.0)
        assert rate.admits(NOW) and not rate.admits(NOW + SECOND // 30)
        later = NOW + jump_ns
        found = [rate.admits(later + k * SECOND // 30) for k in range(6)]
        assert found == [True, False, False, True, False, False]
