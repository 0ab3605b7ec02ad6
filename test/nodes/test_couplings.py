# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Nothing ties a node to the name of the other, to one camera frame, or to its process."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.nodes import mapper, tracker
from dcgs_ros.nodes.mapper import MapperNode
from dcgs_ros.nodes.messages.images import header
from dcgs_ros.nodes.messages.keyframes import TOPICS, write_keyframe
from dcgs_ros.nodes.messages.packet import KeyframePacket
from dcgs_ros.nodes.messages.poses import pose_stamped
from dcgs_ros.nodes.tracker import TrackerNode

HANGS_S = 60.0  # only a failure takes so long
CAMERA = PinholeCamera(48, 36, 42.0, 42.0, 23.5, 17.5)
TO_MAPPER = {f'keyframe/{name}' for name in TOPICS} | {'camera_pose'}
TO_TRACKER = {'keyframe/received', 'keyframe/answer', 'gaussian_map', 'gaussian_map_updates'}
RENAMED = ['-r', 'dcgs_tracker:__node:=eye', '-r', 'dcgs_mapper:__node:=brain']

IDENTITY = np.eye(4)
OK, RELOCALISED = TrackingState.OK, TrackingState.RELOCALISED

Make = Callable[..., Any]


@pytest.fixture
def make(ros_environment: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a maker of nodes of this process, without their threads."""
    for name, value in ros_environment.items():
        monkeypatch.setenv(name, value)
    idle = SimpleNamespace(join=lambda: None)
    for module in (tracker, mapper):
        monkeypatch.setattr(module, 'Worker', lambda node, work, name: idle)
    nodes: list[Any] = []

    def made(kind: Callable[[], Node], *arguments: str) -> Any:
        if not rclpy.ok():
            rclpy.init(args=['--ros-args', *arguments])
        nodes.append(kind())
        return nodes[-1]

    yield made
    for node in nodes:
        node.close()
        node.destroy_node()
    rclpy.try_shutdown()


def spin_until(condition: Callable[[], bool], *nodes: Node) -> None:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    end = time.monotonic() + HANGS_S
    while not condition():
        assert time.monotonic() < end
        executor.spin_once(timeout_sec=0.05)
    executor.shutdown()


def names(entities: Any) -> set[str]:
    return {entity.topic_name for entity in entities}


@pytest.mark.parametrize(
    ('arguments', 'namespace'),
    [([], '/'), (RENAMED, '/'), (['-r', '__ns:=/robot'], '/robot/'),
     ([*RENAMED, '-r', '__ns:=/robot'], '/robot/')],
    ids=['default', 'renamed', 'namespace', 'both'],
)  # fmt: skip
def test_tracker_and_mapper_are_linked_under_any_names(
    make: Make, arguments: list[str], namespace: str
) -> None:
    eye, brain = make(TrackerNode, *arguments), make(MapperNode)
    assert {namespace + name for name in TO_MAPPER} <= names(eye.publishers)
    assert {namespace + name for name in TO_MAPPER} <= names(brain.subscriptions)
    assert {namespace + name for name in TO_TRACKER} <= names(brain.publishers)
    assert {namespace + name for name in TO_TRACKER} <= names(eye.subscriptions)


def result_at(
    stamp_ns: int, T_world_cam: NDArray[np.float64] = IDENTITY, state: TrackingState = OK
) -> TrackResult:
    """Return a result that claims a centimetre in the map around it, and ten in the world."""
    return TrackResult(
        stamp_ns, T_world_cam, np.eye(4), 1e-4 * np.eye(6), 1e-2 * np.eye(6), state, None, 0, 0,
        0, False, (), 0.0,
    )  # fmt: skip


def test_odometry_claims_the_pose_in_the_world_and_the_velocity_in_the_map(make: Make) -> None:
    """What the map adds in the world is in both poses that a velocity is between."""
    outputs, sent = make(TrackerNode, '-p', 'node.tf:=none')._outputs, list[Any]()
    outputs._odometry = SimpleNamespace(publish=sent.append)
    to_base = outputs.camera_to_base('optical')
    ahead = np.eye(4)
    ahead[2, 3] = 0.1
    for stamp_ns, T, state in (
        (10**8, IDENTITY, OK), (2 * 10**8, ahead, OK), (3 * 10**8, IDENTITY, RELOCALISED),
    ):  # fmt: skip
        outputs.publish(result_at(stamp_ns, T, state), to_base)
    for message in sent:
        np.testing.assert_allclose(message.pose.covariance[0], 1e-2)
    assert sent[1].twist.twist.linear.x == pytest.approx(1.0)  # the camera looks along x
    assert sent[1].twist.covariance[0] == pytest.approx(2e-4 / 0.1**2)
    for message in (sent[0], sent[2]):  # a camera that is found again did not move there
        assert message.twist.twist.linear.x == 0.0
        assert message.twist.covariance[0] == pytest.approx(1.0)


def test_a_renamed_mapper_hears_the_camera_pose_and_is_heard(make: Make) -> None:
    eye, brain = make(TrackerNode, *RENAMED), make(MapperNode)
    received: list[Any] = []
    eye._mapper._pass_received = received.append
    brain._outputs.keyframes(None)
    tracked = result_at(5)
    outputs = eye._outputs
    spin_until(lambda: outputs._camera_pose.get_subscription_count() > 0, eye, brain)
    outputs.publish(tracked, outputs.camera_to_base('optical'))
    spin_until(lambda: brain._pose is not None and bool(received), eye, brain)
    assert received[-1] == [] and brain._pose.header.stamp.nanosec == 5


@pytest.mark.parametrize(
    ('arguments', 'expected'),
    [([], ['dcgs_tracker: tracking', 'dcgs_mapper: mapping']),
     (RENAMED, ['eye: tracking', 'brain: mapping'])],
)  # fmt: skip
def test_diagnostics_carry_the_nodes_own_name(
    make: Make, arguments: list[str], expected: list[str]
) -> None:
    reports: list[Any] = []
    for kind in (TrackerNode, MapperNode):
        node = make(kind, *arguments)
        node._health = SimpleNamespace(publish=reports.append)
        node._report()
    assert [report.status[0].name for report in reports] == expected


def keyframe_in(camera_frame: str, stamp_ns: int) -> dict[str, Any]:
    color = np.full((CAMERA.height, CAMERA.width, 3), 100, np.uint8)
    frame = RgbdFrame(stamp_ns, stamp_ns, color, np.full(color.shape[:2], 1.5, np.float32))
    mean, normal = np.array([[0, 0, 1.5]], np.float32), np.array([[0, 0, -1]], np.float32)
    ids = np.array([stamp_ns], np.int64)
    keyframe = Keyframe(frame, np.eye(4), np.eye(4), ids, mean, normal)
    return write_keyframe(KeyframePacket(1, CAMERA, keyframe, camera_frame), 'odom')


def test_a_rendered_view_is_in_the_frame_of_the_camera(make: Make) -> None:
    """Also after another camera has come."""
    node = make(MapperNode)
    views: list[Any] = []
    for name in ('_color', '_depth'):
        setattr(node._outputs, name, SimpleNamespace(publish=views.append))
    for stamp_ns, camera_frame in enumerate(['front_optical', 'rear_optical'], start=1):
        node._insert(keyframe_in(camera_frame, stamp_ns))
        node._render(pose_stamped(np.eye(4), header(stamp_ns, 'odom')))
        assert [view.header.frame_id for view in views] == [camera_frame] * 2
        views.clear()


TWO_NODES = """
import rclpy
from rclpy.node import Node
from dcgs_ros.nodes.lifetime import Worker, run


class Example(Node):
    def __init__(self, name, work):
        super().__init__(name)
        self.worker = Worker(self, work, 'work')


def fail():
    raise ValueError('of this node alone')


failing = run(lambda: Example('failing', fail))
fine = run(lambda: Example('fine', rclpy.shutdown))
print(failing, fine)
"""


def test_the_failure_of_a_node_is_not_that_of_another_in_its_process(
    ros_environment: dict[str, str],
) -> None:
    done = subprocess.run(
        [sys.executable, '-c', TWO_NODES], env=ros_environment, capture_output=True, text=True,
        timeout=HANGS_S,
    )  # fmt: skip
    assert 'of this node alone' in done.stderr
    assert done.stdout == '1 0\n'
