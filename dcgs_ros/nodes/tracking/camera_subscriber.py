# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Subscribes to a camera and pairs its images for the tracking thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from ...core.config.nodes import TrackerNodeSettings
from ...core.errors import DcgsError
from ...io.images.rvl import decode_rvl
from ...io.images.transports import COLOR_TRANSPORTS, DEPTH_TRANSPORTS
from ...io.ros_images import stamp_ns
from ..transport import sensor_qos
from ..work_queue import WorkQueue
from .frame_reader import FrameReader, Lookup, SomeImage
from .health import Streams
from .pairing import ImagePair, ImagePairing

_CAMERA = '/camera/camera'
_ONE_PIXEL = bytes([1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0x10])  # in RVL
_WAITING_PAIRS = 4  # newer pairs push out older ones; a stall of a tenth of a second loses none


class CameraSubscriber:
    """Puts pairs of images into a queue, without looking at their pixels."""

    def __init__(
        self,
        node: Node,
        settings: TrackerNodeSettings,
        warn: Callable[[str], None],
        lookup: Lookup,
    ) -> None:
        """Subscribe; `lookup` asks TF for T_parent_child."""
        self.queue: WorkQueue[ImagePair[SomeImage, SomeImage]] = WorkQueue(_WAITING_PAIRS)
        self.pairing: ImagePairing[SomeImage, SomeImage] = ImagePairing(
            int(1e9 * settings.sync_slop_s)
        )
        self.counts = {'color': 0, 'depth': 0, 'pairs': 0}
        self._reported = self._totals()
        self._received_s = time.monotonic()
        self._warn = warn
        self._settings = settings
        qos = sensor_qos(settings.reliability)
        color, depth = f'{_CAMERA}/color', f'{_CAMERA}/aligned_depth_to_color'
        topics = []
        for kind, stream, suffix in (
            ('color', color, COLOR_TRANSPORTS[settings.color_transport]),
            ('depth', depth, DEPTH_TRANSPORTS[settings.depth_transport]),
        ):
            # As image_transport does it, a raw topic that is remapped takes its transports along.
            topics.append(node.resolve_topic_name(f'{stream}/image_raw') + suffix)
            type_ = CompressedImage if suffix else Image
            node.create_subscription(type_, topics[-1], partial(self._on_image, kind), qos)
        for kind, stream in (('color', color), ('depth', depth)):
            callback = partial(self._on_info, kind)
            node.create_subscription(CameraInfo, f'{stream}/camera_info', callback, qos)
        tell = node.get_logger().info
        self.reader = FrameReader(settings.depth_registration, topics, lookup, tell)

    def warm_up(self) -> None:
        """Compile what decodes depth, before the first image has to wait for it."""
        if self._settings.depth_transport == 'compressedDepth':
            decode_rvl(_ONE_PIXEL, 'depth')

    def _on_info(self, kind: str, info: CameraInfo) -> None:
        try:
            self.reader.on_info(kind, info)
        except DcgsError as error:
            self._warn(f'camera_info of {kind} refused: {error}')

    def _on_image(self, kind: str, image: SomeImage) -> None:
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
        return Streams(**new, has_camera=self.reader.has_camera, silent_s=silent_s)

    def figures(self) -> dict[str, object]:
        """Return the counts since the start, for diagnostics."""
        pairing = self.pairing
        return {
            **self._totals(),
            'unpaired_color': pairing.unpaired_color,
            'unpaired_depth': pairing.unpaired_depth,
            'disorder': pairing.disorder,
        }
