# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Stretches of states divide the time of a run."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcgs_ros.core.tracking.result import TrackingState
from dcgs_ros.evaluation.states import states_report, stretches

OK, LOST = TrackingState.OK, TrackingState.LOST
STATES = list(TrackingState)


@given(st.lists(st.sampled_from(STATES), min_size=1), st.integers(0, 2**32))
def test_stretches_divide_frames_and_time(states: list[TrackingState], seed: int) -> None:
    steps_ns = np.random.default_rng(seed).integers(1, 10**9, len(states))
    stamps_ns = np.cumsum(steps_ns)
    found = stretches(stamps_ns, states)
    assert [s.state for s in found for _ in range(s.frames)] == states
    assert [s.end_ns for s in found[:-1]] == [s.start_ns for s in found[1:]]
    assert (found[0].start_ns, found[-1].end_ns) == (stamps_ns[0], stamps_ns[-1])
    report = states_report(stamps_ns, states)
    assert list(report) == [state.value for state in STATES]
    assert sum(state['frames'] for state in report.values()) == len(states)


def test_a_state_lasts_until_the_next_frame_in_another() -> None:
    stamps_ns = 10**8 * np.arange(8, dtype=np.int64)
    report = states_report(stamps_ns, [OK, LOST, OK, OK, LOST, LOST, OK, OK])
    assert report['lost'] == {'frames': 3, 'longest_s': pytest.approx(0.2)}
    assert report['ok'] == {'frames': 5, 'longest_s': pytest.approx(0.2)}
    assert report['relocalised'] == {'frames': 0, 'longest_s': 0.0}
    assert stretches(stamps_ns[:0], []) == []
