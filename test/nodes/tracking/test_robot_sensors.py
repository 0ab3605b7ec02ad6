# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""IMU and wheels beside a tracked camera, without DDS: used, or why not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.nodes import TrackerSettings, core_config
from dcgs_ros.core.config.schema import ConfigError, override
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels import jit
from dcgs_ros.core.tracking.result import TrackingState
from dcgs_ros.datasets.source import ImuSample
from dcgs_ros.datasets.synthetic.source import IMU_FRAME, SyntheticSource
from dcgs_ros.nodes.messages.robot import write_imu, write_odometry
from dcgs_ros.nodes.tracking.robot_sensors import RobotSensors
from dcgs_ros.nodes.tracking.session import TrackingSession

CAMERA_FRAME = 'camera_color_optical_frame'
IMU, GYRO, ODOM = '/camera/camera/imu', '/camera/camera/gyro/sample', '/odom'
ACCEL = '/camera/camera/accel/sample'
START_NS = 1_000_000_000_000  # of the first frame
FRAMES = 40  # two windows of half a second
SOURCE = SyntheticSource.from_address(f'synthetic:room?frames={FRAMES}&sensor=ideal&speed=2')
T_BASE_CAM = se3.exp(np.array([0.1, 0.0, 0.2, 0.3, -1.2, 0.4]))
Change = Callable[[ImuSample], ImuSample | None]


class Node:
    """Keeps the callbacks of subscriptions."""

    def __init__(self) -> None:
        self.heard: dict[str, Callable[[Any], None]] = {}

    def resolve_topic_name(self, name: str) -> str:
        return f'/{name}'

    def create_subscription(self, _: type, topic: str, callback: Any, qos: Any) -> Any:
        topic = topic if topic.startswith('/') else f'/{topic}'
        self.heard[topic] = callback
        return SimpleNamespace(topic_name=topic)

    def count_publishers(self, topic: str) -> int:
        return int(topic == ODOM)


class Tf:
    listens = True

    def __init__(self) -> None:
        self.known: dict[tuple[str, str], Callable[[int | None], NDArray[np.float64] | None]] = {}

    def put(self, parent: str, child: str, T: NDArray[np.float64]) -> None:
        self.known[parent, child] = lambda _: T

    def send(self, transform: Any) -> None:
        pass

    send_static = send

    def lookup(
        self, parent: str, child: str, stamp_ns: int | None = None
    ) -> NDArray[np.float64] | None:
        return self.known.get((parent, child), lambda _: None)(stamp_ns)


class Robot:
    """A session with its sensors."""

    def __init__(self, **changes: object) -> None:
        given = {key.replace('__', '.'): value for key, value in changes.items()}
        settings = override(TrackerSettings(sensor=SOURCE.sensor), given)
        self.node, self.tf, self.warnings = Node(), Tf(), list[str]()
        self.tf.put(CAMERA_FRAME, IMU_FRAME, SOURCE.T_cam_imu)
        self.sensors = RobotSensors(
            self.node, settings, self.tf, self.warnings.append  # type: ignore[arg-type]
        )  # fmt: skip
        self.session = TrackingSession(
            core_config(settings), T_BASE_CAM, self.warnings.append, priors=self.sensors.priors
        )
        self.states: list[TrackingState] = []

    def track(self, frame: RgbdFrame) -> None:
        self.sensors._due_s = 0.0  # asks TF at every frame
        self.sensors.sense(frame.stamp_ns, CAMERA_FRAME)
        result = self.session.track(frame, camera())
        assert result is not None
        self.states.append(result.state)

    def drive(self, change: Change = lambda sample: sample, topic: str = IMU) -> None:
        """Track all frames, each after the readings up to its stamp, as `change` has them."""
        samples, held = SOURCE.imu(), list[ImuSample]()
        for frame in frames():
            while not held or held[-1].stamp_ns <= frame.stamp_ns:
                held.append(next(samples))
            for sample in held[:-1]:
                changed = change(sample)
                if changed is not None:
                    self.node.heard[topic](write_imu(changed))
            held = held[-1:]
            self.track(frame)


def camera() -> PinholeCamera:
    full = SOURCE.camera
    fx, fy, cx, cy = (value / 2 for value in (full.fx, full.fy, full.cx, full.cy))
    return PinholeCamera(full.width // 2, full.height // 2, fx, fy, cx, cy)


def halved(frame: RgbdFrame) -> RgbdFrame:
    return replace(
        frame, color=frame.color[::2, ::2].copy(), depth_m=frame.depth_m[::2, ::2].copy()
    )


@cache
def frames() -> tuple[RgbdFrame, ...]:
    return tuple(map(halved, SOURCE))


@pytest.fixture(autouse=True)
def restored_threads() -> Iterator[None]:
    yield
    jit.set_threads(None)


@pytest.mark.slow
def test_gravity_is_used_with_the_gyro() -> None:
    robot = Robot(priors__gravity=True)
    assert robot.node.heard.keys() == {IMU, GYRO, ACCEL}
    robot.drive()
    assert robot.sensors.reasons() == {'gyro': 'used', 'gravity': 'used'}


def stopped(seconds: float) -> Change:
    start_ns = frames()[0].stamp_ns
    return lambda sample: sample if sample.stamp_ns < start_ns + seconds * 1e9 else None


def frozen(sample: ImuSample) -> ImuSample:
    return replace(sample, angular_velocity=(0.1, 0.2, 0.3))


def late(sample: ImuSample) -> ImuSample:
    return replace(sample, stamp_ns=sample.stamp_ns - 300_000_000)


def in_degrees(sample: ImuSample) -> ImuSample:
    assert sample.angular_velocity is not None
    x, y, z = np.degrees(sample.angular_velocity).tolist()
    return replace(sample, angular_velocity=(x, y, z))


def test_the_tracker_has_the_priors_of_the_node_in_every_map() -> None:
    robot = Robot(priors__gyro=True)
    for _ in range(2):
        for k in range(2):
            robot.track(halved(SOURCE.render(k)))
        assert robot.session.tracker is not None
        assert robot.session.tracker.priors is robot.sensors.priors
        robot.session.reset()
    assert robot.sensors.reasons()['gyro'].startswith('no reading yet')


@pytest.mark.slow
@pytest.mark.parametrize('topic', [IMU, GYRO])
def test_a_gyro_is_used(topic: str) -> None:
    robot = Robot(priors__gyro=True)
    robot.drive(topic=topic)
    assert robot.sensors.reasons() == {'gyro': 'used'}
    gyro, tracker = robot.sensors.priors.gyro, robot.session.tracker
    assert gyro is not None and tracker is not None and tracker.priors.gyro is gyro
    assert not robot.warnings


@pytest.mark.slow
@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (stopped(0.6), 'no reading for 0.'),
        (frozen, 'frozen: '),
        (late, 'no reading for 0.3'),
        (in_degrees, 'contradicts the images: '),
    ],
    ids=['dead', 'frozen', 'late', 'degrees'],
)
def test_a_gyro_that_errs_is_left_out_and_named(change: Change, said: str) -> None:
    robot = Robot(priors__gyro=True)
    robot.drive(change)
    assert robot.sensors.reasons()['gyro'].startswith(said)
    assert set(robot.states) == {TrackingState.OK}


@pytest.mark.slow
def test_a_gyro_that_is_mounted_wrongly_is_left_out_and_named() -> None:
    robot = Robot(priors__gyro=True)
    turned = se3.exp(np.array([0, 0, 0, np.pi / 2, 0, 0]))
    robot.tf.put(CAMERA_FRAME, IMU_FRAME, SOURCE.T_cam_imu @ turned)
    robot.drive()
    assert robot.sensors.reasons()['gyro'].startswith('contradicts the images: ')
    assert set(robot.states) == {TrackingState.OK}


def sensing(robot: Robot) -> dict[str, str]:
    """Hand on the readings of the first frames without tracking; return what is said."""
    samples, wheels = list(SOURCE.imu())[:100], list(SOURCE.odometry())[:25]
    for sample in samples if IMU in robot.node.heard else ():
        robot.node.heard[IMU](write_imu(sample))
    for odometry in wheels if ODOM in robot.node.heard else ():
        robot.node.heard[ODOM](write_odometry(odometry))
    robot.sensors._due_s = 0.0
    robot.sensors.sense(samples[90].stamp_ns, CAMERA_FRAME)
    return robot.sensors.reasons()


def test_where_the_imu_is_may_come_by_tf_late_or_never() -> None:
    robot = Robot(priors__gyro=True)
    robot.tf.known.clear()
    said = sensing(robot)['gyro']
    assert f'no TF from {IMU_FRAME} to {CAMERA_FRAME}' in said and 'node.camera_to_imu' in said
    robot.tf.put(CAMERA_FRAME, IMU_FRAME, SOURCE.T_cam_imu)
    assert sensing(robot) == {'gyro': 'used'}


def test_where_the_imu_is_may_be_set() -> None:
    robot = Robot(priors__gyro=True, node__camera_to_imu='-0.02 0.005 0.01 0 0 0 1')
    robot.tf.known.clear()
    assert sensing(robot) == {'gyro': 'used'}
    with pytest.raises(ConfigError, match='camera_to_imu'):
        Robot(priors__gyro=True, node__camera_to_imu='0 0 0')


def test_a_silent_topic_is_named() -> None:
    robot = Robot(priors__gyro=True, priors__wheels=True)
    robot.sensors.sense(START_NS, CAMERA_FRAME)
    said = robot.sensors.reasons()
    assert said['gyro'].endswith(f'nobody publishes {IMU} or {GYRO}')
    assert said['wheels'] == 'no reading yet, or none that names its frame'


@pytest.mark.parametrize('base', ['base_link', 'camera_link'])
def test_wheels_are_those_of_the_base_that_the_odometry_names(base: str) -> None:
    """Whatever frame the tracker's own poses are of."""
    robot = Robot(priors__wheels=True, node__base_frame=base)
    assert 'no TF from base_link' in sensing(robot)['wheels']
    robot.tf.put('base_link', CAMERA_FRAME, T_BASE_CAM)
    assert sensing(robot) == {'wheels': 'used'}
    assert robot.sensors.priors.on_wheels


def test_a_camera_that_is_placed_by_setting_is_so_on_wheels_too() -> None:
    pose = '0.1 0 0.2 0 0 0 1'
    robot = Robot(
        priors__wheels=True, node__base_frame='base_link', node__base_to_camera=pose
    )  # fmt: skip
    assert sensing(robot) == {'wheels': 'used'}
    other = Robot(priors__wheels=True, node__base_to_camera=pose)
    assert 'base_to_camera' in sensing(other)['wheels']
    other.tf.put('base_link', 'camera_link', T_BASE_CAM)
    assert sensing(other) == {'wheels': 'used'}


def test_the_floor_needs_no_odometry() -> None:
    robot = Robot(priors__planar_m=0.003, node__base_frame='base_link')
    robot.tf.put('base_link', CAMERA_FRAME, T_BASE_CAM)
    robot.sensors.sense(START_NS, CAMERA_FRAME)
    assert not robot.sensors.priors.unmounted and not robot.node.heard


def test_odometry_may_come_by_tf_at_the_stamps_of_frames() -> None:
    settings = {'node__odometry_topic': '', 'node__base_frame': 'base_link'}
    robot = Robot(priors__wheels=True, node__tf='map_to_odom', **settings)
    robot.tf.put('base_link', CAMERA_FRAME, T_BASE_CAM)
    asked: list[int | None] = []

    def odom(stamp_ns: int | None) -> NDArray[np.float64] | None:
        asked.append(stamp_ns)
        return se3.exp(np.array([1e-9 * (stamp_ns or 0) - 1000.0, 0, 0, 0, 0, 0]))

    robot.tf.known['odom', 'base_link'] = odom
    stamps = [START_NS, START_NS + 33_333_333, START_NS + 66_666_667]
    for stamp_ns in stamps:
        robot.sensors.sense(stamp_ns, CAMERA_FRAME)
    assert asked == stamps
    wheels = robot.sensors.priors.wheels
    assert robot.sensors.reasons() == {'wheels': 'used'} and wheels is not None
    factor = wheels.factor(stamps[0], stamps[1])
    assert factor is not None
    moved = T_BASE_CAM @ factor.T_before_now @ se3.inverse(T_BASE_CAM)
    np.testing.assert_allclose(moved[:3, 3], [1 / 30, 0, 0], atol=1e-6)
    robot.tf.known['odom', 'base_link'] = lambda _: None  # it ends
    robot.sensors.sense(stamps[2] + 500_000_000, CAMERA_FRAME)
    assert robot.sensors.reasons()['wheels'] == 'no pose for 0.50 s'
    with pytest.raises(ConfigError, match='broadcasts itself'):
        Robot(priors__wheels=True, node__tf='odom_to_base', **settings)


def test_what_is_no_measurement_is_refused_and_named() -> None:
    robot = Robot(priors__gyro=True, priors__wheels=True)
    imu, odometry = write_imu(next(SOURCE.imu())), write_odometry(next(SOURCE.odometry()))
    imu.angular_velocity.x, odometry.pose.pose.position.x = np.nan, np.nan
    robot.node.heard[IMU](imu)
    robot.node.heard[ODOM](odometry)
    assert [text.split(':')[0] for text in robot.warnings] == ['imu refused', 'odometry refused']


def test_nothing_is_subscribed_to_unless_it_is_asked_for() -> None:
    assert not Robot().node.heard
    assert Robot().sensors.reasons() == {}


def test_a_quantity_that_comes_alone_is_not_taken_for_two() -> None:
    """Drivers fill the other one with zeros."""
    robot = Robot(priors__gravity=True)
    assert robot.node.heard.keys() == {IMU, GYRO, ACCEL}
    both = write_imu(next(SOURCE.imu()))
    for topic, kinds in ((GYRO, ['AngularRate']), (ACCEL, ['SpecificForce'])):
        robot.node.heard[topic](both)
        taken = robot.sensors._queue.take(0)
        assert [type(reading).__name__ for reading in taken] == kinds
    robot.node.heard[IMU](both)
    assert len(robot.sensors._queue.take(0)) == 2
