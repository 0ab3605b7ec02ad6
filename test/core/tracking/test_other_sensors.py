# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a gyro and wheels change in the tracker, and what they leave alone."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.priors.fusion import ImagePose, Sensed
from dcgs_ros.core.priors.gravity import UpPrior
from dcgs_ros.core.priors.gyro import Gyro
from dcgs_ros.core.priors.motion_priors import MotionPriors, PriorsError
from dcgs_ros.core.priors.readings import AngularRate, BasePose, MotionFactor
from dcgs_ros.core.tracking.estimator import Memory
from dcgs_ros.core.tracking.motion import ConstantVelocity
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.selector import KeyframeSelector
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.readings import Readings, priors_of
from dcgs_ros.datasets.synthetic.source import SyntheticSource

SOURCE = SyntheticSource.from_address('synthetic:room?frames=60&speed=2.5&motion=turning&seed=0')
AT_REST = SyntheticSource.from_address('synthetic:room?frames=20&motion=turning')
T_BASE_CAM = np.asarray(SOURCE.T_base_cam)
SEEN, SHOWN = 8, 16  # frames before the lens is covered, and in all
FRAME_NS = 33_333_333


@cache
def frames() -> tuple[RgbdFrame, ...]:
    """Return frames of which the last ones show nothing."""
    made = [SOURCE.render(k) for k in range(SHOWN)]
    for k in range(SEEN, SHOWN):
        depth_m = np.zeros_like(made[k].depth_m)
        depth_m[::16, ::16] = 0.4
        black = np.full_like(made[k].color, k)
        made[k] = replace(made[k], color=black, depth_m=depth_m)
    return tuple(made)


@cache
def tracked(*sensors: str) -> tuple[TrackResult, ...]:
    (tracker, readings), results = with_sensors(*sensors), []
    for frame in frames():
        for reading in readings.until(frame.stamp_ns):
            tracker.sense(reading)
        results.append(tracker.track(frame))
    return tuple(results)


def with_sensors(*sensors: str) -> tuple[Tracker, Readings]:
    config = override(Config(sensor=SOURCE.sensor), {f'priors.{name}': True for name in sensors})
    tracker = Tracker(SOURCE.camera, config, priors=priors_of(SOURCE, config.priors))
    return tracker, Readings(SOURCE, config.priors)


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


def test_wheels_alone_carry_it_without_a_tilt() -> None:
    """Constant velocity would go on with whatever tilt the noise of the last frame had."""
    results = tracked('wheels')
    assert {result.state for result in results[SEEN:]} == {TrackingState.DEGENERATE}
    base = [T_BASE_CAM @ se3.inverse(r.T_world_cam) for r in (results[SEEN - 1], results[-1])]
    turn = se3.log(base[0] @ se3.inverse(base[1]))
    assert np.degrees(np.abs(turn[3:5])).max() < 0.1 < np.degrees(abs(turn[5]))
    metres, _ = error(results[-1])
    assert metres < 0.02


def test_what_is_carried_is_no_view_for_the_mapper() -> None:
    selector = KeyframeSelector(1)
    selected = [
        selector.select(frame, result)
        for frame, result in zip(frames(), tracked('gyro', 'wheels'), strict=True)
    ]
    assert all(selected[2:SEEN])
    assert not any(selected[SEEN:])


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


@pytest.mark.parametrize('sensors', [(), ('gyro', 'wheels')])
def test_a_second_without_frames_is_no_gap_to_other_sensors(sensors: tuple[str, ...]) -> None:
    tracker, readings = with_sensors(*sensors)
    turned_back = SOURCE.render(55)
    for frame in [*frames()[:SEEN], turned_back]:
        for reading in readings.until(frame.stamp_ns):
            tracker.sense(reading)
        result = tracker.track(frame)
    metres, radians = error(result)
    if sensors:
        assert metres < 0.05 and radians < 0.05
    else:
        assert radians > 0.5


def slipping_aside(limit_m: float) -> tuple[Tracker, TrackResult]:
    """Track a robot that turns on the spot, whose wheels say that it goes 3 cm aside a frame."""
    config = override(
        Config(sensor=SOURCE.sensor),
        {'priors.wheels': True, 'registration.degenerate_m': limit_m},
    )
    tracker = Tracker(SOURCE.camera, config, priors=priors_of(SOURCE, config.priors))
    aside = np.eye(4)
    for k, frame in enumerate(frames()[:SEEN]):
        aside[1, 3] = 0.03 * k
        tracker.sense(BasePose(frame.stamp_ns, aside.copy()))
        result = tracker.track(frame)
    return tracker, result


def test_wheels_that_slip_do_not_speak_against_the_images() -> None:
    tracker, result = slipping_aside(0.03)
    assert result.state is TrackingState.OK
    assert tracker.usual.frames == SEEN - 1  # no frame was in doubt
    assert error(result)[0] < 0.01


def test_wheels_carry_the_camera_where_images_hold_it_worse_than_the_limits() -> None:
    _, result = slipping_aside(2e-3)
    assert error(result)[0] > 0.05


def test_the_tracker_teaches_the_gyro_its_bias() -> None:
    tracker, readings = with_sensors('gyro')
    bias = np.array([0.0, 0.05, 0.0])
    for k in range(0, 11, 2):  # at rest
        frame = AT_REST.render(k)
        for reading in readings.until(frame.stamp_ns):
            assert isinstance(reading, AngularRate)
            tracker.sense(replace(reading, rate=bias + 1e-6 * reading.rate))
        tracker.track(frame)
    assert tracker.priors.gyro is not None
    assert tracker.priors.gyro.bias[1] == 0.0  # a window is half a second
    frame = AT_REST.render(18)
    for k in range(20):
        stamp_ns = frame.stamp_ns - (19 - k) * 10_000_000
        tracker.sense(AngularRate(stamp_ns, bias + 1e-6 * k))
    tracker.track(frame)
    np.testing.assert_allclose(tracker.priors.gyro.bias, bias, atol=0.01)


def test_what_sensors_span_is_no_gap() -> None:
    motion, second_ns = ConstantVelocity.at_rest(np.eye(4), 0), 1_000_000_000
    told = Sensed((MotionFactor(np.eye(4), 1e-6 * np.eye(6), np.zeros((6, 6))),))
    assert Memory(motion, 0.0).is_gap(second_ns)
    assert Memory(motion, 0.0, sensed=Sensed()).is_gap(second_ns)
    assert not Memory(motion, 0.0, sensed=told).is_gap(second_ns)


@pytest.mark.parametrize(('metres', 'believed'), [(0.01, True), (0.5, False)])
def test_wheels_that_jump_are_not_believed(metres: float, believed: bool) -> None:
    priors = priors_of(SOURCE, override(Config().priors, {'wheels': True}))
    T, motion = np.eye(4), ConstantVelocity.at_rest(np.eye(4), 0)
    priors.sense(BasePose(0, T.copy()))
    T[0, 3] = metres
    priors.sense(BasePose(FRAME_NS, T))
    assert (priors.since(motion, FRAME_NS) is not None) == believed


@pytest.mark.parametrize(('sigma_m', 'learned'), [(0.002, 0.05), (0.02, 0.0)])
def test_images_teach_a_scale_only_where_they_hold_the_way(sigma_m: float, learned: float) -> None:
    priors = priors_of(SOURCE, override(Config().priors, {'wheels': True}))
    ahead, covariance = np.eye(4), np.diag([sigma_m**2] * 3 + [1e-6] * 3)
    for k in range(181):  # 0.5 m/s, of which the wheels tell 5 % too much
        ahead[0, 3] = 1.05 * 0.5 * k / 30
        priors.sense(BasePose(k * FRAME_NS, ahead.copy()))
        seen = np.eye(4)
        seen[0, 3] = 0.5 * k / 30
        T = se3.inverse(T_BASE_CAM) @ seen @ T_BASE_CAM
        priors.learn(k * FRAME_NS, ImagePose(T, covariance, (0.015, 0.022)), T)
    assert priors.wheels is not None
    assert priors.wheels.scales[0] == pytest.approx(learned, abs=0.005)


def test_the_gyro_tells_how_fast_the_camera_turns_on_arrival() -> None:
    rate = np.array([0.1, 2.0, -0.3])
    gyro = Gyro(np.eye(3))
    for k in range(50):
        gyro.sense(AngularRate(5_000_000 * k, rate))
    turn = gyro.turn(50_000_000, 83_000_000)
    memory = Memory(ConstantVelocity.at_rest(np.eye(4), 50_000_000), 0.0, sensed=Sensed(turn=turn))
    motion = memory.arriving(se3.exp(np.array([0.01, 0, 0, 0, 0, 0])), 83_000_000)
    np.testing.assert_allclose(motion.twist[3:], rate, atol=1e-9)
    np.testing.assert_allclose(motion.twist[:3], [0.01 / 0.033, 0, 0], rtol=1e-6)


def test_the_floor_is_where_the_map_begins() -> None:
    config = override(Config().priors, {'planar_m': 0.005})
    T_base_cam = SOURCE.T_base_cam
    assert T_base_cam is not None
    priors, start = MotionPriors(config, T_base_cam=T_base_cam), se3.exp(np.full(6, 0.3))
    assert priors.since(ConstantVelocity.at_rest(start), 0) is None
    priors.begin(start)
    risen = start @ se3.inverse(T_base_cam)
    risen[:3, 3] += 0.01 * risen[:3, 2]
    motion = ConstantVelocity.at_rest(risen @ T_base_cam, 0)
    sensed = priors.since(motion, FRAME_NS)
    assert sensed is not None and not sensed.spans
    fused = sensed.fused(motion.prior(FRAME_NS), motion.T_world_cam, motion.twist)
    base = se3.inverse(start @ se3.inverse(T_base_cam)) @ fused.T_world_cam
    height_m = (base @ se3.inverse(T_base_cam))[2, 3]
    assert 0.0 < height_m < 0.009  # a hand is believed as far as it goes
    assert priors.reasons(0) == {'planar': 'used'}


def test_every_sensor_says_whether_it_is_used() -> None:
    priors = MotionPriors(override(Config().priors, {'gyro': True}), np.eye(3))
    for k in range(300):
        priors.sense(AngularRate(5_000_000 * k, np.array([0.0, 1.0, 1e-6 * k])))
    assert priors.reasons(1_495_000_000) == {'gyro': 'used'}
    assert priors.reasons(2_495_000_000) == {'gyro': 'no reading for 1.00 s'}


def test_a_sensor_without_a_place_is_named_and_refused_in_a_sequence() -> None:
    for changes in ({'gyro': True}, {'wheels': True}, {'planar_m': 0.01}):
        config = override(Config().priors, changes)
        (name,) = MotionPriors(config).reasons(0)
        assert changes.keys() == {'planar_m' if name == 'planar' else name}
        unplaced = without_places(SOURCE)
        with pytest.raises(PriorsError, match=f'priors.{name}: it is not known'):
            priors_of(unplaced, config)


def without_places(source: SyntheticSource) -> SyntheticSource:
    """Return the source without the places of its sensors."""
    unplaced = copy(source)
    unplaced.T_cam_imu = unplaced.T_base_cam = None  # type: ignore[assignment]
    return unplaced


def test_a_place_may_come_while_the_camera_is_tracked() -> None:
    """The gyro is used from then on; the floor is that under the first pose."""
    config = override(Config().priors, {'gyro': True, 'planar_m': 0.005})
    priors, start = MotionPriors(config), se3.exp(np.full(6, 0.3))
    priors.begin(start)
    motion = ConstantVelocity(start, 0, np.zeros(6), 0.033)
    priors.sense(AngularRate(0, np.ones(3)))
    assert priors.since(motion, FRAME_NS) is None
    priors.mount(R_cam_imu=np.eye(3))
    priors.mount(T_base_cam=se3.exp(np.array([0.1, 0, 0.5, -1.2, 0, 0])))
    assert not priors.unmounted
    for k in range(10):
        priors.sense(AngularRate(5_000_000 * k, np.array([0.0, 1.0, 1e-6 * k])))
    sensed = priors.since(motion, FRAME_NS)
    assert sensed is not None and sensed.turn is not None and sensed.floor is not None
    np.testing.assert_allclose(sensed.floor.normal_equations(start).g, 0.0, atol=1e-9)


def test_gravity_is_a_term_of_the_prior() -> None:
    """The pose is drawn to where up is, as far as a hand is believed."""
    up = np.array([0.0, -1.0, 0.0])
    turned = se3.exp(np.array([0, 0, 0, 0.01, 0, 0]))[:3, :3]
    hand = ConstantVelocity(np.eye(4), 0, np.zeros(6), 0.033).prior(FRAME_NS)
    fused = Sensed(up=UpPrior(up, turned.T @ up, 1e-4)).fused(hand, np.eye(4), np.zeros(6))
    np.testing.assert_allclose(se3.log(fused.T_world_cam)[3:], [0.01, 0, 0], atol=2e-4)
    fused = Sensed(up=UpPrior(up, turned.T @ up, 10.0)).fused(hand, np.eye(4), np.zeros(6))
    np.testing.assert_allclose(se3.log(fused.T_world_cam), 0.0, atol=1e-4)


@pytest.mark.slow
def test_a_hand_held_camera_is_tracked_with_gravity() -> None:
    source = SyntheticSource.from_address('synthetic:room?frames=120&sensor=d435i&seed=0')
    config = override(Config(sensor=source.sensor), {'priors.gravity': True})
    tracker = Tracker(source.camera, config, priors=priors_of(source, config.priors))
    readings = Readings(source, config.priors)
    for frame in source:
        for reading in readings.until(frame.stamp_ns):
            tracker.sense(reading)
        result = tracker.track(frame)
    start = source.pose(1_000_000_000_000)
    up = start[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    seen, true = result.T_world_cam, se3.inverse(start) @ source.pose(result.stamp_ns)
    angle = np.arccos(min((seen[:3, :3].T @ up) @ (true[:3, :3].T @ up), 1.0))
    assert np.degrees(angle) < 0.3
    assert tracker.priors.reasons(result.stamp_ns) == {'gyro': 'used', 'gravity': 'used'}
    sensed = tracker._memory.sensed
    assert sensed is not None and sensed.up is not None
