# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera's topics, paired: what the tracking thread takes its frames from."""

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
_WAITING_PAIRS = 4  # newer ones push out older ones; a stall of a tenth of a second loses none


class CameraSubscriber:
    """Subscribes to a camera; images are looked at by who takes them."""

    def __init__(
        self, node: Node, settings: TrackerNodeSettings, say: Callable[[str], None]
    ) -> None:
        """Subscribe."""
        self.camera: PinholeCamera | None = None
        self.inbox: WorkQueue[ImagePair[Image, Image]] = WorkQueue(_WAITING_PAIRS)
        self.pairing: ImagePairing[Image, Image] = ImagePairing(int(1e9 * settings.sync_slop_s))
        self.counts = {'color': 0, 'depth': 0, 'pairs': 0}
        self._told = self._totals()
        self._received_s = time.monotonic()
        self._say = say
        live = sensor_qos(settings.reliability)
        color, depth = f'{_CAMERA}/color', f'{_CAMERA}/aligned_depth_to_color'
        on = node.create_subscription
        on(Image, f'{color}/image_raw', partial(self._on_image, 'color'), live)
        on(Image, f'{depth}/image_raw', partial(self._on_image, 'depth'), live)
        on(CameraInfo, f'{color}/camera_info', self._on_camera, live)

    def _on_camera(self, info: CameraInfo) -> None:
        try:
            self.camera = read_camera(info)
        except DcgsError as error:
            self._say(f'camera_info refused: {error}')

    def _on_image(self, kind: str, image: Image) -> None:
        """ImagePair, and leave the pair to who tracks."""
        self.counts[kind] += 1
        self._received_s = time.monotonic()
        add = self.pairing.color if kind == 'color' else self.pairing.depth
        for pair in add(stamp_ns(image.header.stamp), image):
            self.counts['pairs'] += 1
            self.inbox.put(pair)

    def _totals(self) -> dict[str, int]:
        return self.counts | {'dropped': self.inbox.dropped}

    def news(self) -> Streams:
        """Count what came since this was asked last."""
        before, self._told = self._told, self._totals()
        new = {key: count - before[key] for key, count in self._told.items()}
        silent_s = time.monotonic() - self._received_s
        return Streams(**new, has_camera=self.camera is not None, silent_s=silent_s)

    def figures(self) -> dict[str, object]:
        """Count since the start."""
        pairing = self.pairing
        return {
            **self._totals(),
            'unpaired_color': pairing.unpaired_color,
            'unpaired_depth': pairing.unpaired_depth,
            'disorder': pairing.disorder,
        }


def read_frame(pair: ImagePair[Image, Image]) -> RgbdFrame:
    """Make the frame of two messages; raises a `DcgsError` where they cannot be one."""
    color, depth = pair.color, pair.depth
    frames = color.header.frame_id, depth.header.frame_id
    if all(frames) and frames[0] != frames[1]:
        raise MessageError(
            f'colour is in frame {frames[0][:60]!r}, depth in {frames[1][:60]!r}: it is not '
            'registered'
        )
    return RgbdFrame(pair.color_ns, pair.depth_ns, read_color(color), read_depth(depth))
