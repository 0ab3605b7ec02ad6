# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What /diagnostics say of a tracker's state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcgs_ros.core.tracking.observability import Observability, observability
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.nodes.health import Level
from dcgs_ros.nodes.tracking.health import Streams, Topic, judge, numbers, weakest_axis

FINE = Streams(color=30, depth=30, pairs=30, dropped=0, has_camera=True, silent_s=0.03)


def spectrum() -> Observability:
    """Return the observability of a camera that is free to move along its y."""
    H = np.diag([1e4, 1e1, 1e4, 1e5, 1e5, 1e5])
    return observability(H, H)


def result_in(state: TrackingState, seen: Observability | None = None) -> TrackResult:
    return TrackResult(
        1, np.eye(4), np.eye(4), np.eye(6), np.eye(6), state, seen, 2000, 1500, 120, False, (),
        -3.5,
    )  # fmt: skip


GOOD = result_in(TrackingState.OK, spectrum())


def test_normal_tracking_is_ok() -> None:
    verdict = judge(FINE, GOOD, False)
    assert (verdict.level, verdict.message) == (Level.OK, 'tracking')


@pytest.mark.parametrize(
    ('lacking', 'named'),
    [
        ({'has_camera': False}, 'camera_info'),
        ({'color': 0, 'depth': 0, 'pairs': 0}, 'no images'),
        ({'color': 0, 'pairs': 0}, 'no colour'),
        ({'depth': 0, 'pairs': 0}, 'no depth'),
        ({'pairs': 0}, 'sync_slop_s'),
        ({}, 'none could be used'),
    ],
)
def test_before_the_first_pose_what_is_missing_is_named(
    lacking: dict[str, Any], named: str
) -> None:
    verdict = judge(replace(FINE, **lacking), None, False)
    assert verdict.level is Level.ERROR and named in verdict.message


@pytest.mark.parametrize(
    ('gone', 'named'),
    [('color', 'no colour'), ('depth', 'no depth'), ('slop', 'sync_slop_s')],
)
@pytest.mark.parametrize('state', TrackingState)
def test_a_stream_that_ends_is_named_though_the_other_goes_on(
    gone: str, named: str, state: TrackingState
) -> None:
    """Even though the last pose was good."""
    lacking: dict[str, Any] = {} if gone == 'slop' else {gone: 0}
    streams = replace(FINE, pairs=0, **lacking)
    verdict = judge(streams, result_in(state, spectrum()), False)
    assert verdict.level is Level.ERROR and named in verdict.message


def test_a_slow_camera_is_no_broken_one() -> None:
    """At one image a second a report may fall between colour and depth."""
    for color, depth in ((1, 0), (0, 1), (1, 1), (2, 1)):
        streams = replace(FINE, color=color, depth=depth, pairs=0, silent_s=0.9)
        assert judge(streams, GOOD, False).level is Level.OK


def test_silence_is_an_error_however_good_the_last_pose() -> None:
    silent = Streams(color=0, depth=0, pairs=0, dropped=0, has_camera=True, silent_s=7.25)
    for state in TrackingState:
        verdict = judge(silent, result_in(state, spectrum()), False)
        assert verdict.level is Level.ERROR and '7.2 s' in verdict.message
    assert judge(replace(silent, silent_s=1.0), GOOD, False).level is Level.OK


@pytest.mark.parametrize('searching', [True, False])
def test_lost_is_an_error_that_says_what_to_do(searching: bool) -> None:
    verdict = judge(FINE, result_in(TrackingState.LOST), searching)
    assert verdict.level is Level.ERROR and '~/reset' in verdict.message
    assert ('looking for' in verdict.message) == searching


def test_degenerate_is_a_warning_that_names_the_direction() -> None:
    verdict = judge(FINE, result_in(TrackingState.DEGENERATE, spectrum()), False)
    assert verdict.level is Level.WARN and verdict.message.endswith("the camera's y")


def test_a_camera_that_was_found_again_is_a_warning_until_it_is_confirmed() -> None:
    verdict = judge(FINE, result_in(TrackingState.RELOCALISED, spectrum()), False)
    assert verdict.level is Level.WARN and 'to be confirmed' in verdict.message


@given(st.integers(0, 60), st.integers(0, 60))
def test_what_is_dropped_is_a_warning_beyond_a_few_in_a_hundred(pairs: int, dropped: int) -> None:
    streams = replace(FINE, color=60, depth=60, pairs=60 + pairs, dropped=dropped)
    verdict = judge(streams, GOOD, False)
    many = dropped > 0.05 * (60 + pairs)
    assert verdict.level is (Level.WARN if many else Level.OK)
    assert ('too slow' in verdict.message) == many


@given(
    st.integers(0, 100), st.integers(0, 100), st.integers(0, 100), st.integers(0, 100),
    st.booleans(), st.floats(0, 1e6), st.sampled_from([None, *TrackingState]), st.booleans(),
)  # fmt: skip
def test_whatever_comes_there_is_a_verdict_in_words(
    color: int, depth: int, pairs: int, dropped: int, has_camera: bool, silent_s: float,
    state: TrackingState | None, searching: bool,
) -> None:  # fmt: skip
    result = None if state is None else result_in(state, spectrum())
    verdict = judge(Streams(color, depth, pairs, dropped, has_camera, silent_s), result, searching)
    assert verdict.level in Level and verdict.message
    assert (verdict.level is Level.OK) == (verdict.message == 'tracking')


def message(streams: Streams, result: TrackResult | None = None, **known: Any) -> str:
    return judge(streams, result, False, **known).message


def test_a_camera_info_that_is_refused_is_no_camera_that_is_off() -> None:
    streams = replace(FINE, has_camera=False, refused_camera='fx is 0', silent_s=9.0)
    verdict = judge(streams, None, False)
    assert verdict.level is Level.ERROR and verdict.logged
    assert 'camera_info refused: fx is 0' in verdict.message and 'running' not in verdict.message


@pytest.mark.parametrize(
    ('topic', 'named'),
    [
        (Topic('/robot/x', 0), 'nobody publishes /robot/x'),
        (Topic('/robot/x', 1, incompatible=True), 'set node.reliability to best_effort'),
        (Topic('/robot/x', 1), '/robot/x has a publisher that sends nothing'),
    ],
)
@pytest.mark.parametrize('gone', ['color', 'depth', 'camera_info'])
def test_why_a_topic_is_silent_is_told_from_its_publishers(
    gone: str, topic: Topic, named: str
) -> None:
    silent: dict[str, Any] = {'has_camera': False} if gone == 'camera_info' else {gone: 0}
    assert named in message(replace(FINE, pairs=0, topics={gone: topic}, **silent))


def test_images_without_pairs_say_what_is_wrong_with_their_stamps() -> None:
    streams = replace(FINE, pairs=0)
    assert 'no stamp (0 s)' in message(replace(streams, unstamped=60))
    assert 'sync_slop_s' not in message(replace(streams, unstamped=60))
    near, far = (message(replace(streams, apart_s=apart)) for apart in (-0.412, 3600.0))
    assert '0.412 s apart' in near and 'raise node.sync_slop_s' in near
    assert '3600.000 s apart' in far and 'stamp both with one' in far and 'raise' not in far


def test_why_frames_are_refused_is_told() -> None:
    assert message(FINE, refusal='colour is yuv9').endswith('could be used: colour is yuv9')


def test_what_was_never_tracked_is_not_to_move_back() -> None:
    lost = result_in(TrackingState.LOST)
    begun, resumed = (
        judge(FINE, lost, searching, ever_tracked=False) for searching in (False, True)
    )
    assert 'no map can begin' in begun.message and 'depth' in begun.message
    assert "the mapper's map" in resumed.message and '~/reset' in resumed.message
    for verdict in (begun, resumed):
        assert 'move back' not in verdict.message and verdict.level is Level.ERROR


def test_an_unknown_place_on_the_base_is_a_warning() -> None:
    waiting = judge(FINE, None, False, doubt='waiting for TF')
    assert (waiting.level, waiting.message) == (Level.WARN, 'waiting for TF')
    assumed = judge(FINE, GOOD, False, doubt='no TF from a to b')
    assert assumed.level is Level.WARN
    assert assumed.message == 'tracking, but no TF from a to b'
    assert 'no depth' in message(replace(FINE, pairs=0, depth=0), doubt='waiting')


@pytest.mark.parametrize('axis', range(6))
@pytest.mark.parametrize('sign', [1, -1])
def test_a_direction_has_the_name_of_its_nearest_axis(axis: int, sign: int) -> None:
    direction = np.full(6, 0.1)
    direction[axis] = sign * 0.9
    name = weakest_axis(direction)
    assert name.endswith('xyz'[axis % 3]) and ('turning' in name) == (axis >= 3)


def test_numbers_are_plain_and_leave_out_what_is_not_known() -> None:
    shown = numbers(GOOD)
    assert shown['state'] == 'ok' and shown['inliers'] == 1500 and shown['landmarks'] == 120
    assert shown['kappa'] > 1 and shown['weakest'].endswith('y')
    assert all(type(value) in (int, float, str) for value in shown.values())
    lost = numbers(result_in(TrackingState.LOST))
    assert lost['state'] == 'lost' and not {'kappa', 'weakest'} & lost.keys()


def test_a_prior_that_is_not_used_is_named() -> None:
    priors = {'gyro': 'no reading for 0.52 s', 'wheels': 'used', 'planar': 'used'}
    verdict = judge(FINE, GOOD, False, priors=priors)
    assert verdict.level is Level.WARN
    assert verdict.message == 'tracking, but without gyro: no reading for 0.52 s'
    assert judge(FINE, GOOD, False, priors={'gyro': 'used'}).level is Level.OK
