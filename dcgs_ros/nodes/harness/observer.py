# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A node that watches the others in a domain, for tests, the demo and benchmarks."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_srvs.srv import Trigger

from ...core.trajectory import Trajectory
from ...io.ros_images import stamp_ns
from ..messages.clouds import KEYFRAME_POSE, MAP_GAUSSIAN, read_cloud
from ..messages.maps import UPDATES_KEPT
from ..messages.poses import matrix
from ..tracking.map_mirror import MapMirror
from ..transport import RELIABLE, latched, prepare, sensor_qos

_END_S = 20.0
_POLL_S = 0.02


class Observer:
    """Watches the topics of tracker and mapper, under their default names, in its own thread."""

    def __init__(
        self,
        domain: int,
        with_map: bool = False,
        discovery: str = 'LOCALHOST',
        namespace: str = '',
    ) -> None:
        """Subscribe; to the map only on request, since that takes time."""
        self.poses: dict[int, NDArray[np.float64]] = {}  # T_map_base (4, 4) by stamp
        self.came_s: dict[int, float] = {}  # monotonic
        self.sent_s: dict[int, float] = {}  # of camera_info
        self.came = self.sent = 0  # odometries and camera_infos, repetitions counted
        self.status: dict[str, tuple[int, str, dict[str, str]]] = {}
        self.history: list[tuple[float, str, int, str]] = []
        self.mirror = MapMirror()
        self.keyframes = np.zeros(0, KEYFRAME_POSE)
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = discovery
        prepare()
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node('observer', context=self._context, namespace=namespace)
        subscribe = self.node.create_subscription
        info = 'camera/camera/color/camera_info'
        subscribe(Odometry, 'dcgs_tracker/odometry', self._on_odometry, RELIABLE)
        subscribe(PoseStamped, 'dcgs_tracker/pose', self._on_pose, RELIABLE)
        subscribe(CameraInfo, info, self._on_info, sensor_qos('best_effort'))
        subscribe(DiagnosticArray, '/diagnostics', self._on_status, RELIABLE)
        subscribe(PointCloud2, 'keyframe/received', self._on_keyframes, latched(1))
        if with_map:
            subscribe(PointCloud2, 'gaussian_map', self._on_map, latched(1))
            subscribe(PointCloud2, 'gaussian_map_updates', self._on_update, latched(UPDATES_KEPT))
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            pass

    def _on_odometry(self, message: Odometry) -> None:
        self.came += 1
        self.came_s[stamp_ns(message.header.stamp)] = time.monotonic()

    def _on_pose(self, message: PoseStamped) -> None:
        self.poses[stamp_ns(message.header.stamp)] = matrix(message.pose)

    def _on_info(self, message: CameraInfo) -> None:
        self.sent += 1
        self.sent_s[stamp_ns(message.header.stamp)] = time.monotonic()

    def _on_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level, name = status.level[0], status.name.split(':')[0]
            values = {value.key: value.value for value in status.values}
            self.status[name] = level, status.message, values
            self.history.append((time.monotonic(), name, level, status.message))

    def _on_keyframes(self, cloud: PointCloud2) -> None:
        self.keyframes = read_cloud(cloud, KEYFRAME_POSE)

    def _on_map(self, cloud: PointCloud2) -> None:
        self.mirror.whole(stamp_ns(cloud.header.stamp), read_cloud(cloud, MAP_GAUSSIAN))

    def _on_update(self, cloud: PointCloud2) -> None:
        self.mirror.update(stamp_ns(cloud.header.stamp), read_cloud(cloud, MAP_GAUSSIAN))

    def value(self, node: str, key: str) -> float:
        """Return a figure of a node's last diagnostics, 0 where it is absent."""
        return float(self.status.get(node, (0, '', {}))[2].get(key, 0))

    def latencies_ms(self) -> NDArray[np.float64]:
        """Return the times (N,) from a frame's camera_info to its odometry, milliseconds."""
        both = self.sent_s.keys() & self.came_s.keys()
        times = ((self.sent_s[k], self.came_s[k]) for k in sorted(both))
        return np.array([1e3 * (came - sent) for sent, came in times if came >= sent])

    def trajectory(self) -> Trajectory:
        """Return the poses so far, in order of their stamps."""
        stamps = sorted(self.poses)
        return Trajectory(np.array(stamps), np.array([self.poses[k] for k in stamps]))

    def call(self, service: str, timeout_s: float = 30.0) -> Any:
        """Call a Trigger service; return its response."""
        client = self.node.create_client(Trigger, service)
        if not client.wait_for_service(timeout_s):
            raise TimeoutError(f'{service}: no such service after {timeout_s:g} s')
        future = client.call_async(Trigger.Request())
        wait_until(future.done, timeout_s, service)
        return future.result()

    def ready(self, node: str) -> bool:
        """Return whether a node has reported that its kernels are loaded."""
        return node in self.status and 'loading' not in self.status[node][1]

    def close(self) -> None:
        """End the thread."""
        self._context.try_shutdown()
        self._thread.join(_END_S)


def wait_until(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    """Wait for a condition; raise `TimeoutError` with `what` it is."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f'{what}: not within {timeout_s:g} s')
        time.sleep(_POLL_S)
