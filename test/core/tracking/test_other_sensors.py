# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a gyro and wheels change in the tracker, and what they leave alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.priors.motion_priors import MotionPriors, PriorsError
from dcgs_ros.core.priors.readings import AngularRate
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.readings import Readings, priors_of
from dcgs_ros.datasets.synthetic.source import SyntheticSource

SOURCE = SyntheticSource.from_address('synthetic:room?frames=16&speed=2.5&motion=turning&seed=0')
SEEN = 8  # frames before the lens is covered
FRAME_NS = 33_333_333


@cache
def frames() -> tuple[RgbdFrame, ...]:
    """Return frames of which the last ones show nothing."""
    made = list(SOURCE)
    for k in range(SEEN, len(made)):
        depth_m = np.zeros_like(made[k].depth_m)
        depth_m[::16, ::16] = 0.4
        black = np.full_like(made[k].color, k)
        made[k] = replace(made[k], color=black, depth_m=depth_m)
    return tuple(made)


@cache
def tracked(*sensors: str) -> tuple[TrackResult, ...]:
    values = {f'priors.{name}': True for name in sensors}
    config = override(Config(sensor=SOURCE.sensor), values)
    tracker = Tracker(SOURCE.camera, config, priors=priors_of(SOURCE, config.priors))
    readings, results = Readings(SOURCE, config.priors), []
    for frame in frames():
        for reading in readings.until(frame.stamp_ns):
            tracker.sense(reading)
        results.append(tracker.track(frame))
    return tuple(results)


def error(result: TrackResult) -> tuple[float, float]:
    """Return by how many metres and radians a pose is off."""
    first, now = (SOURCE.pose(s) for s in (frames()[0].stamp_ns, result.stamp_ns))
    off = se3.log(se3.inverse(se3.inverse(first) @ now) @ result.T_world_cam)
    return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))


def sigma(result: TrackResult) -> float:
    return float(np.sqrt(np.trace(result.covariance)))


def test_a_covered_lens_loses_a_camera_that_is_alone() -> None:
    assert tracked()[-1].state is TrackingState.LOST


def test_a_gyro_and_wheels_carry_it_and_say_so() -> None:
    results = tracked('gyro', 'wheels')
    assert {result.state for result in results[SEEN:]} == {TrackingState.DEGENERATE}
    assert {result.inliers for result in results[SEEN:]} == {0}
    metres, radians = error(results[-1])
    assert metres < 0.02 and radians < 0.02
    turned = se3.log(se3.inverse(results[SEEN - 1].T_world_cam) @ results[-1].T_world_cam)
    assert np.linalg.norm(turned[3:]) > 0.1  # it did turn meanwhile


def test_what_is_carried_gets_less_certain() -> None:
    sigmas = [sigma(result) for result in tracked('gyro', 'wheels')[SEEN:]]
    assert all(a < b for a, b in pairwise(sigmas))
    metres, radians = error(tracked('gyro', 'wheels')[-1])
    assert metres + radians < 3 * sigmas[-1]


def test_nothing_enters_the_map_meanwhile() -> None:
    assert not any(result.keyframe for result in tracked('gyro', 'wheels')[SEEN:])


def test_sensors_that_say_nothing_change_nothing() -> None:
    config = override(Config(sensor=SOURCE.sensor), {'priors.gyro': True})
    silent = Tracker(SOURCE.camera, config, priors=MotionPriors(config.priors, np.eye(3)))
    for frame, expected in zip(frames()[:SEEN], tracked(), strict=False):
        found = silent.track(frame)
        np.testing.assert_array_equal(found.T_world_cam, expected.T_world_cam)
        np.testing.assert_array_equal(found.covariance, expected.covariance)


def test_every_sensor_says_whether_it_is_used() -> None:
    priors = MotionPriors(override(Config().priors, {'gyro': True}), np.eye(3))
    for k in range(300):
        priors.sense(AngularRate(5_000_000 * k, np.array([0.0, 1.0, 1e-6 * k])))
    assert priors.reasons(1_495_000_000) == {'gyro': 'used'}
    assert priors.reasons(2_495_000_000) == {'gyro': 'no reading for 1.00 s'}


def test_a_sensor_without_a_place_is_refused() -> None:
    for changes in ({'gyro': True}, {'wheels': True}, {'planar_m': 0.01}):
        with pytest.raises(PriorsError):
            MotionPriors(override(Config().priors, changes))
