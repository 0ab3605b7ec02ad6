# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Subscribes to a camera and pairs its images for the tracking thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from ...core.camera import PinholeCamera
from ...core.config.nodes import TrackerNodeSettings
from ...core.errors import DcgsError
from ...core.frame import RgbdFrame
from ...io.ros_images import MessageError, read_camera, read_color, read_depth, stamp_ns
from ..transport import sensor_qos
from ..work_queue import WorkQueue
from .health import Streams
from .pairing import ImagePair, ImagePairing

_CAMERA = '/camera/camera'
_WAITING_PAIRS = 4  # newer pairs push out older ones; a stall of a tenth of a second loses none


class CameraSubscriber:
    """Puts pairs of images into a queue, without looking at their pixels."""

    def __init__(
        self, node: Node, settings: TrackerNodeSettings, warn: Callable[[str], None]
    ) -> None:
        """Subscribe."""
        self.camera: PinholeCamera | None = None
        self.queue: WorkQueue[ImagePair[Image, Image]] = WorkQueue(_WAITING_PAIRS)
        self.pairing: ImagePairing[Image, Image] = ImagePairing(int(1e9 * settings.sync_slop_s))
        self.counts = {'color': 0, 'depth': 0, 'pairs': 0}
        self._reported = self._totals()
        self._received_s = time.monotonic()
        self._warn = warn
        qos = sensor_qos(settings.reliability)
        color, depth = f'{_CAMERA}/color', f'{_CAMERA}/aligned_depth_to_color'
        subscribe = node.create_subscription
        subscribe(Image, f'{color}/image_raw', partial(self._on_image, 'color'), qos)
        subscribe(Image, f'{depth}/image_raw', partial(self._on_image, 'depth'), qos)
        subscribe(CameraInfo, f'{color}/camera_info', self._on_camera, qos)

    def _on_camera(self, info: CameraInfo) -> None:
        try:
            self.camera = read_camera(info)
        except DcgsError as error:
            self._warn(f'camera_info refused: {error}')

    def _on_image(self, kind: str, image: Image) -> None:
        self.counts[kind] += 1
        self._received_s = time.monotonic()
        add = self.pairing.color if kind == 'color' else self.pairing.depth
        for pair in add(stamp_ns(image.header.stamp), image):
            self.counts['pairs'] += 1
            self.queue.put(pair)

    def _totals(self) -> dict[str, int]:
        return self.counts | {'dropped': self.queue.dropped}

    def news(self) -> Streams:
        """Return what came since the last call."""
        before, self._reported = self._reported, self._totals()
        new = {key: count - before[key] for key, count in self._reported.items()}
        silent_s = time.monotonic() - self._received_s
        return Streams(**new, has_camera=self.camera is not None, silent_s=silent_s)

    def figures(self) -> dict[str, object]:
        """Return the counts since the start, for diagnostics."""
        pairing = self.pairing
        return {
            **self._totals(),
            'unpaired_color': pairing.unpaired_color,
            'unpaired_depth': pairing.unpaired_depth,
            'disorder': pairing.disorder,
        }


def read_frame(pair: ImagePair[Image, Image], depth_per_metre: float | None = None) -> RgbdFrame:
    """Return the frame of two messages; raise a `DcgsError` where they cannot form one.

    `depth_per_metre` is the value of a depth pixel at one metre; None: as in ROS.
    """
    color, depth = pair.color, pair.depth
    frames = color.header.frame_id, depth.header.frame_id
    if all(frames) and frames[0] != frames[1]:
        raise MessageError(
            f'colour is in frame {frames[0][:60]!r}, depth in {frames[1][:60]!r}: it is not '
            'registered'
        )
    depth_m = read_depth(depth, depth_per_metre)
    return RgbdFrame(pair.color_ns, pair.depth_ns, read_color(color), depth_m)
