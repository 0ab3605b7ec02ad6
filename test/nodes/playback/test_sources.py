# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What is played beside images: samples in their order, and where the sensors are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')
pytest.importorskip('rosbags')

from dcgs_ros.core import se3
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.bag.extrinsics import transform_between
from dcgs_ros.datasets.bag.messages import IMU, ODOMETRY, decode, read_header
from dcgs_ros.datasets.bag.writing.storage import BagOptions
from dcgs_ros.datasets.bag.writing.writer import write_bag
from dcgs_ros.datasets.synthetic.source import IMU_FRAME, SyntheticSource
from dcgs_ros.nodes.playback.sources import PlaybackSource, open_playback

ADDRESS = 'synthetic:corridor?frames=4&sensor=d435i'
SOURCE = SyntheticSource.from_address(ADDRESS)
OPTICAL = 'camera_color_optical_frame'
EXACT = 1e-9


def opened(source: str) -> PlaybackSource:
    return open_playback(source, None, 'camera_link', OPTICAL, lambda _: None)


def assert_placed(playback: PlaybackSource) -> None:
    tree = {child: (parent, T) for parent, child, T in playback.mounts}
    assert len(tree) == len(playback.mounts)
    T_base_cam, T_cam_imu = (
        transform_between(tree, *frames)
        for frames in (('base_link', playback.camera_frame), (playback.camera_frame, IMU_FRAME))
    )
    assert T_base_cam is not None and T_cam_imu is not None and SOURCE.T_base_cam is not None
    np.testing.assert_allclose(T_base_cam, SOURCE.T_base_cam, atol=EXACT)
    np.testing.assert_allclose(T_cam_imu, SOURCE.T_cam_imu, atol=EXACT)


def test_samples_are_played_between_the_frames_of_their_time() -> None:
    playback = opened(ADDRESS)
    assert playback.beside == {'imu', 'odometry'}
    items = list(playback.items())
    due = [due_ns for due_ns, _ in items]
    assert due == sorted(due)
    assert isinstance(items[0][1], RgbdFrame) and isinstance(items[-1][1], RgbdFrame)
    stamps = {'imu': list[int](), 'odometry': list[int]()}
    for due_ns, item in items:
        for output, message in playback.messages(item, shift_ns=7):
            if output in stamps:
                stamp = message.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == due_ns + 7
                stamps[output].append(due_ns)
    span = range(due[0] + 1, due[-1] + 1)
    for output, samples in (('imu', SOURCE.imu()), ('odometry', SOURCE.odometry())):
        assert stamps[output] == [s.stamp_ns for s in samples if s.stamp_ns in span]
    assert_placed(playback)


def test_a_bag_is_played_with_what_it_has_beside_images(tmp_path: Path) -> None:
    write_bag(tmp_path / 'bag', SOURCE, [SOURCE.render(k) for k in range(4)], BagOptions())
    playback = opened(str(tmp_path / 'bag'))
    assert playback.beside == {'imu', 'odometry'}
    played = [
        (output, cdr, due_ns)
        for due_ns, item in playback.items()
        for output, cdr in playback.messages(item, 0)
    ]
    assert [due_ns for *_, due_ns in played] == sorted(due_ns for *_, due_ns in played)
    rates = [decode(cdr, IMU).angular_velocity.x for output, cdr, _ in played if output == 'imu']
    assert rates == [s.angular_velocity[0] for s in SOURCE.imu() if s.angular_velocity]
    ways = [
        decode(cdr, ODOMETRY).pose.pose.position.x
        for output, cdr, _ in played
        if output == 'odometry'
    ]
    assert ways == [sample.pose[0] for sample in SOURCE.odometry()]
    shifted = [
        read_header(cdr)[0]
        for _, item in playback.items()
        for _, cdr in playback.messages(item, 10**9)
    ]
    assert shifted == [read_header(cdr)[0] + 10**9 for _, cdr, _ in played]
    assert_placed(playback)


def test_a_camera_alone_is_at_its_link(tmp_path: Path) -> None:
    hand = SyntheticSource.from_address('synthetic:plane?frames=1')
    hand.imu_frames = ()
    write_bag(tmp_path / 'bag', hand, [hand.render(0)], BagOptions())
    (mount,) = opened(str(tmp_path / 'bag')).mounts
    assert mount[:2] == ('camera_link', OPTICAL)
    forward = mount[2][:3, :3] @ np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(forward, [1, 0, 0], atol=EXACT)
    np.testing.assert_allclose(mount[2] @ se3.inverse(mount[2]), np.eye(4), atol=EXACT)
