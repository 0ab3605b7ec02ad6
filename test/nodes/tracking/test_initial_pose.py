# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A pose that somebody points at becomes a place of the camera, once, or is refused in words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

from rclpy.node import Node

from dcgs_ros.core import se3
from dcgs_ros.nodes.messages.images import header
from dcgs_ros.nodes.messages.odometry import CameraToBase, pose_with_covariance
from dcgs_ros.nodes.tracking.initial_pose import InitialPose

EXACT = 1e-9
TO_BASE = CameraToBase(se3.exp(np.array([0.1, 0.0, 0.2, 0.3, -1.2, 0.4])))
T_MAP_BASE = se3.exp(np.array([3.0, -1.0, 0.0, 0.0, 0.0, 2.0]))
RVIZ = np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 0.0685])


class Pointed:
    def __init__(self, node: Node) -> None:
        self.warnings: list[str] = []
        self.pose = InitialPose(node, 'map', self.warnings.append)
        (self._subscription,) = [s for s in node.subscriptions if 'initialpose' in s.topic_name]
        self.topic = self._subscription.topic_name

    def at(self, frame: str = 'map', covariance: Any = RVIZ) -> None:
        self._subscription.callback(pose_with_covariance(header(0, frame), T_MAP_BASE, covariance))


@pytest.fixture
def pointed(ros: None) -> Iterator[Pointed]:
    node = Node('eye', namespace='robot1')
    yield Pointed(node)
    node.destroy_node()


def test_it_is_where_the_camera_is_on_the_base_and_as_sure(pointed: Pointed) -> None:
    assert pointed.topic == '/robot1/initialpose'
    assert pointed.pose.take(TO_BASE) is None
    pointed.at()
    place = pointed.pose.take(TO_BASE)
    assert place is not None and pointed.pose.take(TO_BASE) is None
    np.testing.assert_allclose(TO_BASE.pose(place.T_world_cam), T_MAP_BASE, atol=EXACT)
    np.testing.assert_allclose(TO_BASE.covariance(place.covariance, T_MAP_BASE), RVIZ, atol=EXACT)
    assert not pointed.warnings


@pytest.mark.parametrize(
    ('given', 'said'),
    [({'frame': 'odom'}, "'odom', not in 'map'"), ({'covariance': -RVIZ}, 'covariance is none')],
)
def test_what_cannot_be_used_is_said(pointed: Pointed, given: dict[str, Any], said: str) -> None:
    pointed.at(**given)
    assert pointed.pose.take(TO_BASE) is None
    assert said in pointed.warnings[0]
