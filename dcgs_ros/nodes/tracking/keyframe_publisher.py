# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Publishes keyframes for the mapper."""

from __future__ import annotations

from rclpy.node import Node

from ..messages.keyframes import TOPICS, write_keyframe
from ..messages.packet import KeyframePacket
from ..transport import RELIABLE


class KeyframePublisher:
    """The `KeyframeTransport` over ROS topics."""

    def __init__(self, node: Node, world: str) -> None:
        """Advertise `keyframe/*`; poses are in the frame `world`."""
        self._world = world
        self._publishers = {
            name: node.create_publisher(kind, f'keyframe/{name}', RELIABLE)
            for name, kind in TOPICS.items()
        }

    def connected(self) -> bool:
        """Return whether a mapper listens to every topic."""
        return all(p.get_subscription_count() > 0 for p in self._publishers.values())

    def send(self, packet: KeyframePacket) -> None:
        """Publish a packet, a message on each topic."""
        for name, message in write_keyframe(packet, self._world).items():
            self._publishers[name].publish(message)
