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

from dcgs_ros.core import se3
from dcgs_ros.core.config.nodes import TrackerNodeSettings
from dcgs_ros.core.keyframe import Correction
from dcgs_ros.core.tracking.result import Reference, TrackingState, TrackResult
from dcgs_ros.core.tracking.visited import origin
from dcgs_ros.nodes.messages.corrections import read_correction
from dcgs_ros.nodes.messages.ids import first_epoch
from dcgs_ros.nodes.messages.odometry import CameraToBase
from dcgs_ros.nodes.messages.poses import matrix
from dcgs_ros.nodes.tracking import outputs as module
from dcgs_ros.nodes.tracking.corrected import Corrected
from dcgs_ros.nodes.tracking.outputs import TrackerOutputs

EXACT = 1e-9
TO_BASE = CameraToBase(se3.exp(np.array([0.1, 0.0, 0.2, 0.3, -1.2, 0.4])))
STEP = se3.exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.01]))
M = se3.exp(np.array([0.4, -0.2, 0.1, 0.0, 0.3, 0.1]))
ROBOT = se3.exp(np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.5]))  # odom -> base of wheel odometry
EPOCH_NUMBER = first_epoch()


class Tf:
    listens = True

    def __init__(self) -> None:
        self.sent: list[tuple[str, str, NDArray[np.float64]]] = []
        self.known: NDArray[np.float64] | None = ROBOT

    def send(self, transform: Any) -> None:
        t, q = transform.transform.translation, transform.transform.rotation
        T = se3.from_quaternion(np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z]))
        self.sent.append((transform.header.frame_id, transform.child_frame_id, T))

    def lookup(self, parent: str, child: str) -> NDArray[np.float64] | None:
        return self.known


class Robot:
    """Outputs of a tracker, and what they published."""

    def __init__(self, node: Node, tf: Tf, setting: str) -> None:
        settings = TrackerNodeSettings(base_frame='base', tf=setting)  # type: ignore[arg-type]
        self.tf, self.outputs = tf, TrackerOutputs(node, settings, print)
        self.published: dict[str, list[Any]] = {}
        for name in ('_odometry', '_pose', '_with_covariance', '_camera_pose', '_keyframe_poses'):
            messages = self.published[name] = []
            setattr(self.outputs, name, SimpleNamespace(publish=messages.append))
        self.outputs._path = SimpleNamespace(  # type: ignore[assignment]
            publish=self.published.setdefault('_path', []).append, get_subscription_count=lambda: 1
        )
        self._count = 0

    def publish(self, T: NDArray[np.float64], submap: int = 0, keyframe: int = 0) -> None:
        self._count += 1
        self.tf.sent.clear()
        result = TrackResult(
            10**8 * self._count, T, np.eye(4), 1e-6 * np.eye(6), 1e-4 * np.eye(6),
            TrackingState.OK, None, 0, 0, 0, False, (), 0.0,
            Reference(keyframe, np.eye(4), submap, 7, 0, np.eye(4)), 2e-6 * np.eye(6),
        )  # fmt: skip
        self.outputs._path_due_s = 0.0
        self.outputs.publish(result, TO_BASE)

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
    same(robot.last('_odometry'), TO_BASE.pose(T @ STEP))
    for name in ('_pose', '_with_covariance'):
        same(robot.last(name), TO_BASE.pose(M @ T @ STEP))
    frames = {name: [m.header.frame_id for m in sent] for name, sent in robot.published.items()}
    assert set(frames['_odometry']) == {'odom'}
    for name in ('_pose', '_with_covariance', '_camera_pose', '_path', '_keyframe_poses'):
        assert set(frames[name]) == {'map'}, name
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
    assert robot.published['_odometry'][-1].header.frame_id == 'map'  # odom is another's
    same(robot.last('_odometry'), TO_BASE.pose(T @ STEP))


@pytest.mark.parametrize('robot', ['none'], indirect=True)
def test_nothing_is_broadcast_where_that_is_not_wanted(robot: Robot) -> None:
    robot.publish(TO_BASE.T_base_cam)
    assert not robot.tf.sent


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
