# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Subscribes to the sensors that `priors` asks for, and finds where they are."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Imu

from ...core.config.nodes import TrackerSettings
from ...core.config.schema import ConfigError
from ...core.config.stages import PriorsConfig
from ...core.errors import DcgsError
from ...core.priors.motion_priors import MotionPriors
from ...core.priors.readings import BasePose, Reading
from ..messages.robot import read_force, read_odometry, read_rate
from ..transforms import Transforms
from ..transport import sensor_qos
from .extrinsics import WHO_KNOWS, given_extrinsics, known_extrinsics, parse_pose
from .reading_queue import ReadingQueue

_DEPTH = 200  # messages of a sensor that wait: a second of an IMU
# One interval of each, at 200 and 50 Hz; for gravity, by the second, no frame waits.
_REACH_NS = {'gyro': 5_000_000, 'gravity': 1_000_000_000, 'wheels': 20_000_000}
# Where each comes alone, beside the topic of both, and how it is read.
_IMU: dict[str, tuple[str, Callable[[Imu], Reading | None]]] = {
    'gyro': ('gyro/sample', read_rate),
    'gravity': ('accel/sample', read_force),
}
_AGAIN_S = 0.2  # between two questions to TF
_TF_WAIT_S, _TF_POLL_S = 0.02, 0.002  # of a frame, for odometry of its stamp by TF
_LIVELY_NS = 200_000_000  # since the last such odometry: for one that has ended nobody waits


class RobotSensors:
    """What an IMU and wheels measure, for the `priors` of a tracker.

    All but the callbacks and `reasons` belongs to the thread that tracks.
    """

    def __init__(
        self,
        node: Node,
        settings: TrackerSettings,
        transforms: Transforms,
        warn: Callable[[str], None],
    ) -> None:
        """Subscribe; raise `ConfigError` for extrinsics or topics that cannot be used."""
        self.priors = MotionPriors(settings.priors)
        self._settings, self._transforms, self._warn = settings.node, transforms, warn
        self._node = node
        self._camera_to_imu = parse_pose('node.camera_to_imu', settings.node.camera_to_imu)
        self._queue = ReadingQueue(_REACH_NS)
        self._topics: dict[str, list[str]] = {}  # of each sensor
        self._imu_frame = ''
        self._base_frame = settings.node.base_frame
        self._due_s = 0.0  # when TF is asked again
        self._lacks: dict[str, str] = {}  # of sensors whose place is not known: why
        self._said: dict[str, str] = {}
        self._by_tf = settings.priors.wheels and not settings.node.odometry_topic
        self._last_by_tf_ns: int | None = None
        self._listen_to_imu(settings.priors)
        if self._by_tf and settings.node.tf == 'odom_to_base':
            raise ConfigError(
                'node.odometry_topic is empty: odometry is that of TF, which node.tf '
                'odom_to_base broadcasts itself; set node.tf to map_to_odom or none'
            )
        if settings.priors.wheels and not self._by_tf:
            self._base_frame = ''  # as the messages have it
            topic = settings.node.odometry_topic
            self._subscribe(Odometry, topic, self._on_odometry, ['wheels'])

    def _listen_to_imu(self, config: PriorsConfig) -> None:
        """Subscribe to both quantities on one topic, and to each on its own.

        On its own topic the other one is zero.
        """
        wanted = {'gyro': config.needs_gyro, 'gravity': config.gravity}
        sensors = [sensor for sensor in _IMU if wanted[sensor]]
        imu = self._node.resolve_topic_name(self._settings.imu_topic)
        if sensors:
            self._subscribe(Imu, imu, partial(self._on_imu, sensors), sensors)
        for sensor in sensors:
            topic = f'{imu.rpartition("/")[0]}/{_IMU[sensor][0]}'
            self._subscribe(Imu, topic, partial(self._on_imu, [sensor]), [sensor])

    def _subscribe(
        self, type_: type, topic: str, callback: Callable[[Any], None], sensors: list[str]
    ) -> None:
        qos = sensor_qos('best_effort', _DEPTH)  # works with publishers of both kinds
        name = self._node.create_subscription(type_, topic, callback, qos).topic_name
        for sensor in sensors:
            self._topics.setdefault(sensor, []).append(name)

    def _on_imu(self, sensors: list[str], imu: Imu) -> None:
        for sensor in sensors:
            try:
                reading = _IMU[sensor][1](imu)
            except DcgsError as error:
                self._warn(f'imu refused: {error}')
                return
            if reading is not None:
                self._imu_frame = imu.header.frame_id
                self._queue.put(sensor, reading)

    def _on_odometry(self, odometry: Odometry) -> None:
        try:
            pose = read_odometry(odometry)
        except DcgsError as error:
            self._warn(f'odometry refused: {error}')
            return
        self._base_frame = odometry.child_frame_id
        self._queue.put('wheels', pose)

    def sense(self, stamp_ns: int, camera_frame: str) -> None:
        """Give the priors what was measured until a frame; to be called before it is tracked."""
        priors = self.priors
        if priors.unmounted and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _AGAIN_S
            self._mount(camera_frame)
        if self._topics:
            for reading in self._queue.take(stamp_ns):
                priors.sense(reading)
        if self._by_tf:
            pose = self._pose_by_tf(stamp_ns)
            if pose is not None:
                priors.sense(pose)
        self._said = priors.reasons(stamp_ns) | self._lacks

    def _pose_by_tf(self, stamp_ns: int) -> BasePose | None:
        """Return the pose at a stamp, which is waited for a moment if there were some of late."""
        settings, last_ns, end_s = self._settings, self._last_by_tf_ns, 0.0
        if last_ns is not None and stamp_ns - last_ns < _LIVELY_NS:
            end_s = time.monotonic() + _TF_WAIT_S
        frames = settings.odom_frame, settings.base_frame
        while (T := self._transforms.lookup(*frames, stamp_ns)) is None:
            if time.monotonic() >= end_s:
                return None
            time.sleep(_TF_POLL_S)
        self._last_by_tf_ns = stamp_ns
        return BasePose(stamp_ns, T)

    def _mount(self, camera_frame: str) -> None:
        """Look for where the sensors are that have sent something."""
        missing, priors = self.priors.unmounted, self.priors
        if missing.keys() & _IMU.keys() and (self._imu_frame or self._camera_to_imu is not None):
            T_cam_imu = self._camera_to_imu
            if T_cam_imu is None:
                T_cam_imu = self._transforms.lookup(camera_frame, self._imu_frame)
            if T_cam_imu is not None:
                priors.mount(R_cam_imu=T_cam_imu[:3, :3])
        if missing.keys() & {'wheels', 'planar'} and self._base_frame:
            T_base_cam = self._find_base(camera_frame)
            if T_base_cam is not None:
                priors.mount(T_base_cam=T_base_cam)
        self._lacks = {name: self._why(name, camera_frame) for name in priors.unmounted}

    def _find_base(self, camera_frame: str) -> NDArray[np.float64] | None:
        """Return T_base_cam (4, 4) of the base that moves as the wheels say."""
        settings, base = self._settings, self._base_frame
        if base == settings.base_frame:
            return known_extrinsics(settings, self._transforms, camera_frame)
        given = given_extrinsics(settings)
        if given is None:
            return self._transforms.lookup(base, camera_frame)
        T = self._transforms.lookup(base, settings.base_frame)
        return None if T is None else T @ given

    def _why(self, sensor: str, camera_frame: str) -> str:
        """Return what is missing of a sensor whose place is not known."""
        inertial = sensor in _IMU
        frame = self._imu_frame if inertial else self._base_frame
        if not frame:
            return 'no reading yet, or none that names its frame'
        key = 'camera_to_imu' if inertial else 'base_to_camera'
        return (
            f'no TF from {frame} to {camera_frame}, so that it is not known where it is: '
            f'{WHO_KNOWS}, or set node.{key}'
        )

    def reasons(self) -> dict[str, str]:
        """Return for each prior 'used', or why it was not with the last frame; from any thread."""
        said = dict(self._said)
        for sensor, topics in self._topics.items():
            silent = said.get(sensor, '').startswith('no ')
            if silent and not any(map(self._node.count_publishers, topics)):
                said[sensor] += f'; nobody publishes {" or ".join(topics)}'
        return said
