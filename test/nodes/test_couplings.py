# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Nothing ties a node to the name of the other, to one camera frame, or to its process."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.nodes import replay, tracker
from dcgs_ros.nodes.mapper import MapperNode
from dcgs_ros.nodes.messages.clouds import KEYFRAME_POSE, MAP_GAUSSIAN
from dcgs_ros.nodes.messages.ids import EPOCH
from dcgs_ros.nodes.messages.images import header, write_camera
from dcgs_ros.nodes.messages.keyframes import TOPICS, write_keyframe
from dcgs_ros.nodes.messages.packet import KeyframePacket
from dcgs_ros.nodes.messages.poses import pose_stamped
from dcgs_ros.nodes.replay import ReplayNode
from dcgs_ros.nodes.tracker import TrackerNode
from dcgs_ros.nodes.tracking.pairing import ImagePair
from dcgs_ros.nodes.transport import RELIABLE, sensor_qos

HANGS_S = 60.0  # only a failure takes so long
CAMERA = PinholeCamera(48, 36, 42.0, 42.0, 23.5, 17.5)
TO_MAPPER = {f'keyframe/{name}' for name in TOPICS} | {'camera_pose', 'keyframe_poses'}
CAMERA_TOPICS = {
    f'camera/camera/{name}'
    for name in ('color/image_raw', 'aligned_depth_to_color/image_raw', 'color/camera_info')
}
INFO = {'camera/camera/color/camera_info'}
TO_TRACKER = {'keyframe/received', 'keyframe/answer', 'gaussian_map', 'gaussian_map_updates'}
PLANE = ['-p', 'source:=synthetic:plane']
RENAMED = ['-r', 'dcgs_tracker:__node:=eye', '-r', 'dcgs_mapper:__node:=brain']

IDENTITY = np.eye(4)
OK, RELOCALISED = TrackingState.OK, TrackingState.RELOCALISED

Make = Callable[..., Any]


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


@pytest.mark.parametrize(
    ('arguments', 'namespace'), [([], '/'), (['-r', '__ns:=/robot'], '/robot/')]
)
def test_each_robot_has_its_own_camera_once_the_tracker_is_ready(
    make: Make, arguments: list[str], namespace: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    eye, before = make(TrackerNode, *arguments, *PLANE), list[set[str]]()
    player = make(ReplayNode)
    expected = {namespace + name for name in CAMERA_TOPICS}
    assert expected <= names(player.publishers)
    monkeypatch.setattr(tracker, 'warm_up', lambda *_: before.append(names(eye.subscriptions)))
    eye._mapper.resumable = lambda _: None
    eye._camera.queue.close()
    eye._work()
    assert expected & before[0] == {f'{namespace}camera/camera/color/camera_info'}
    assert expected <= names(eye.subscriptions) and eye._ready


def test_a_replay_waits_for_all_who_have_to_subscribe_and_says_for_whom(make: Make) -> None:
    player = make(ReplayNode, '-p', 'wait_for_node:=dcgs_tracker', *PLANE)
    ear = make(lambda: Node('ear'))
    for kind, topic in ((CameraInfo, 'color/camera_info'), (Image, 'color/image_raw'),
                        (Image, 'aligned_depth_to_color/image_raw')):  # fmt: skip
        ear.create_subscription(kind, f'camera/camera/{topic}', lambda _: None, 1)
    outputs = [player._outputs[name] for name in replay._IMAGES]
    spin_until(lambda: all(out.get_subscription_count() for out in outputs), player, ear)
    assert player._lacking().startswith('dcgs_tracker to subscribe to /camera/camera/color')
    eye = make(TrackerNode)
    spin_until(lambda: 'color/image_raw' in player._lacking(), player, eye)
    eye._camera.begin()
    spin_until(lambda: player._lacking() is None, player, eye)


def test_what_was_missed_before_the_tracker_was_ready_is_told_once(
    make: Make, capfd: pytest.CaptureFixture[str]
) -> None:
    eye, other = make(TrackerNode), make(lambda: Node('other'))
    bag = other.create_publisher(CameraInfo, 'camera/camera/color/camera_info', 100)
    spin_until(lambda: bag.get_subscription_count() > 0, eye, other)
    for k in range(30):
        bag.publish(write_camera(CAMERA, header(10**18 + k * 10**8, 'optical')))
    spin_until(lambda: eye._camera.missed.count == 30, eye)
    eye._reporter.report()
    eye._camera.begin()
    eye._ready = True
    eye._camera._received_s -= 10.0  # nothing comes any more
    for _ in range(3):
        eye._reporter.report()
    assert capfd.readouterr().err.count('missed 30 frames (2.9 s)') == 1
    eye._ready = False


def result_at(
    stamp_ns: int, T_world_cam: NDArray[np.float64] = IDENTITY, state: TrackingState = OK
) -> TrackResult:
    """Return a result that claims a centimetre in the map around it, and ten in the world."""
    return TrackResult(
        stamp_ns, T_world_cam, np.eye(4), 1e-4 * np.eye(6), 1e-2 * np.eye(6), state, None, 0, 0,
        0, False, (), 0.0, None, 2e-4 * np.eye(6),
    )  # fmt: skip


def test_the_pose_claims_what_the_map_adds_and_odometry_only_its_drift(make: Make) -> None:
    """What the map adds in the world is not in the motion that a velocity is of."""
    outputs, sent = make(TrackerNode, '-p', 'node.tf:=none')._outputs, list[Any]()
    outputs._odometry = SimpleNamespace(publish=sent.append)
    placed: list[Any] = []
    outputs._with_covariance = SimpleNamespace(publish=placed.append)
    to_base = outputs.mounting.find('optical')
    ahead = np.eye(4)
    ahead[2, 3] = 0.1
    for stamp_ns, T, state in (
        (10**8, IDENTITY, OK), (2 * 10**8, ahead, OK), (3 * 10**8, IDENTITY, RELOCALISED),
    ):  # fmt: skip
        outputs.publish(result_at(stamp_ns, T, state), to_base)
    for message in sent:
        assert message.header.frame_id == 'odom'
    # In odom there is only the drift; a camera that was lost may be a metre farther.
    drift_m2 = [message.pose.covariance[0] for message in sent]
    np.testing.assert_allclose(drift_m2, [1e-4, 1e-4, 1.0 + 1e-4])
    for message in placed:
        assert message.header.frame_id == 'map'
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
    outputs.publish(tracked, outputs.mounting.find('optical'))
    spin_until(lambda: brain._pose is not None and bool(received), eye, brain)
    assert received[-1] == [] and brain._pose.header.stamp.nanosec == 5


@pytest.mark.parametrize(
    ('arguments', 'expected'),
    [([], ['dcgs_tracker: tracking', 'dcgs_mapper: mapping']),
     (RENAMED, ['eye: tracking', 'brain: mapping']),
     (['-r', '__ns:=/robot'], ['robot/dcgs_tracker: tracking', 'robot/dcgs_mapper: mapping'])],
)  # fmt: skip
def test_diagnostics_carry_the_nodes_own_name(
    make: Make, arguments: list[str], expected: list[str]
) -> None:
    reports: list[Any] = []
    for kind in (TrackerNode, MapperNode):
        node = make(kind, *arguments)
        node._reporter._publisher = SimpleNamespace(publish=reports.append)
        node._reporter.report()
    assert [report.status[0].name for report in reports] == expected


def keyframe_in(camera_frame: str, stamp_ns: int, world: str = 'odom') -> dict[str, Any]:
    color = np.full((CAMERA.height, CAMERA.width, 3), 100, np.uint8)
    frame = RgbdFrame(stamp_ns, stamp_ns, color, np.full(color.shape[:2], 1.5, np.float32))
    mean, normal = np.array([[0, 0, 1.5]], np.float32), np.array([[0, 0, -1]], np.float32)
    ids = np.array([stamp_ns], np.int64)
    keyframe = Keyframe(frame, np.eye(4), np.eye(4), ids, mean, normal)
    return write_keyframe(KeyframePacket(1, CAMERA, keyframe, camera_frame), world)


def test_the_map_is_in_the_frame_of_the_keyframes(make: Make) -> None:
    """Before there is one, as of a map file, in that of the setting."""
    node, clouds = make(MapperNode, '-p', 'node.map_frame:=floor_1'), list[Any]()
    for name in ('_map', '_updates', '_received', '_answers'):
        setattr(node._outputs, name, SimpleNamespace(publish=clouds.append))
    node._outputs.keyframes(node._session.mapper)
    assert [cloud.header.frame_id for cloud in clouds] == ['floor_1']
    clouds.clear()
    node._insert(keyframe_in('optical', 1, 'map'))
    node._outputs.update(node._session.mapper)
    assert len(clouds) == 4 and {cloud.header.frame_id for cloud in clouds} == {'map'}


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
from rclpy.serialization import serialize_message
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


def test_while_kernels_are_loaded_services_are_answered_at_once(make: Make) -> None:
    """And a reset counts for what comes after it."""
    eye, brain = make(TrackerNode), make(MapperNode)
    assert eye._on_reset().result(0) and brain._on_reset().result(0)
    with pytest.raises(DcgsError, match='loading the kernels'):
        brain._when_ready(brain._save).result(0)
    epoch = eye._session.epoch
    assert eye._camera.queue.take(0.0) is None
    assert eye._session.epoch != epoch


@pytest.mark.parametrize('kind', [TrackerNode, MapperNode])
def test_a_node_that_still_loads_kernels_ends_without_waiting(make: Make, kind: Any) -> None:
    node, done = make(kind, '-p', 'node.save_on_exit:=true'), list[str]()
    node._worker = SimpleNamespace(
        join=lambda: done.append('join'), leave=lambda: done.append('leave')
    )
    node.close()
    assert done == ['leave']
    node.close = lambda: None


def test_pausing_ends_the_images_and_says_so(make: Make) -> None:
    eye = make(TrackerNode)
    eye._camera.begin()
    eye._ready = True
    assert 'paused' in eye._on_pause().result(0)
    assert eye._judged()[0].message.startswith('paused')
    assert not names(eye.subscriptions) & {f'/{topic}' for topic in CAMERA_TOPICS - INFO}
    assert 'goes on' in eye._on_resume().result(0)
    assert not eye._judged()[0].message.startswith('paused')
    assert {f'/{topic}' for topic in CAMERA_TOPICS} <= names(eye.subscriptions)
    assert {'pause', 'resume'} <= {s.srv_name.rpartition('/')[2] for s in eye.services}
    eye._ready = False


@pytest.mark.parametrize(('max_hz', 'tracked'), [(0.0, 6), (15.0, 3)])
def test_frames_beyond_the_largest_rate_are_left_out(
    make: Make, monkeypatch: pytest.MonkeyPatch, max_hz: float, tracked: int
) -> None:
    """A replay hears of them too."""
    eye = make(TrackerNode, '-p', f'node.max_rate_hz:={max_hz}')
    monkeypatch.setattr(tracker, 'warm_up', lambda *_: None)
    eye._mapper.resumable = lambda _: None
    eye._camera.reader.on_info('color', write_camera(CAMERA, header(7, 'optical')))
    queue, seen, told = eye._camera.queue, list[Any](), list[Any]()
    eye._track = seen.append
    eye._outputs.progress = told.append
    image = Image(header=header(7, 'optical'))
    stamps, last = iter(range(7, 7 + 6 * 33_333_333, 33_333_333)), 7 + 5 * 33_333_333

    def take(_: float) -> ImagePair[Image, Image]:
        ns = next(stamps)
        if ns == last:
            queue.close()
        return ImagePair(ns, image, ns, image)

    queue.take = take
    eye._work()
    assert (len(seen), len(told)) == (tracked, 6)
    assert eye._judged()[1]['left_out'] == 6 - tracked
    eye._ready = False


def test_reports_go_on_where_simulated_time_stands_still(make: Make) -> None:
    eye, reports = make(TrackerNode, '-p', 'use_sim_time:=true'), list[Any]()
    eye._reporter._publisher = SimpleNamespace(publish=reports.append)
    spin_until(lambda: len(reports) >= 2, eye)


def test_each_cause_is_logged_once_at_its_level(
    make: Make, capfd: pytest.CaptureFixture[str]
) -> None:
    eye = make(TrackerNode)
    eye._camera.begin()
    eye._ready = True
    for _ in range(5):
        eye._camera._received_s -= 7.0
        eye._reporter.report()
    eye._ready = False
    said = [line for line in capfd.readouterr().err.splitlines() if 'no camera_info' in line]
    assert len(said) == 1 and said[0].startswith('[ERROR]')
    assert 'nobody publishes /camera/camera/color/camera_info' in said[0]


def test_a_publisher_of_another_reliability_is_named_as_the_cause(make: Make) -> None:
    eye, other = make(TrackerNode, '-p', 'node.reliability:=reliable'), make(lambda: Node('other'))
    eye._camera.begin()
    eye._ready = True
    for kind, topic in ((CameraInfo, 'color/camera_info'), (Image, 'color/image_raw')):
        other.create_publisher(kind, f'camera/camera/{topic}', sensor_qos('best_effort'))
    spin_until(lambda: eye._camera.news().topics['color'].publishers == 1, eye, other)
    topics = eye._camera.news().topics
    assert topics['color'].incompatible and topics['camera_info'].incompatible
    assert topics['depth'].publishers == 0
    assert 'set node.reliability to best_effort' in eye._judged()[0].message
    eye._ready = False


@pytest.mark.parametrize('alive', [True, False])
def test_a_map_is_gone_on_in_only_where_its_tracker_has_gone(
    make: Make, alive: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    eye, other = make(TrackerNode), make(lambda: Node('other'))
    rows, poses = np.zeros(1, MAP_GAUSSIAN), np.zeros(1, KEYFRAME_POSE)
    rows['id'], rows['rot_0'], poses['qw'] = 500 * EPOCH, 1.0, 1.0
    eye._mapper._mirror.whole(1, rows)
    eye._mapper._keyframes = poses
    pose = other.create_publisher(PoseStamped, 'camera_pose', RELIABLE)
    spin_until(lambda: pose.get_subscription_count() > 0, eye, other)
    if alive:
        pose.publish(pose_stamped(np.eye(4), header(5, 'odom')))
        spin_until(lambda: eye._mapper._has_rival, eye)
    found = eye._mapper.resumable(0.0)
    assert (found is None) == alive
    assert ('another tracker is at work here' in capfd.readouterr().err) == alive


def test_a_replay_hears_which_frames_the_tracker_is_through_with(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    eye = make(TrackerNode, '-p', 'wait_for_node:=dcgs_tracker', *PLANE)
    player, heard = make(ReplayNode), list[tuple[str, int]]()
    player._pursuit = SimpleNamespace(
        wait=lambda: True,
        played=lambda ns: heard.append(('played', ns)),
        tracked=lambda ns: heard.append(('tracked', ns)),
        end=lambda: None,
    )
    image = Image(header=header(7, 'optical'))
    player._keep_near(image)
    player._keep_near(serialize_message(image))
    assert heard == [('played', 7)] * 2
    progress, queue = eye._outputs._progress, eye._camera.queue
    spin_until(lambda: progress.get_subscription_count() > 0, eye, player)
    monkeypatch.setattr(tracker, 'warm_up', lambda *_: None)
    eye._mapper.resumable = lambda _: None
    eye._camera.reader.on_info('color', write_camera(CAMERA, header(7, 'optical')))
    eye._track = lambda *_: queue.close()
    queue.put(ImagePair(7, image, 7, image))
    eye._work()
    spin_until(lambda: heard[-1] == ('tracked', 7), player)
