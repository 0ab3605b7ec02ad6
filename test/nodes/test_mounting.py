# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The base's poses where TF tells late, or never, where the camera is on it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

import rclpy
from camera import Shot, halved  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.io.trajectory import read_tum
from dcgs_ros.nodes import tracker
from dcgs_ros.nodes.health import Level
from dcgs_ros.nodes.messages.ids import same_tracker
from dcgs_ros.nodes.messages.images import header
from dcgs_ros.nodes.messages.odometry import pose_with_covariance
from dcgs_ros.nodes.messages.poses import matrix
from dcgs_ros.nodes.tracker import TrackerNode
from dcgs_ros.nodes.tracking import outputs
from dcgs_ros.nodes.tracking.pairing import ImagePair

pytestmark = pytest.mark.slow

SOURCE = SyntheticSource.from_address('synthetic:room?frames=10&sensor=ideal')
MOUNT = se3.exp(np.array([0.3, 0.1, 0.8, -1.5, 0.3, -1.2]))  # T_base_cam: it looks down a bit
NEAR_M = 0.01


class Tf:
    listens = True
    T: NDArray[np.float64] | None = None

    def send(self, transform: Any) -> None:
        pass

    send_static = send

    def lookup(
        self, parent: str, child: str, stamp_ns: int | None = None
    ) -> NDArray[np.float64] | None:
        assert (parent, child) == ('base_link', 'camera_color_optical_frame')
        return self.T


class Robot:
    """A tracker without its threads, and what it publishes."""

    def __init__(self, node: Any, tf: Tf) -> None:
        self.node, self.tf, self.sent = node, tf, list[Any]()
        node._outputs._odometry = SimpleNamespace(publish=self.sent.append)
        self.infos = list[Any]()
        node._frame_info._publisher = SimpleNamespace(
            publish=self.infos.append, get_subscription_count=lambda: 1
        )
        node._ready = True

    def track(self, shot: Shot) -> None:
        parts = shot.messages
        self.node._camera.reader.on_info('color', parts['camera_info'])
        pair = ImagePair(shot.stamp_ns, parts['color'], shot.stamp_ns, parts['depth'])
        self.node._outputs.mounting._due_s = 0.0  # asks TF at every frame
        self.node._track(pair)

    def bases(self) -> list[NDArray[np.float64]]:
        return [matrix(message.pose.pose) for message in self.sent]


@pytest.fixture
def robot(
    ros_environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Robot]]:
    for name, value in ros_environment.items():
        monkeypatch.setenv(name, value)
    idle = SimpleNamespace(join=lambda: None, leave=lambda: None)
    monkeypatch.setattr(tracker, 'Worker', lambda *_: idle)
    made: list[Any] = []

    def make(*given: str) -> Robot:
        tf = Tf()
        monkeypatch.setattr(outputs, 'make_transforms', lambda _: tf)
        parameters = ['node.base_frame:=base_link', 'sensor.a_m:=0.001', *given]
        rclpy.init(args=['--ros-args', *(part for p in parameters for part in ('-p', p))])
        made.append(TrackerNode())
        return Robot(made[-1], tf)

    yield make
    for node in made:
        node.close()
        node.destroy_node()
    rclpy.try_shutdown()


def shots() -> list[Shot]:
    camera: PinholeCamera = SOURCE.camera
    return [halved(frame, camera) for frame in SOURCE]


def true_bases(taken: list[Shot]) -> list[NDArray[np.float64]]:
    """Where the base is, seen from where it was at the first frame."""
    cameras = [SOURCE.pose(shot.stamp_ns) for shot in taken]
    start = se3.inverse(cameras[0])
    return [MOUNT @ start @ T @ se3.inverse(MOUNT) for T in cameras]


def off_m(found: list[NDArray[np.float64]], true: list[NDArray[np.float64]]) -> float:
    assert len(found) == len(true)
    return max(float(np.abs(a - b).max()) for a, b in zip(found, true, strict=True))


def test_nothing_is_tracked_while_tf_is_waited_for(robot: Callable[..., Robot]) -> None:
    one, taken = robot(), shots()
    for shot in taken[:3]:
        one.track(shot)
    assert not one.sent
    verdict = one.node._judged()[0]
    assert verdict.level is not Level.OK
    one.tf.T = MOUNT
    for shot in taken[3:]:
        one.track(shot)
    assert off_m(one.bases(), true_bases(taken[3:])) < NEAR_M


def test_a_mount_that_comes_late_makes_all_right_that_follows(
    robot: Callable[..., Robot], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The poses that were recorded too, which are known to have been wrong."""
    one = robot('node.wait_for_transform_s:=0.0', f'node.save_on_exit:={tmp_path}')
    taken, session = shots(), one.node._session
    for shot in taken[:5]:
        one.track(shot)
    epoch, true = session.epoch, true_bases(taken)
    assert len(one.sent) == 5 and off_m(one.bases()[1:], true[1:5]) > NEAR_M
    one.tf.T = MOUNT
    for shot in taken[5:]:
        one.track(shot)
    assert session.epoch != epoch and same_tracker(session.epoch, epoch)
    assert off_m(one.bases()[5:], true[5:]) < NEAR_M
    said = capfd.readouterr().err
    assert 'wrong unless' in said and 'has come' in said and 'a new map begins' in said
    assert one.node._outputs.close() is not None
    recorded = read_tum(tmp_path / 'trajectory.tum')
    assert off_m(list(recorded.T_world_cam[:5]), true[:5]) < NEAR_M


def test_where_the_base_is_said_to_be_elsewhere_it_is_not_taken_to_be_so(
    robot: Callable[..., Robot], capfd: pytest.CaptureFixture[str]
) -> None:
    """But it is looked for there, from the next frame on."""
    one, taken = robot(), shots()
    one.tf.T = MOUNT
    for shot in taken[:3]:
        one.track(shot)
    elsewhere = se3.exp(np.array([5.0, 0, 0, 0, 0, 0]))
    pose = pose_with_covariance(header(0, 'map'), elsewhere, np.zeros((6, 6)))
    one.node._initial_pose._on_pose(pose)
    for shot in taken[3:5]:
        one.track(shot)
    assert len(one.sent) == 3 and one.node._session.searching
    assert 'looked for around' in capfd.readouterr().err


def test_odom_waits_where_it_was_for_a_camera_that_is_lost(robot: Callable[..., Robot]) -> None:
    one, frames = robot('keyframes.new_submap_s:=1000.0'), list(SOURCE)
    one.tf.T = MOUNT
    for shot in shots()[:3]:
        one.track(shot)
    last, odom = one.bases()[-1], one.node._outputs._odom
    for frame in frames[3:6]:  # somebody holds a hand before it
        dark = replace(
            frame, color=np.zeros_like(frame.color), depth_m=np.full_like(frame.depth_m, 0.4)
        )
        one.track(halved(dark, SOURCE.camera))
    assert len(one.sent) == 3 and odom._broken
    said = [info.status[0].message for info in one.infos]
    assert said == ['ok'] * 3 + ['lost'] * 3
    for shot in shots()[6:]:
        one.track(shot)
    assert len(one.sent) > 3
    np.testing.assert_allclose(one.bases()[3], last, atol=1e-9)
