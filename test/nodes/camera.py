# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A camera in the test's own process, that may misbehave."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import cv2
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.source import BadFrame, Source
from dcgs_ros.nodes.harness.observer import wait_until
from dcgs_ros.nodes.messages.images import header, write_camera, write_color, write_depth
from dcgs_ros.nodes.transport import sensor_qos

PERIOD_S = 1 / 30
FRAME_ID = 'camera_color_optical_frame'
_TOPICS: dict[str, tuple[type, str]] = {
    'camera_info': (CameraInfo, 'color/camera_info'),
    'color': (Image, 'color/image_raw'),
    'depth': (Image, 'aligned_depth_to_color/image_raw'),
}
_FOUND_S, _KNOWN_S = 60.0, 0.5


@dataclass(frozen=True)
class Shot:
    """One frame as messages."""

    stamp_ns: int
    messages: dict[str, Any]  # by name of their topic


class Camera:
    def __init__(self, node: Node) -> None:
        qos = sensor_qos('reliable')
        self.publishers = {
            name: node.create_publisher(kind, f'/camera/camera/{topic}', qos)
            for name, (kind, topic) in _TOPICS.items()
        }

    def connect(self) -> None:
        """Wait until the tracker listens, and knows that it does."""
        images = [self.publishers[name] for name in ('color', 'depth')]
        wait_until(
            lambda: all(p.get_subscription_count() for p in images), _FOUND_S, 'a subscriber'
        )
        time.sleep(_KNOWN_S)

    def send(self, shot: Shot, *names: str) -> None:
        for name in names or tuple(_TOPICS):
            self.publishers[name].publish(shot.messages[name])

    def play(self, shots: Sequence[Shot]) -> None:
        """Send in real time, one a period."""
        start_s = time.monotonic()
        for k, shot in enumerate(shots):
            time.sleep(max(0.0, start_s + k * PERIOD_S - time.monotonic()))
            self.send(shot)


def shots(source: Source, count: int) -> list[Shot]:
    frames = [f for f in islice(source, count) if not isinstance(f, BadFrame)]
    return [shot(frame, source.camera) for frame in frames]


def shot(frame: RgbdFrame, camera: PinholeCamera) -> Shot:
    color, depth = (header(ns, FRAME_ID) for ns in (frame.stamp_ns, frame.depth_stamp_ns))
    return Shot(
        frame.stamp_ns,
        {
            'camera_info': write_camera(camera, color),
            'color': write_color(frame.color, color),
            'depth': write_depth(frame.depth_m, depth),
        },
    )


def halved(frame: RgbdFrame, camera: PinholeCamera) -> Shot:
    """Half the resolution."""
    size = camera.width // 2, camera.height // 2
    small = replace(
        frame,
        color=cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA),
        depth_m=np.ascontiguousarray(frame.depth_m[::2, ::2]),
    )
    return shot(
        small,
        replace(
            camera, width=size[0], height=size[1], fx=camera.fx / 2, fy=camera.fy / 2,
            cx=(camera.cx + 0.5) / 2 - 0.5, cy=(camera.cy + 0.5) / 2 - 0.5,
        ),
    )  # fmt: skip
