# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Subscribes to what the mapper tells the tracker: answers, what it received, and its map."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from typing import Any

from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from ...core.keyframe import MapUpdate
from ...io.ros_images import MessageError, stamp_ns
from ..messages.clouds import KEYFRAME_POSE, MAP_GAUSSIAN, read_cloud
from ..messages.keyframes import read_answer
from ..messages.maps import UPDATES_KEPT, read_poses, read_stamps
from ..transport import RELIABLE, latched
from .map_mirror import MapMirror, Resumable

_SETTLE_S = 0.3  # after the whole map, for its updates, which come on another topic


class MapperSubscriber:
    """Passes on the mapper's answers; at the start finds out whether it has a map to go on in."""

    def __init__(
        self,
        node: Node,
        on_answer: Callable[[MapUpdate, int], object],
        on_received: Callable[[Collection[int]], object],
        warn: Callable[[str], None],
    ) -> None:
        """Subscribe.

        `on_answer` gets an update and its epoch, `on_received` the stamps of all keyframes that
        the mapper has.
        """
        self._node, self._warn = node, warn
        self._pass_answer, self._pass_received = on_answer, on_received
        self._mirror = MapMirror()
        self._keyframes: NDArray[Any] | None = None  # KEYFRAME_POSE rows, as received last
        self._complete = threading.Event()
        subscribe = node.create_subscription
        subscribe(PointCloud2, 'keyframe/answer', self._on_answer, RELIABLE)
        subscribe(PointCloud2, 'keyframe/received', self._on_received, latched(1))
        self._has_rival = False  # another tracker that lives
        self._map_subscriptions = [
            subscribe(PointCloud2, 'gaussian_map', self._on_map, latched(1)),
            subscribe(PointCloud2, 'gaussian_map_updates', self._on_update, latched(UPDATES_KEPT)),
            subscribe(PoseStamped, 'camera_pose', self._on_pose, RELIABLE),
        ]

    def resumable(self, wait_s: float) -> Resumable | None:
        """Wait for a map with Gaussians of a tracker that has gone; then no longer subscribe."""
        end = time.monotonic() + wait_s
        if self._complete.wait(wait_s):
            time.sleep(min(_SETTLE_S, max(0.0, end - time.monotonic())))
        for subscription in self._map_subscriptions:
            self._node.destroy_subscription(subscription)
        rows, keyframes = self._mirror.rows, self._keyframes
        if rows is None or keyframes is None:
            return None
        if self._has_rival:
            self._warn('another tracker is at work here: give each robot its own namespace')
            return None
        try:
            submaps = keyframes['submap'].tolist()
            return Resumable.of(rows, read_poses(keyframes), read_stamps(keyframes), submaps)
        except MessageError as error:
            self._warn(f'map of the mapper refused: {error}')
            return None

    def _on_answer(self, cloud: PointCloud2) -> None:
        try:
            epoch, update = read_answer(cloud)
        except MessageError as error:
            self._warn(f'answer of the mapper refused: {error}')
            return
        self._pass_answer(update, epoch)

    def _on_received(self, cloud: PointCloud2) -> None:
        try:
            self._keyframes = read_cloud(cloud, KEYFRAME_POSE)
        except MessageError as error:
            self._warn(f'keyframes of the mapper refused: {error}')
            return
        self._check_complete()
        self._pass_received(read_stamps(self._keyframes))

    def _on_pose(self, _: PoseStamped) -> None:
        self._has_rival = True

    def _on_map(self, cloud: PointCloud2) -> None:
        self._take(self._mirror.whole, cloud)
        self._check_complete()

    def _on_update(self, cloud: PointCloud2) -> None:
        self._take(self._mirror.update, cloud)

    def _take(self, take: Callable[[int, NDArray[Any]], None], cloud: PointCloud2) -> None:
        try:
            take(stamp_ns(cloud.header.stamp), read_cloud(cloud, MAP_GAUSSIAN))
        except MessageError as error:
            self._warn(f'map of the mapper refused: {error}')

    def _check_complete(self) -> None:
        """End the wait once there are Gaussians and the keyframes that they came from."""
        rows, keyframes = self._mirror.rows, self._keyframes
        if rows is not None and len(rows) and keyframes is not None and len(keyframes):
            self._complete.set()
