# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Images that repeat are a camera at rest only where they have no noise; a claim covers both."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.motion import ConstantVelocity
from dcgs_ros.core.tracking.propagation import MotionLimit
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.standstill import Standstill
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.tracking.verification import Usual
from dcgs_ros.datasets.synthetic.source import SyntheticSource

FRAME_NS = 33_333_333
OK, DEGENERATE, LOST = TrackingState.OK, TrackingState.DEGENERATE, TrackingState.LOST
MILLIMETRE2 = 1e-6 * np.eye(6)
RENDERED, MEASURED = Usual(chi2=0.01, frames=5), Usual(chi2=0.5, frames=5)


@cache
def room(sensor: str) -> tuple[SyntheticSource, tuple[RgbdFrame, ...]]:
    source = SyntheticSource.from_address(f'synthetic:room?frames=10&sensor={sensor}')
    return source, tuple(source)


def tracker_for(sensor: str) -> Tracker:
    source = room(sensor)[0]
    return Tracker(source.camera, replace(Config(), sensor=source.sensor))


def later(frame: RgbdFrame, frames: int) -> RgbdFrame:
    shift = frames * FRAME_NS
    return replace(
        frame, stamp_ns=frame.stamp_ns + shift, depth_stamp_ns=frame.depth_stamp_ns + shift
    )


def repeated(tracker: Tracker, frame: RgbdFrame, times: int) -> list[TrackResult]:
    return [tracker.track(later(frame, k)) for k in range(1, times + 1)]


def sigma_m(result: TrackResult) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(result.covariance[:3, :3])[-1]))


def begun(velocity: float, usual: Usual) -> Standstill | None:
    twist = np.array([velocity, 0, 0, 0, 0, 0])
    motion = ConstantVelocity(np.eye(4), 0, twist, 1e-9 * FRAME_NS)
    return Standstill.begun(motion, MotionLimit.begun(MILLIMETRE2, np.eye(4), 0), usual, FRAME_NS)


def test_a_rendered_camera_at_rest_is_tracked_and_goes_on() -> None:
    """For two seconds, after which half a second without an estimate would be a loss."""
    tracker, frames = tracker_for('ideal'), room('ideal')[1]
    before = [tracker.track(frame) for frame in frames[:6]][-1]
    memory = tracker._memory
    tracker._memory = replace(memory, motion=replace(memory.motion, twist=np.zeros(6)))
    for result in repeated(tracker, frames[5], 60):
        assert result.state is OK and not result.keyframe and sigma_m(result) < 0.005
        np.testing.assert_array_equal(result.T_world_cam, before.T_world_cam)
    after = [tracker.track(later(frame, 60)) for frame in frames[6:]]
    assert [result.state for result in after] == [OK] * 4


def test_a_camera_that_starts_at_rest_is_tracked_but_nothing_is_measured() -> None:
    """Whether its images have noise is not known yet: the claim grows as a hand could move."""
    tracker, frames = tracker_for('ideal'), room('ideal')[1]
    assert tracker.track(frames[0]).keyframe
    still = repeated(tracker, frames[0], 30)
    assert [result.state for result in still[1:]] == [DEGENERATE] * 29
    assert [len(result.keyframes) for result in still] == [1] + [0] * 29
    assert sigma_m(still[-1]) > 0.1
    after = [tracker.track(later(frame, 30)) for frame in frames[1:]]
    assert after[-1].state is OK and LOST not in {result.state for result in after}


def test_rendered_images_that_hang_in_motion_are_not_sure_for_long() -> None:
    """It may have stopped: the claim is at least the way that it would have gone since."""
    tracker, frames = tracker_for('ideal'), room('ideal')[1]
    for frame in frames[:6]:
        tracker.track(frame)
    speed = float(np.linalg.norm(tracker._memory.motion.twist[:3]))
    assert speed > 0.1
    for k, result in enumerate(repeated(tracker, frames[5], 30), 1):
        assert sigma_m(result) >= 1e-9 * k * FRAME_NS * speed
    assert result.state is DEGENERATE


def test_images_of_a_sensor_with_noise_do_not_repeat_by_themselves() -> None:
    tracker, frames = tracker_for('kinect'), room('kinect')[1]
    for frame in frames[:6]:
        tracker.track(frame)
    assert [result.state for result in repeated(tracker, frames[5], 5)] == [LOST] * 5


@pytest.mark.parametrize(
    ('velocity', 'usual', 'stands'),
    [(0.0, RENDERED, True), (0.5, RENDERED, True), (5.0, RENDERED, False), (0.0, MEASURED, False)],
)
def test_a_standstill_is_one_that_can_be(velocity: float, usual: Usual, stands: bool) -> None:
    assert (begun(velocity, usual) is not None) is stands


def test_the_covariance_is_that_of_before_and_the_way_that_it_may_have_gone() -> None:
    still = begun(0.5, RENDERED)
    assert still is not None
    limit = still.limit(MotionLimit.begun(MILLIMETRE2, np.eye(4), FRAME_NS), 10 * FRAME_NS)
    expected = MILLIMETRE2.copy()
    expected[0, 0] += (0.5 * 10e-9 * FRAME_NS) ** 2
    np.testing.assert_allclose(limit.covariance, expected, rtol=0.05, atol=1e-8)
    assert limit.stamp_ns == 10 * FRAME_NS
