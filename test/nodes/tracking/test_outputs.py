# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The frames of REP 105: odom without steps, the map as it is known, and TF between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from rclpy.node import Node
from rclpy.time import Time

from dcgs_ros.core import se3
from dcgs_ros.core.config.nodes import TrackerNodeSettings
from dcgs_ros.core.keyframe import Correction
from dcgs_ros.core.tracking.result import Reference, TrackingState, TrackResult
from dcgs_ros.core.tracking.visited import origin
from dcgs_ros.io.ros_images import stamp_ns
from dcgs_ros.nodes.messages.corrections import read_correction
from dcgs_ros.nodes.messages.ids import first_epoch
from dcgs_ros.nodes.messages.odometry import CameraToBase
from dcgs_ros.nodes.messages.poses import matrix
from dcgs_ros.nodes.tracking import outputs as module
from dcgs_ros.nodes.tracking.corrected import Corrected
from dcgs_ros.nodes.tracking.extrinsics import LOOKING_FORWARD
from dcgs_ros.nodes.tracking.outputs import TrackerOutputs

EXACT = 1e-9
TO_BASE = CameraToBase(se3.exp(np.array([0.1, 0.0, 0.2, 0.3, -1.2, 0.4])))
STEP = se3.exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.01]))
M = se3.exp(np.array([0.4, -0.2, 0.1, 0.0, 0.3, 0.1]))
ROBOT = se3.exp(np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.5]))  # odom -> base of wheel odometry
TURN = se3.exp(np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.1]))  # in 100 ms, at 1 rad/s
EPOCH_NUMBER = first_epoch()


class Tf:
    listens = True

    def __init__(self) -> None:
        self.sent: list[tuple[str, str, NDArray[np.float64]]] = []
        self.stamps_ns: list[int] = []
        self.known: dict[int, NDArray[np.float64]] = {}  # odom -> base of wheel odometry, by stamp

    def send(self, transform: Any) -> None:
        t, q = transform.transform.translation, transform.transform.rotation
        T = se3.from_quaternion(np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z]))
        self.sent.append((transform.header.frame_id, transform.child_frame_id, T))
        self.stamps_ns.append(stamp_ns(transform.header.stamp))

    def lookup(
        self, parent: str, child: str, stamp_ns: int | None = None
    ) -> NDArray[np.float64] | None:
        assert (parent, child) == ('odom', 'base')
        return self.known.get(stamp_ns or 0)


class Robot:
    """Outputs of a tracker, and what they published."""

    def __init__(self, node: Node, tf: Tf, setting: str) -> None:
        settings = TrackerNodeSettings(base_frame='base', tf=setting)  # type: ignore[arg-type]
        self.node, self.tf, self.outputs = node, tf, TrackerOutputs(node, settings, print)
        self.stamp_ns = 0  # of the last image
        self.late_ns = 10**8  # of an image, when it is tracked
        self.outputs._clock = SimpleNamespace(  # type: ignore[assignment]
            now=lambda: Time(nanoseconds=self.stamp_ns + self.late_ns)
        )
        self.published: dict[str, list[Any]] = {}
        for name in ('_odometry', '_pose', '_with_covariance', '_camera_pose', '_keyframe_poses'):
            messages = self.published[name] = []
            setattr(self.outputs, name, SimpleNamespace(publish=messages.append))
        self.outputs._path = SimpleNamespace(  # type: ignore[assignment]
            publish=self.published.setdefault('_path', []).append, get_subscription_count=lambda: 1
        )
        self._count = 0

    def publish(
        self,
        T: NDArray[np.float64],
        submap: int = 0,
        keyframe: int = 0,
        to_base: CameraToBase = TO_BASE,
        covariance: NDArray[np.float64] | None = None,
    ) -> None:
        self._count += 1
        self.tf.sent.clear()
        self.stamp_ns = 10**8 * self._count
        self.tf.known.setdefault(self.stamp_ns, ROBOT)
        result = TrackResult(
            self.stamp_ns, T, np.eye(4), 1e-6 * np.eye(6), 1e-4 * np.eye(6),
            TrackingState.OK, None, 0, 0, 0, False, (), 0.0,
            Reference(keyframe, np.eye(4), submap, 7, 0, np.eye(4)), 2e-6 * np.eye(6),
        )  # fmt: skip
        self.outputs._path_due_s = 0.0
        if covariance is not None:
            result = replace(
                result, covariance=covariance, covariance_world=covariance,
                motion_covariance=covariance,
            )  # fmt: skip
        self.outputs.publish(result, to_base)
        if self.outputs._beside is not None:  # its timer
            self.outputs._send_map_to_odom()

    def sent(self, parent: str, child: str) -> NDArray[np.float64]:
        (T,) = [T for frame, to, T in self.tf.sent if (frame, to) == (parent, child)]
        return T

    def last(self, name: str) -> NDArray[np.float64]:
        message = self.published[name][-1]
        pose = message.pose.pose if name in ('_odometry', '_with_covariance') else message.pose
        return matrix(pose)


@pytest.fixture
def robot(
    ros: None, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Iterator[Robot]:
    tf = Tf()
    monkeypatch.setattr(module, 'make_transforms', lambda _: tf)
    node = Node('outputs')
    yield Robot(node, tf, getattr(request, 'param', 'odom_to_base'))
    node.destroy_node()


def corrected_by(*motions: NDArray[np.float64], here: NDArray[np.float64] = M) -> Corrected:
    n = len(motions)
    applied = Correction(
        4, np.arange(n) + 1, np.array(motions), np.zeros((n, 6, 6)), np.zeros(n, np.int32)
    )
    return Corrected(applied, replace(applied), np.array(motions), here)


def same(found: NDArray[np.float64], expected: NDArray[np.float64]) -> None:
    np.testing.assert_allclose(found, expected, atol=EXACT)


def test_at_a_correction_the_map_steps_and_odom_does_not(robot: Robot) -> None:
    T = TO_BASE.T_base_cam
    robot.publish(T)
    same(robot.sent('odom', 'base'), np.eye(4))
    same(robot.sent('map', 'odom'), np.eye(4))
    robot.outputs.correct(corrected_by(M), EPOCH_NUMBER)
    robot.publish(M @ T @ STEP)
    same(robot.sent('odom', 'base'), TO_BASE.pose(T @ STEP))
    same(robot.sent('map', 'odom'), M)
    twist = robot.published['_odometry'][-1].twist.twist  # of the motion, not of the step
    assert np.linalg.norm([twist.linear.x, twist.linear.y, twist.linear.z]) < 1.0


def test_the_path_moves_with_the_keyframes(robot: Robot) -> None:
    T = TO_BASE.T_base_cam
    for keyframe in (0, 1):
        robot.publish(T, keyframe=keyframe)
    robot.outputs.correct(corrected_by(np.eye(4), M), EPOCH_NUMBER)
    robot.publish(M @ T, keyframe=1)
    way = [matrix(stamped.pose) for stamped in robot.published['_path'][-1].poses]
    for found, expected in zip(way, [np.eye(4), M, M], strict=True):
        same(found, expected)


def test_the_mapper_is_told_all_poses_and_the_number_of_the_correction(robot: Robot) -> None:
    robot.publish(TO_BASE.T_base_cam)
    robot.outputs.correct(corrected_by(np.eye(4), M), EPOCH_NUMBER)
    epoch, found = read_correction(robot.published['_keyframe_poses'][-1])
    assert (epoch, found.revision) == (EPOCH_NUMBER, 4)
    np.testing.assert_allclose(found.T_world_cam, [np.eye(4), M], atol=EXACT)


@pytest.mark.parametrize('robot', ['odom_to_base', 'map_to_odom'], indirect=True)
def test_while_the_place_in_the_map_is_not_known_odom_stays_there(robot: Robot) -> None:
    T, there = TO_BASE.T_base_cam, np.eye(4)
    there[:3, 3] = origin(1)
    robot.publish(T)
    before = robot.sent('map', 'odom')
    robot.publish(there @ T @ STEP, submap=1)
    same(robot.sent('map', 'odom'), before)
    assert len(robot.published['_pose']) == len(robot.published['_with_covariance']) == 1
    same(robot.last('_camera_pose'), there @ T @ STEP)  # the mapper renders from there


@pytest.mark.parametrize('robot', ['map_to_odom'], indirect=True)
def test_the_robots_own_odometry_is_placed_in_the_map(robot: Robot) -> None:
    T = TO_BASE.T_base_cam
    robot.publish(T @ STEP)
    assert [sent[:2] for sent in robot.tf.sent] == [('map', 'odom')]
    same(robot.sent('map', 'odom'), TO_BASE.pose(T @ STEP) @ se3.inverse(ROBOT))


@pytest.mark.parametrize('robot', ['map_to_odom'], indirect=True)
def test_perfect_wheels_that_turn_leave_the_map_where_it_was(robot: Robot) -> None:
    """Images are 100 ms late, and TF knows by then where the wheels are by now."""
    before = None
    for k in range(1, 20):
        T_odom_base, later = np.linalg.matrix_power(TURN, k), np.linalg.matrix_power(TURN, k + 1)
        robot.tf.known |= {0: later, 10**8 * k: T_odom_base, 10**8 * (k + 1): later}
        robot.publish(M @ T_odom_base @ TO_BASE.T_base_cam)
        same(robot.sent('map', 'odom'), M)
        assert before is None or robot.tf.stamps_ns[-1] > before
        before = robot.tf.stamps_ns[-1]


@pytest.mark.parametrize('robot', ['map_to_odom'], indirect=True)
def test_a_correction_moves_odom_in_the_map_without_a_frame(robot: Robot) -> None:
    robot.publish(TO_BASE.T_base_cam)
    robot.outputs.correct(corrected_by(M), EPOCH_NUMBER)
    robot.tf.sent.clear()
    robot.late_ns += 10**7
    robot.outputs._send_map_to_odom()
    same(robot.sent('map', 'odom'), M @ se3.inverse(ROBOT))


@pytest.mark.parametrize('robot', ['map_to_odom'], indirect=True)
def test_map_to_odom_is_kept_alive_by_a_timer(robot: Robot) -> None:
    robot.publish(TO_BASE.T_base_cam)
    (timer,) = robot.node.timers
    assert timer.timer_period_ns == 50_000_000
    robot.tf.sent.clear()
    robot.late_ns = 10**10  # ten seconds without an image
    timer.callback()
    same(robot.sent('map', 'odom'), se3.inverse(ROBOT))
    assert robot.tf.stamps_ns[-1] == robot.stamp_ns + 10**10 + 10**8


@pytest.mark.parametrize('robot', ['none'], indirect=True)
def test_nothing_is_broadcast_where_that_is_not_wanted(robot: Robot) -> None:
    robot.publish(TO_BASE.T_base_cam)
    assert not robot.tf.sent


@pytest.mark.parametrize('robot', ['odom_to_base', 'map_to_odom', 'none'], indirect=True)
def test_every_message_is_in_the_same_frame_whatever_is_broadcast(robot: Robot) -> None:
    """REP 105. Odometry goes on without a step at a correction, to be fused by another node."""
    T = TO_BASE.T_base_cam
    robot.publish(T)
    robot.outputs.correct(corrected_by(M), EPOCH_NUMBER)
    robot.publish(M @ T @ STEP)
    same(robot.last('_odometry'), TO_BASE.pose(T @ STEP))
    for name in ('_pose', '_with_covariance'):
        same(robot.last(name), TO_BASE.pose(M @ T @ STEP))
    for name, sent in robot.published.items():
        expected = 'odom' if name == '_odometry' else 'map'
        assert {message.header.frame_id for message in sent} == {expected}, name
        if name not in ('_keyframe_poses', '_path'):
            assert [stamp_ns(m.header.stamp) for m in sent] == [10**8, 2 * 10**8], name
    assert {message.child_frame_id for message in robot.published['_odometry']} == {'base'}


def test_the_twist_is_along_the_axes_of_the_base(robot: Robot) -> None:
    """REP 103: x forward, y left, z up; turns to the left are positive, whatever the heading."""
    looking, heading = CameraToBase(LOOKING_FORWARD), se3.exp(np.array([0, 0, 0, 0, 0, 2.0]))
    forward, left = np.array([0, 0, 0.05, 0, 0, 0.0]), np.array([0, 0, 0, 0, -0.02, 0.0])
    T = heading @ LOOKING_FORWARD
    for xi in (np.zeros(6), forward, left):  # of the camera: z forward, y down
        T = T @ se3.exp(xi)
        robot.publish(T, to_base=looking)
    _, ahead, turn = (message.twist.twist for message in robot.published['_odometry'])
    found = [[t.linear.x, t.linear.y, t.linear.z, t.angular.x, t.angular.y, t.angular.z]
             for t in (ahead, turn)]  # fmt: skip
    same(np.array(found), np.array([[0.5, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.2]]))


def test_covariances_are_along_the_axes_that_ros_means(robot: Robot) -> None:
    """Of the pose those of its header, of the twist those of the base."""
    looking = CameraToBase(LOOKING_FORWARD)
    left = se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))  # the base looks along y
    along = np.diag([1e-6, 1e-6, 4e-2, 1e-8, 1e-8, 1e-8])  # the camera's z is open
    for _ in range(2):
        robot.publish(left @ LOOKING_FORWARD, to_base=looking, covariance=along)
    odometry, pose = (robot.published[name][-1] for name in ('_odometry', '_with_covariance'))
    for found in (odometry.pose, pose.pose):
        variances = np.diag(found.covariance.reshape(6, 6))
        assert np.argmax(variances) == 1 and variances[1] == pytest.approx(4e-2)
    variances = np.diag(odometry.twist.covariance.reshape(6, 6))
    assert np.argmax(variances) == 0 and variances[0] == pytest.approx(4e-2 / 0.1**2)


def test_the_velocity_is_as_uncertain_as_the_motion_and_not_as_both_poses(robot: Robot) -> None:
    """Where a corridor leaves the way along it open by a metre, its change is known far better."""
    at_origin = CameraToBase(np.eye(4))
    robot.publish(np.eye(4))
    last = robot.outputs._last
    assert last is not None
    motion = np.diag([1e-4, 4e-4, 9e-4, 1e-6, 4e-6, 9e-6])
    later = replace(last, covariance=np.eye(6), motion_covariance=motion, stamp_ns=2 * 10**8)
    robot.outputs.publish(later, at_origin)
    found = robot.published['_odometry'][-1].twist.covariance.reshape(6, 6)
    np.testing.assert_allclose(found, motion / 0.1**2, rtol=1e-9)
    robot.outputs.publish(replace(later, motion_covariance=None, stamp_ns=3 * 10**8), at_origin)
    unknown = robot.published['_odometry'][-1].twist
    np.testing.assert_array_equal(unknown.covariance.reshape(6, 6), np.eye(6))
    assert unknown.twist.linear.x == 0.0
