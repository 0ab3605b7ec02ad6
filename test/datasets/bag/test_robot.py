# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A recording's IMU and wheels: which are the camera's, where they are, and what they say."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    COLOR,
    OPTICAL,
    START_NS,
    TYPES,
    Entry,
    entry_of,
    header,
    recording,
    write_bag,
)
from realsense_bags import imu_entry, static_entry  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.priors.motion_priors import PriorsError
from dcgs_ros.core.priors.readings import AngularRate, BasePose, Reading
from dcgs_ros.datasets.bag.robot import RecordedRobot, find_robot
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.bag.writing.storage import BagOptions
from dcgs_ros.datasets.bag.writing.writer import write_bag as convert
from dcgs_ros.datasets.readings import Readings, priors_of
from dcgs_ros.datasets.source import RobotSource
from dcgs_ros.datasets.synthetic.source import SyntheticSource

IMU_FRAME = 'camera_imu_optical_frame'  # of imu_entry
T_LINK_OPTICAL = se3.exp(np.array([0.0, 0.015, 0.0, 1.2, -1.2, 1.2]))
T_LINK_IMU = se3.exp(np.array([-0.01, 0.02, 0.0, 0.3, 0.1, -0.2]))
T_BASE_LINK = se3.exp(np.array([0.2, 0.0, 0.3, 0.0, 0.2, 0.0]))
TREE = [
    ('base_link', 'camera_link', T_BASE_LINK),
    ('camera_link', OPTICAL, T_LINK_OPTICAL),
    ('camera_link', IMU_FRAME, T_LINK_IMU),
]
T_CAM_IMU = se3.inverse(T_LINK_OPTICAL) @ T_LINK_IMU
SENSORS = override(Config().priors, {'gyro': True, 'wheels': True})
EXACT = 1e-9


def odometry_entry(
    k: int = 0, topic: str = '/odom', child: str = 'base_link', x: float = 1.0
) -> Entry:
    kinds = TYPES.types
    vector, point = kinds['geometry_msgs/msg/Vector3'], kinds['geometry_msgs/msg/Point']
    half = 0.25 * np.pi
    turned = kinds['geometry_msgs/msg/Quaternion'](0.0, 0.0, np.sin(half), np.cos(half))
    pose = kinds['geometry_msgs/msg/Pose'](point(x, 2.0, 0.0), turned)
    twist = kinds['geometry_msgs/msg/Twist'](vector(0.5, 0.0, 0.0), vector(0.0, 0.0, -0.3))
    stamp_ns = START_NS + k * 20_000_000
    message = kinds['nav_msgs/msg/Odometry'](
        header(stamp_ns, 'odom'), child,
        kinds['geometry_msgs/msg/PoseWithCovariance'](pose, np.zeros(36)),
        kinds['geometry_msgs/msg/TwistWithCovariance'](twist, np.zeros(36)),
    )  # fmt: skip
    return entry_of(topic, 'nav_msgs/msg/Odometry', stamp_ns, message)


def imu(topic: str) -> Entry:
    return imu_entry(topic, START_NS, (0.0, -9.8, 0.0), (0.1, 0.2, 0.3))


def found(tmp_path: Path, *entries: Entry) -> RecordedRobot:
    path = write_bag(tmp_path / 'bag', [*recording(1), *entries])
    return find_robot(path, COLOR)


def test_sensors_are_placed_by_the_static_transforms(tmp_path: Path) -> None:
    imus = [imu('/camera/camera/gyro/sample'), imu('/camera/camera/accel/sample')]
    robot = found(tmp_path, static_entry(TREE), *imus, odometry_entry())
    assert robot.imu_topics == ('/camera/camera/gyro/sample', '/camera/camera/accel/sample')
    assert robot.imu_frames == (IMU_FRAME,)
    assert (robot.odometry_topic, robot.base_frame) == ('/odom', 'base_link')
    assert robot.T_cam_imu is not None and robot.T_base_cam is not None
    np.testing.assert_allclose(robot.T_cam_imu, T_CAM_IMU, atol=EXACT)
    np.testing.assert_allclose(robot.T_base_cam, T_BASE_LINK @ T_LINK_OPTICAL, atol=EXACT)


def test_without_transforms_it_is_known_what_there_is_but_not_where(tmp_path: Path) -> None:
    robot = found(tmp_path, imu('/imu'), odometry_entry())
    assert (robot.imu_topics, robot.odometry_topic) == (('/imu',), '/odom')
    assert robot.T_cam_imu is None and robot.T_base_cam is None
    with pytest.raises(PriorsError, match='a bag tells it in /tf_static'):
        priors_of(BagSource(tmp_path / 'bag'), SENSORS)


def test_the_cameras_imu_is_preferred_to_another(tmp_path: Path) -> None:
    robot = found(tmp_path, static_entry(TREE), imu('/imu/data'), imu('/camera/camera/imu'))
    assert robot.imu_topics[0] == '/camera/camera/imu'


def elsewhere(entry: Entry, frame: str) -> Entry:
    message = TYPES.deserialize_cdr(entry.cdr, entry.type)
    message.header.frame_id = frame
    return entry_of(entry.topic, entry.type, START_NS, message)


def test_an_imu_that_is_placed_is_preferred_and_stands_alone(tmp_path: Path) -> None:
    """The samples of the other one would not fit its place."""
    tree = [*TREE, ('base_link', 'base_imu', np.eye(4))]
    nowhere = elsewhere(imu('/camera/camera/imu'), 'unknown')
    robot = found(tmp_path, static_entry(tree), nowhere, elsewhere(imu('/imu'), 'base_imu'))
    assert (robot.imu_topics, robot.imu_frames) == (('/imu',), ('base_imu',))
    config = override(Config().priors, {'gravity': True})
    readings = Readings(BagSource(tmp_path / 'bag'), config)
    kinds = [type(reading).__name__ for reading in readings.until(2**62)]
    assert sorted(kinds) == ['AngularRate', 'SpecificForce']


@pytest.mark.parametrize(
    ('topics', 'chosen'),
    [
        (['/dcgs_tracker/odometry'], None),
        (['/dcgs_tracker/odometry', '/odom'], '/odom'),
        (['/odometry/filtered', '/odom'], '/odom'),
        (['/odom', '/wheel/odometry'], '/wheel/odometry'),
    ],
)
def test_the_wheels_are_found_among_odometries(
    tmp_path: Path, topics: list[str], chosen: str | None
) -> None:
    entries = [odometry_entry(topic=topic) for topic in topics]
    assert found(tmp_path, static_entry(TREE), *entries).odometry_topic == chosen


def test_a_base_without_odometry_has_its_usual_name(tmp_path: Path) -> None:
    assert found(tmp_path, static_entry(TREE)).base_frame == 'base_link'


@pytest.mark.parametrize('bad', [np.nan, 1e30])
def test_transforms_that_are_none_place_nothing(tmp_path: Path, bad: float) -> None:
    entry = static_entry(TREE)
    message = TYPES.deserialize_cdr(entry.cdr, entry.type)
    message.transforms[0].transform.translation.x = bad
    broken = entry_of('/tf_static', entry.type, START_NS, message)
    robot = found(tmp_path, broken, imu('/imu'), odometry_entry())
    assert robot.T_cam_imu is None and robot.T_base_cam is None and robot.transforms is None


def test_a_circle_of_frames_places_nothing(tmp_path: Path) -> None:
    tree = [(OPTICAL, 'a', np.eye(4)), ('a', OPTICAL, np.eye(4))]
    assert found(tmp_path, static_entry(tree), imu('/imu')).T_cam_imu is None


def test_wheels_say_where_the_base_is_on_the_ground(tmp_path: Path) -> None:
    """A message that is none is left out."""
    entries = [odometry_entry(0), odometry_entry(1, x=np.nan), odometry_entry(2, x=3.0)]
    write_bag(tmp_path / 'bag', [*recording(1), *entries])
    samples = list(BagSource(tmp_path / 'bag').odometry())
    assert [sample.stamp_ns - START_NS for sample in samples] == [0, 40_000_000]
    first, second = samples
    assert (first.frame, first.base_frame, first.velocity) == ('odom', 'base_link', (0.5, 0, -0.3))
    np.testing.assert_allclose(first.pose, [1.0, 2.0, np.pi / 2])
    assert second.pose[0] == 3.0


def all_of(source: RobotSource) -> list[Reading]:
    readings = Readings(source, SENSORS)
    return list(readings.until(2**62))


def numbers(readings: Iterable[Reading]) -> list[NDArray[np.float64]]:
    return [
        r.rate if isinstance(r, AngularRate) else r.T_odom_base
        for r in readings
        if isinstance(r, AngularRate | BasePose)
    ]


@pytest.mark.parametrize('scene', ['room', pytest.param('corridor', marks=pytest.mark.slow)])
def test_a_robot_comes_back_from_a_bag_and_from_the_bag_of_a_bag(
    tmp_path: Path, scene: str
) -> None:
    """What wheels and IMU say, and where they are: a camera in a hand has no base."""
    source = SyntheticSource.from_address(f'synthetic:{scene}?frames=2&sensor=d435i')
    convert(tmp_path / 'once', source, [source.render(k) for k in range(2)], BagOptions())
    once = BagSource(tmp_path / 'once')
    frames = [frame for frame in once if isinstance(frame, RgbdFrame)]
    convert(tmp_path / 'twice', once, frames, BagOptions('sqlite3'))
    config = SENSORS if source.T_base_cam is not None else override(SENSORS, {'wheels': False})
    expected = all_of(source)
    for back in (once, BagSource(tmp_path / 'twice')):
        assert list(back.imu()) == list(source.imu())
        assert not priors_of(back, config).unmounted
        assert back.T_cam_imu is not None
        np.testing.assert_allclose(back.T_cam_imu, source.T_cam_imu, atol=EXACT)
        if source.T_base_cam is not None:
            assert back.T_base_cam is not None
            np.testing.assert_allclose(back.T_base_cam, source.T_base_cam, atol=EXACT)
        else:
            assert back.T_base_cam is None
        found = all_of(back)
        assert [r.stamp_ns for r in found] == [r.stamp_ns for r in expected]
        for a, b in zip(numbers(found), numbers(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=EXACT)
