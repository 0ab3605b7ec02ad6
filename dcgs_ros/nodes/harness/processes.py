# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The nodes as processes of one's own, and somebody who watches them: for the demo and tests."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_srvs.srv import Trigger

from ...core.config.schema import flatten
from ...core.sensor import SensorNoise
from ...core.trajectory import Trajectory
from ...io.ros_images import stamp_ns
from ..messages.clouds import KEYFRAME_POSE, MAP_GAUSSIAN, read_cloud
from ..messages.maps import UPDATES_KEPT
from ..messages.poses import matrix
from ..tracking.map_mirror import MapMirror
from ..transport import RELIABLE, latched, prepare, sensor_qos

_START = 'import sys; from dcgs_ros.nodes.{} import main; sys.exit(main())'
_DOMAINS = 101  # those whose ports are free on every Linux
_END_S = 20.0
_LEAVE_S = 5.0
_POLL_S = 0.02


class Processes:
    """Starts nodes in a domain of their own, on this host only; ends those that are left."""

    def __init__(self, logs: Path, discovery: str = 'LOCALHOST') -> None:
        """Write logs, a file a node, into `logs`; `discovery` SUBNET lets it be several hosts."""
        self._claim, self.domain = _claim_domain()
        self._logs = logs
        self._running: list[subprocess.Popen[bytes]] = []
        prepare()
        self._environment = os.environ | {
            'ROS_AUTOMATIC_DISCOVERY_RANGE': discovery,
            'ROS_DOMAIN_ID': str(self.domain),
            'ROS_LOG_DIR': str(logs),
        }

    def start(
        self,
        name: str,
        parameters: Mapping[str, Any] | None = None,
        file: Path | None = None,
        prefix: tuple[str, ...] = (),
    ) -> subprocess.Popen[bytes]:
        """Start a node: tracker, mapper or replay."""
        command = [*prefix, sys.executable, '-c', _START.format(name), '--ros-args']
        if file is not None:
            command += ['--params-file', str(file)]
        for key, value in (parameters or {}).items():
            command += ['-p', f'{key}:={_yaml(value)}']
        with open(self._logs / f'{name}-{len(self._running)}.log', 'wb') as log:
            process = subprocess.Popen(
                command, env=self._environment, stdout=log, stderr=subprocess.STDOUT
            )
        self._running.append(process)
        return process

    def stop(self, process: subprocess.Popen[bytes], number: int = signal.SIGINT) -> int:
        """End a process by a signal; returns its status."""
        process.send_signal(number)
        return process.wait(_END_S)

    def __enter__(self) -> Processes:
        """Begin."""
        return self

    def __exit__(self, *_: object) -> None:
        """End what still runs; by force, which leaves files in /dev/shm, only what stays."""
        left = [process for process in self._running if process.poll() is None]
        for process in left:
            process.send_signal(signal.SIGINT)
        end_s = time.monotonic() + _LEAVE_S
        for process in left:
            try:
                process.wait(max(end_s - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._claim.close()


class Observer:
    """Watches the topics of the nodes in a thread of its own."""

    def __init__(self, domain: int, with_map: bool = False, discovery: str = 'LOCALHOST') -> None:
        """Listen; with the map only where that is wanted, since it takes time."""
        self.poses: dict[int, np.ndarray] = {}  # T_odom_base by stamp
        self.came_s: dict[int, float] = {}  # monotonic
        self.sent_s: dict[int, float] = {}  # of camera_info
        self.came = self.sent = 0  # odometries and camera_infos; of a loop each time
        self.status: dict[str, tuple[int, str, dict[str, str]]] = {}
        self.history: list[tuple[float, str, int, str]] = []
        self.mirror = MapMirror()
        self.keyframes = np.zeros(0, KEYFRAME_POSE)
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = discovery
        prepare()
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node('observer', context=self._context)
        on = self.node.create_subscription
        info = '/camera/camera/color/camera_info'
        on(Odometry, 'dcgs_tracker/odometry', self._on_odometry, RELIABLE)
        on(CameraInfo, info, self._on_info, sensor_qos('best_effort'))
        on(DiagnosticArray, '/diagnostics', self._on_status, RELIABLE)
        on(PointCloud2, 'dcgs_mapper/keyframes', self._on_keyframes, latched(1))
        if with_map:
            on(PointCloud2, 'gaussian_map', self._on_map, latched(1))
            on(PointCloud2, 'gaussian_map_updates', self._on_update, latched(UPDATES_KEPT))
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
        stamp = stamp_ns(message.header.stamp)
        self.came += 1
        self.came_s[stamp] = time.monotonic()
        self.poses[stamp] = matrix(message.pose.pose)

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
        """Figure of a node's last diagnostics; 0 where it is not told."""
        return float(self.status.get(node, (0, '', {}))[2].get(key, 0))

    def latencies_ms(self) -> np.ndarray:
        """Measure from a frame's camera_info to its odometry, milliseconds."""
        both = self.sent_s.keys() & self.came_s.keys()
        times = ((self.sent_s[k], self.came_s[k]) for k in sorted(both))
        return np.array([1e3 * (came - sent) for sent, came in times if came >= sent])

    def trajectory(self) -> Trajectory:
        """Poses so far, in order of their stamps."""
        stamps = sorted(self.poses)
        return Trajectory(np.array(stamps), np.array([self.poses[k] for k in stamps]))

    def call(self, service: str, timeout_s: float = 30.0) -> Any:
        """Call a Trigger; returns its response."""
        client = self.node.create_client(Trigger, service)
        if not client.wait_for_service(timeout_s):
            raise TimeoutError(f'{service} is not there after {timeout_s:g} s')
        future = client.call_async(Trigger.Request())
        wait_until(future.done, timeout_s, service)
        return future.result()

    def ready(self, node: str) -> bool:
        """Tell whether a node has reported, and its kernels are loaded."""
        return node in self.status and 'loading' not in self.status[node][1]

    def close(self) -> None:
        """End."""
        self._context.try_shutdown()
        self._thread.join(_END_S)


def wait_until(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    """Wait for something; raises `TimeoutError` naming it."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f'{what}: not within {timeout_s:g} s')
        time.sleep(_POLL_S)


def sensor_parameters(sensor: SensorNoise) -> dict[str, Any]:
    """Parameters that tell tracker and mapper of a sequence's sensor."""
    return {f'sensor.{key}': value for key, value in flatten(sensor).items()}


def _claim_domain() -> tuple[socket.socket, int]:
    """Choose a ROS domain that no other session of this host has: they would hear each other.

    It is taken while the socket is open.
    """
    for domain in random.SystemRandom().sample(range(_DOMAINS), _DOMAINS):
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f'\0dcgs-ros-domain-{domain}')
        except OSError:
            claim.close()
        else:
            return claim, domain
    raise OSError(f'all of {_DOMAINS} ROS domains are taken')


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)
