# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Depth as points for nav2: in the camera's frame, with the pose's stamp, only if wanted."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.nodes.messages.clouds import POINT, read_cloud
from dcgs_ros.nodes.tracking.live_points import LivePoints

HANGS_S = 60.0
CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 32.0, 24.0)
SECOND = 1_000_000_000
DEPTH_M = np.full((48, 64), 1.5, np.float32)
FRAME = RgbdFrame(3 * SECOND, 3 * SECOND, np.zeros((48, 64), np.uint8), DEPTH_M)


class Eye:
    """A tracker that counts how often its depth is asked for."""

    camera, config = CAMERA, Config()

    def __init__(self) -> None:
        self.asked = 0

    def corrected(self, frame: RgbdFrame) -> RgbdFrame:
        self.asked += 1
        return frame


def test_points_come_to_who_subscribes_and_cost_nothing_before(ros: None) -> None:
    """Nav2's layers subscribe as to any sensor; TF places the cloud by its stamp."""
    node, planner = Node('eye'), Node('planner')
    try:
        points, eye, clouds = LivePoints(node, 30.0), Eye(), list[PointCloud2]()
        result: Any = SimpleNamespace(T_cam_cam_at_depth=np.eye(4))
        points.publish(FRAME, result, eye, 'optical')  # type: ignore[arg-type]
        assert eye.asked == 0
        planner.create_subscription(
            PointCloud2, '/eye/points', clouds.append, qos_profile_sensor_data
        )
        end = time.monotonic() + HANGS_S
        while not clouds:
            assert time.monotonic() < end
            points.publish(FRAME, result, eye, 'optical')  # type: ignore[arg-type]
            rclpy.spin_once(planner, timeout_sec=0.01)
        cloud = clouds[0]
        assert (cloud.header.frame_id, cloud.header.stamp.sec) == ('optical', 3)
        assert [field.name for field in cloud.fields] == ['x', 'y', 'z']
        assert (read_cloud(cloud, POINT)['z'] == 1.5).all()
        silent, asked = LivePoints(node, 0.0), eye.asked
        silent.publish(FRAME, result, eye, 'optical')  # type: ignore[arg-type]
        assert eye.asked == asked
    finally:
        node.destroy_node()
        planner.destroy_node()
