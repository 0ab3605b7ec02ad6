# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Transforms as poses and back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, TransformStamped
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message

from dcgs_ros.core import se3
from dcgs_ros.io.ros_images import MessageError
from dcgs_ros.nodes.messages.images import header
from dcgs_ros.nodes.messages.poses import (
    matrix,
    path,
    pose_message,
    pose_stamped,
    transform_stamped,
)

HEADER = header(3, 'odom')
ROUNDING = 1e-12
# Turns from none over tiny ones to half a revolution, where q and -q meet.
ANGLES = st.sampled_from([0.0, 1e-9, 1e-3, 1.0, math.pi - 1e-9, math.pi])


@st.composite
def transforms(draw: st.DrawFn) -> NDArray[np.float64]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    axis = rng.normal(size=3)
    T = se3.exp(np.concatenate([np.zeros(3), draw(ANGLES) * axis / np.linalg.norm(axis)]))
    T[:3, 3] = rng.normal(scale=10.0, size=3)
    return T


@settings(max_examples=60)
@given(transforms())
def test_a_pose_survives_the_wire(T: NDArray[np.float64]) -> None:
    sent = pose_stamped(T, HEADER)
    got = deserialize_message(serialize_message(sent), PoseStamped)
    np.testing.assert_allclose(matrix(got.pose), T, rtol=0, atol=ROUNDING)
    assert got.header == HEADER and got.pose.orientation.w >= 0


@settings(max_examples=60)
@given(transforms())
def test_a_transform_has_the_numbers_of_the_pose(T: NDArray[np.float64]) -> None:
    sent = transform_stamped(T, HEADER, 'camera')
    got = deserialize_message(serialize_message(sent), TransformStamped)
    move, pose = got.transform, pose_message(T)
    assert (move.translation.x, move.translation.y, move.translation.z) == tuple(T[:3, 3])
    assert move.rotation == pose.orientation
    assert got.header == HEADER and got.child_frame_id == 'camera'


def test_a_quarter_turn_about_z() -> None:
    half = math.sqrt(0.5)
    pose = Pose(
        position=Point(x=1.0, y=2.0, z=3.0), orientation=Quaternion(x=0.0, y=0.0, z=half, w=half)
    )
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(matrix(pose), expected, atol=ROUNDING)


@settings(max_examples=60)
@given(transforms(), st.floats(1e-3, 1e200), st.sampled_from([-1, 1]))
def test_neither_length_nor_sign_of_a_quaternion_matters(
    T: NDArray[np.float64], length: float, sign: int
) -> None:
    pose = pose_message(T)
    q = pose.orientation
    q.x, q.y, q.z, q.w = (sign * length * value for value in (q.x, q.y, q.z, q.w))
    np.testing.assert_allclose(matrix(pose), T, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize('field', ['position.y', 'orientation.z'])
def test_a_pose_that_is_not_finite_is_refused(field: str, bad: float) -> None:
    pose = pose_message(np.eye(4))
    part, _, name = field.partition('.')
    setattr(getattr(pose, part), name, bad)
    with pytest.raises(MessageError, match=rf'{bad}.* are not a pose'):
        matrix(pose)


def test_infinities_that_cancel_and_lengths_that_overflow_are_refused_too() -> None:
    for position in ((math.inf, -math.inf, 0.0), (1.7e308, 1.7e308, 0.0)):
        pose = pose_message(np.eye(4))
        pose.position.x, pose.position.y, pose.position.z = position
        with pytest.raises(MessageError, match='are not a pose'):
            matrix(pose)


@pytest.mark.parametrize('w', [0.0, 1e-7])
def test_a_quaternion_that_nobody_filled_in_is_refused(w: float) -> None:
    pose = Pose(orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=w))
    with pytest.raises(MessageError, match='quaternion wxyz'):
        matrix(pose)


def test_a_path_holds_its_poses_in_order() -> None:
    poses = []
    for k in range(3):
        T = np.eye(4)
        T[0, 3] = k
        poses.append(pose_stamped(T, header(k, 'odom')))
    got = deserialize_message(serialize_message(path(tuple(poses), HEADER)), Path)
    assert got.poses == poses and got.header == HEADER
