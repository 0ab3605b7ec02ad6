# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Subscribes to a camera and pairs its images for the tracking thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image

from ...core.camera import PinholeCamera
from ...core.config.nodes import TrackerNodeSettings
from ...core.errors import DcgsError
from ...core.frame import RgbdFrame
from ...io.ros_images import MessageError, read_camera, read_color, read_depth, stamp_ns
from ..transport import sensor_qos
from ..work_queue import WorkQueue
from .health import Streams, Topic
from .missed_frames import MissedFrames
from .pairing import ImagePair, ImagePairing

_CAMERA = 'camera/camera'  # relative: each robot's namespace has its own
_INFOS = 1000  # camera_infos that wait while the kernels are compiled
_SEVERAL = 2  # missed frames: one may be a camera_info that was sent in advance
_SETTLED_S = 2.0  # without an image since they were subscribed to
_WAITING_PAIRS = 4  # newer pairs push out older ones; a stall of a tenth of a second loses none


class CameraSubscriber:
    """Puts pairs of images into a queue, without looking at their pixels.

    Images are subscribed to by `begin`, once somebody can use them; a replay waits for that.
    """

    def __init__(
        self, node: Node, settings: TrackerNodeSettings, warn: Callable[[str], None]
    ) -> None:
        """Subscribe to camera_info, which tells how many images go by before `begin`."""
        self.camera: PinholeCamera | None = None
        self._refused_camera = ''  # why the last camera_info could not be used
        self.queue: WorkQueue[ImagePair[Image, Image]] = WorkQueue(_WAITING_PAIRS)
        self.pairing: ImagePairing[Image, Image] = ImagePairing(int(1e9 * settings.sync_slop_s))
        self.counts = {'color': 0, 'depth': 0, 'pairs': 0, 'unstamped': 0}
        self._reported = self._totals()
        self._received_s = time.monotonic()
        self.missed = MissedFrames()
        self._warn = warn
        self._node, self._reliability = node, settings.reliability
        qos = sensor_qos(settings.reliability, _INFOS)
        info = f'{_CAMERA}/color/camera_info'
        self._subscriptions: dict[str, Subscription] = {
            'camera_info': node.create_subscription(CameraInfo, info, self._on_camera, qos)
        }

    def begin(self) -> None:
        """Subscribe to the images."""
        self._received_s = time.monotonic()
        qos = sensor_qos(self._reliability)
        for kind, folder in (('color', 'color'), ('depth', 'aligned_depth_to_color')):
            topic, on_image = f'{_CAMERA}/{folder}/image_raw', partial(self._on_image, kind)
            subscription = self._node.create_subscription(Image, topic, on_image, qos)
            self._subscriptions[kind] = subscription

    def _on_camera(self, info: CameraInfo) -> None:
        if not self.counts['color']:
            self.missed.add(stamp_ns(info.header.stamp))
        try:
            self.camera = read_camera(info)
            self._refused_camera = ''
        except DcgsError as error:
            self._refused_camera = str(error)
            self._warn(f'camera_info refused: {error}')

    def _on_image(self, kind: str, image: Image) -> None:
        if kind == 'color' and not self.counts[kind]:
            self.missed.end(stamp_ns(image.header.stamp))
        self.counts[kind] += 1
        self.counts['unstamped'] += not stamp_ns(image.header.stamp)
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
        return Streams(
            **new,
            has_camera=self.camera is not None,
            silent_s=time.monotonic() - self._received_s,
            apart_s=self.pairing.apart_s,
            refused_camera=self._refused_camera,
            topics={kind: self._topic(kind) for kind in self._subscriptions},
        )

    def _topic(self, kind: str) -> Topic:
        """Return who publishes a topic."""
        name = self._subscriptions[kind].topic_name
        found = [info.qos_profile for info in self._node.get_publishers_info_by_topic(name)]
        best_effort = [qos.reliability is ReliabilityPolicy.BEST_EFFORT for qos in found]
        incompatible = self._reliability == 'reliable' and bool(found) and all(best_effort)
        return Topic(name, len(found), incompatible)

    def missed_text(self) -> str | None:
        """Return what was missed, once it is certain: with the first image, or in silence."""
        certain = self.counts['color'] or time.monotonic() - self._received_s > _SETTLED_S
        if self.missed.told or self.missed.count < _SEVERAL or not certain:
            return None
        self.missed.told = True
        return str(self.missed)

    def figures(self) -> dict[str, object]:
        """Return the counts since the start, for diagnostics."""
        pairing = self.pairing
        return {
            **self._totals(),
            'unpaired_color': pairing.unpaired_color,
            'unpaired_depth': pairing.unpaired_depth,
            'disorder': pairing.disorder,
            'missed': self.missed.count,
        }


def read_frame(pair: ImagePair[Image, Image]) -> RgbdFrame:
    """Return the frame of two messages; raise a `DcgsError` where they cannot form one."""
    color, depth = pair.color, pair.depth
    frames = color.header.frame_id, depth.header.frame_id
    if all(frames) and frames[0] != frames[1]:
        raise MessageError(
            f'colour is in frame {frames[0][:60]!r}, depth in {frames[1][:60]!r}: it is not '
            'registered'
        )
    return RgbdFrame(pair.color_ns, pair.depth_ns, read_color(color), read_depth(depth))
