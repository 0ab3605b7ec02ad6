# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker's side of its link to the mapper."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from ...io.ros_images import MessageError, stamp_ns
from ..messages.clouds import KEYFRAME_POSE, MAP_GAUSSIAN, read_cloud
from ..messages.keyframes import TOPICS, write_keyframe
from ..messages.maps import UPDATES_KEPT, read_poses, read_stamps
from ..transport import RELIABLE, latched
from .keyframe_sender import KeyframePacket
from .map_mirror import MapMirror, Resumable

_SETTLE_S = 0.3  # after the whole map: its updates come on another topic


class KeyframePublisher:
    """Publishes keyframes; at the start finds out whether a mapper has a map to go on in."""

    def __init__(self, node: Node, world: str) -> None:
        """Advertise, and listen for a map."""
        self._node, self._world = node, world
        self.camera_frame = ''
        self._publishers = {
            name: node.create_publisher(kind, f'keyframe/{name}', RELIABLE)
            for name, kind in TOPICS.items()
        }
        self._mirror = MapMirror()
        self._keyframes: PointCloud2 | None = None
        self._came = threading.Event()
        on = node.create_subscription
        self._listening = [
            on(PointCloud2, 'gaussian_map', self._on_map, latched(1)),
            on(PointCloud2, 'gaussian_map_updates', self._on_update, latched(UPDATES_KEPT)),
            on(PointCloud2, 'dcgs_mapper/keyframes', self._on_keyframes, latched(1)),
        ]

    def connected(self) -> bool:
        """Tell whether a mapper listens to every topic."""
        return all(p.get_subscription_count() > 0 for p in self._publishers.values())

    def send(self, offer: KeyframePacket) -> None:
        """Publish a keyframe."""
        for name, message in write_keyframe(offer, self._world, self.camera_frame).items():
            self._publishers[name].publish(message)

    def resumable(self, wait_s: float) -> Resumable | None:
        """Wait for a map with Gaussians of a tracker; then listen no longer."""
        end = time.monotonic() + wait_s
        if self._came.wait(wait_s):
            time.sleep(min(_SETTLE_S, max(0.0, end - time.monotonic())))
        for subscription in self._listening:
            self._node.destroy_subscription(subscription)
        rows, keyframes = self._mirror.rows, self._keyframes
        if rows is None or keyframes is None:
            return None
        try:
            visited = read_cloud(keyframes, KEYFRAME_POSE)
            return Resumable.of(rows, read_poses(visited), read_stamps(visited))
        except MessageError as error:
            self._node.get_logger().warning(f'map of the mapper refused: {error}')
            return None

    def _on_map(self, cloud: PointCloud2) -> None:
        self._taken(self._mirror.whole, cloud)
        self._look()

    def _on_update(self, cloud: PointCloud2) -> None:
        self._taken(self._mirror.update, cloud)

    def _taken(self, take: Callable[[int, NDArray], None], cloud: PointCloud2) -> None:
        try:
            take(stamp_ns(cloud.header.stamp), read_cloud(cloud, MAP_GAUSSIAN))
        except MessageError as error:
            self._node.get_logger().warning(f'map of the mapper refused: {error}')

    def _on_keyframes(self, cloud: PointCloud2) -> None:
        self._keyframes = cloud
        self._look()

    def _look(self) -> None:
        """Tell who waits that there is a map, and the keyframes that it came from."""
        rows, keyframes = self._mirror.rows, self._keyframes
        if rows is not None and len(rows) and keyframes is not None and keyframes.width:
            self._came.set()
