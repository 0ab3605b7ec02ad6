# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""When a tracker told of a fault, came back, or was wrong and sure: on motions made by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.fault_scores import Reference, Run, Score, score, silent
from benchmarks.frame_faults import Fault, Faulted, Shot
from dcgs_ros.core import se3
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.datasets.source import BadFrame

RATE_HZ, FRAMES = 10, 60
BEGIN, END = 20, 30
SIGMA_M = 0.002
TURNED = se3.exp(np.array([3.0, -1.0, 2.0, 0.3, 0.5, -0.2]))  # from the truth's world
TIMES_S = np.arange(FRAMES) / RATE_HZ
TRUTH = np.stack(
    [se3.exp(np.array([0.3 * t, 0.1 * np.sin(t), 0.2 * t * t / 6, 0.0, 0.0, 0.0]))
     for t in TIMES_S]
)  # fmt: skip
SHOTS = [Shot(BadFrame('', ''), float(TIMES_S[k]), TRUTH[k], k) for k in range(FRAMES)]
FAULT = Fault('some', '', 1.0, lambda clip, seconds, seed: Faulted(SHOTS, BEGIN, END))
FAULTED = Faulted(SHOTS, BEGIN, END)


def run(moves_m: NDArray[np.float64], states: Sequence[str]) -> Run:
    """A run whose poses are off by so much along the camera's x axis."""
    results: list[TrackResult | None] = []
    for k in range(FRAMES):
        if states[k] == 'refused':
            results.append(None)
            continue
        T = TURNED @ TRUTH[k] @ se3.exp(np.array([moves_m[k], 0, 0, 0, 0, 0]))
        covariance = np.diag([SIGMA_M**2 / 3] * 3 + [1e-6] * 3)
        results.append(
            TrackResult(
                k, T, np.eye(4), covariance, covariance, TrackingState(states[k]), None, 0, 0, 0,
                False, (), 0.0,
            )
        )  # fmt: skip
    return Run(SHOTS, results)


NOWHERE_OFF = np.zeros(FRAMES)
ALL_OK = ['ok'] * FRAMES
SEEN = np.ones(FRAMES, np.bool_)
CLEAN = run(NOWHERE_OFF, ALL_OK)


def during(state: str, begin: int = BEGIN, end: int = END) -> list[str]:
    return [state if begin <= k < end else 'ok' for k in range(FRAMES)]


def off_by(metres: float, begin: int = BEGIN, end: int = FRAMES) -> NDArray[np.float64]:
    return np.where((np.arange(FRAMES) >= begin) & (np.arange(FRAMES) < end), metres, 0.0)


def scored(
    moves_m: NDArray[np.float64],
    states: Sequence[str],
    fault: Fault = FAULT,
    seen: NDArray[np.bool_] = SEEN,
) -> Score:
    return score(fault, FAULTED, run(moves_m, states), Reference.of(CLEAN), seen)


def test_a_right_pose_is_never_silent_in_whatever_world() -> None:
    found = scored(NOWHERE_OFF, ALL_OK)
    assert (found.silent, found.absolute) == (0, 0)
    assert found.worst_cm == pytest.approx(0.0, abs=1e-6)
    assert found.recovered_s == 0.0 and found.detected_s is None


def test_a_jump_is_an_error_of_the_second_in_which_it_happens() -> None:
    frames = silent(run(off_by(0.2), ALL_OK))
    assert np.flatnonzero(frames.off).tolist() == list(range(BEGIN, BEGIN + RATE_HZ))
    found = scored(off_by(0.2), ALL_OK)
    assert (found.silent, found.silent_10_cm) == (RATE_HZ, RATE_HZ)
    assert found.absolute == FRAMES - BEGIN and found.recovered_s is None
    assert found.worst_cm == pytest.approx(20.0)


def test_a_pose_that_is_lost_is_not_silent_and_is_no_reference() -> None:
    """Back where it was after a loss: right. Elsewhere: wrong since before the loss."""
    lost = during('lost')
    assert scored(off_by(0.5, BEGIN, END), lost).silent == 0
    found = scored(off_by(0.5), lost)
    assert found.silent == RATE_HZ
    assert found.recovered_s is None and found.detected_s == 0.0


def test_an_error_below_10_cm_is_silent_beyond_15_claimed_sigmas() -> None:
    for share, wrong in ((0.9, 0), (1.1, RATE_HZ)):
        found = scored(off_by(share * 15 * SIGMA_M), ALL_OK)
        assert (found.silent, found.silent_10_cm) == (wrong, 0)


def test_the_last_second_is_one_of_true_time_whatever_the_stamps_say() -> None:
    """Those of the results here are nanoseconds apart."""
    assert scored(off_by(0.2, 0, BEGIN - 5), ALL_OK).silent == 5


def test_no_error_is_known_of_a_frame_without_a_pose() -> None:
    found = scored(off_by(0.3, BEGIN, END), during('refused'))
    assert (found.silent, found.absolute, found.detected_s) == (0, 0, 0.0)
    assert found.states['refused'] == END - BEGIN


def test_detected_counts_from_the_beginning_and_only_while_the_fault_lasts() -> None:
    assert scored(NOWHERE_OFF, during('lost', BEGIN + 3, END)).detected_s == pytest.approx(0.3)
    assert scored(NOWHERE_OFF, during('lost', END + 1, END + 5)).detected_s is None
    assert scored(NOWHERE_OFF, during('lost', BEGIN - 5, BEGIN)).detected_s is None


def test_degenerate_is_no_detection_where_no_direction_is_known() -> None:
    blind = Fault('blind', '', 1.0, FAULT.transform, degenerate_detects=False)
    assert scored(NOWHERE_OFF, during('degenerate')).detected_s == 0.0
    assert scored(NOWHERE_OFF, during('degenerate'), blind).detected_s is None


def test_recovered_is_right_and_sure_for_a_while() -> None:
    late = during('lost', BEGIN, END + 4)
    assert scored(NOWHERE_OFF, late).recovered_s == pytest.approx(0.4)
    passing = off_by(0.5, BEGIN, END + 7)
    passing[END + 2] = 0.0
    assert scored(passing, ALL_OK).recovered_s == pytest.approx(0.7)


def test_recovery_counts_from_when_a_place_seen_before_is_in_view() -> None:
    late = during('lost', BEGIN, END + 9)
    coming = np.arange(FRAMES) >= END + 6
    found = scored(NOWHERE_OFF, late, seen=coming)
    assert found.seen and found.recovered_s == pytest.approx(0.3)
    assert scored(NOWHERE_OFF, ALL_OK, seen=coming).recovered_s == 0.0
    never = scored(NOWHERE_OFF, during('lost', BEGIN, FRAMES), seen=~SEEN)
    assert never.recovered_s is None and not never.seen


def test_a_turned_camera_has_not_recovered_though_its_place_is_right() -> None:
    r = run(NOWHERE_OFF, ALL_OK)
    turn = se3.exp(np.array([0, 0, 0, 0, np.radians(20.0), 0]))
    poses = [r.results[k] for k in range(FRAMES)]
    turned = [
        result if k < BEGIN or result is None
        else TrackResult(**{**vars(result), 'T_world_cam': result.T_world_cam @ turn})
        for k, result in enumerate(poses)
    ]  # fmt: skip
    found = score(FAULT, FAULTED, Run(SHOTS, turned), Reference.of(CLEAN), SEEN)
    assert found.recovered_s is None and found.absolute == FRAMES - BEGIN
