# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""TF, where it is installed: tf2_ros comes with ROS, not with the wheels on PyPI."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time

from ..core import se3


class Transforms(Protocol):
    """What the nodes need of TF."""

    listens: bool  # whether a transform that is not known may still come

    def send(self, transform: TransformStamped) -> None:
        """Broadcast a transform that holds at its stamp."""
        ...

    def send_static(self, transforms: list[TransformStamped]) -> None:
        """Broadcast transforms that always hold."""
        ...

    def lookup(
        self, parent: str, child: str, stamp_ns: int | None = None
    ) -> NDArray[np.float64] | None:
        """Return T_parent_child (4, 4), metres, at a stamp, else the latest; None: not known."""
        ...


class NoTransforms:
    """Replaces TF without tf2_ros: sends nothing and knows nothing."""

    listens = False

    def __init__(self, node: Node) -> None:
        """Warn."""
        node.get_logger().warning('tf2_ros is not installed: TF is neither broadcast nor read')

    def send(self, transform: TransformStamped) -> None:
        """Do nothing."""

    def send_static(self, transforms: list[TransformStamped]) -> None:
        """Do nothing."""

    def lookup(
        self, parent: str, child: str, stamp_ns: int | None = None
    ) -> NDArray[np.float64] | None:
        """Return None."""
        return None


class Tf2Transforms:
    """TF by tf2_ros."""

    listens = True

    def __init__(self, node: Node) -> None:
        """Listen and broadcast as `node`; raises `ImportError` without tf2_ros."""
        import tf2_ros

        self._unknown = tf2_ros.TransformException
        self._broadcaster = tf2_ros.TransformBroadcaster(node)
        self._static_broadcaster = tf2_ros.StaticTransformBroadcaster(node)
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def send(self, transform: TransformStamped) -> None:
        """Broadcast on /tf."""
        self._broadcaster.sendTransform(transform)

    def send_static(self, transforms: list[TransformStamped]) -> None:
        """Broadcast on /tf_static, which late subscribers get too."""
        self._static_broadcaster.sendTransform(transforms)

    def lookup(
        self, parent: str, child: str, stamp_ns: int | None = None
    ) -> NDArray[np.float64] | None:
        """Return the transform at a stamp, interpolated, or the latest, without waiting."""
        time = Time() if stamp_ns is None else Time(nanoseconds=stamp_ns)
        try:
            found = self._buffer.lookup_transform(parent, child, time)
        except self._unknown:
            return None
        t, q = found.transform.translation, found.transform.rotation
        return se3.from_quaternion(np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z]))


def make_transforms(node: Node) -> Transforms:
    """Return TF, or its replacement without tf2_ros."""
    try:
        return Tf2Transforms(node)
    except ImportError:
        return NoTransforms(node)
