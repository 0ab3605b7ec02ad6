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
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from ...core.config.nodes import TrackerNodeSettings
from ...core.errors import DcgsError
from ...io.images.rvl import decode_rvl
from ...io.images.transports import COLOR_TRANSPORTS, DEPTH_TRANSPORTS
from ...io.ros_images import stamp_ns
from ..transport import sensor_qos
from ..work_queue import WorkQueue
from .frame_reader import FrameReader, Lookup, SomeImage
from .health import Streams, Topic
from .missed_frames import MissedFrames
from .pairing import ImagePair, ImagePairing

_CAMERA = 'camera/camera'  # relative: each robot's namespace has its own
_COLOR, _DEPTH = f'{_CAMERA}/color', f'{_CAMERA}/aligned_depth_to_color'
_ONE_PIXEL = bytes([1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0x10])  # in RVL
_INFOS = 1000  # camera_infos that wait while the kernels are compiled
_SEVERAL = 2  # missed frames: one may be a camera_info that was sent in advance
_SETTLED_S = 2.0  # without an image since they were subscribed to
_WAITING_PAIRS = 4  # newer pairs push out older ones; a stall of a tenth of a second loses none


class CameraSubscriber:
    """Puts pairs of images into a queue, without looking at their pixels.

    Images are subscribed to by `begin`, once somebody can use them; a replay waits for that.
    """

    def __init__(
        self,
        node: Node,
        settings: TrackerNodeSettings,
        warn: Callable[[str], None],
        lookup: Lookup,
        inform: Callable[[str], None],
    ) -> None:
        """Subscribe to camera_info, which tells how many images go by before `begin`.

        `lookup` asks TF for T_parent_child; `warn` and `inform` get lines for the log.
        """
        self._refused_camera = ''  # why the last camera_info could not be used
        self.queue: WorkQueue[ImagePair[SomeImage, SomeImage]] = WorkQueue(_WAITING_PAIRS)
        self.pairing: ImagePairing[SomeImage, SomeImage] = ImagePairing(
            int(1e9 * settings.sync_slop_s)
        )
        self.counts = {'color': 0, 'depth': 0, 'pairs': 0, 'unstamped': 0}
        self._reported = self._totals()
        self._received_s = time.monotonic()
        self.missed = MissedFrames()
        self.paused = False
        self._begun = False
        self._warn = warn
        self._node, self._settings = node, settings
        # As image_transport does it, a raw topic that is remapped takes its transports along.
        self._images = {
            kind: node.resolve_topic_name(f'{stream}/image_raw') + suffix
            for kind, stream, suffix in (
                ('color', _COLOR, COLOR_TRANSPORTS[settings.color_transport]),
                ('depth', _DEPTH, DEPTH_TRANSPORTS[settings.depth_transport]),
            )
        }
        topics = [*self._images.values()]
        self.reader = FrameReader(settings.depth_registration, topics, lookup, inform)
        qos = sensor_qos(settings.reliability, _INFOS)
        subscribe = node.create_subscription
        # Also as image_transport: the CameraInfo of depth is beside its images, where these are.
        beside = node.resolve_topic_name(f'{_DEPTH}/image_raw').rpartition('/')[0]
        subscribe(CameraInfo, f'{beside}/camera_info', partial(self._on_info, 'depth'), qos)
        on_info = partial(self._on_info, 'color')
        self._subscriptions: dict[str, Subscription] = {
            'camera_info': subscribe(CameraInfo, f'{_COLOR}/camera_info', on_info, qos)
        }

    def warm_up(self) -> None:
        """Compile what decodes depth, before the first image has to wait for it."""
        if self._settings.depth_transport == 'compressedDepth':
            decode_rvl(_ONE_PIXEL, 'depth')

    def pause(self) -> None:
        """Subscribe to no images until `resume`: they cost their transport too."""
        self.paused = True
        for kind in self._images:
            if kind in self._subscriptions:
                self._node.destroy_subscription(self._subscriptions.pop(kind))

    def resume(self) -> None:
        """Go on after `pause`."""
        was, self.paused = self.paused, False
        if was and self._begun:
            self.begin()

    def begin(self) -> None:
        """Subscribe to the images, unless paused."""
        self._begun = True
        if self.paused:
            return
        self._received_s = time.monotonic()
        qos = sensor_qos(self._settings.reliability)
        transports = self._settings.color_transport, self._settings.depth_transport
        for (kind, topic), transport in zip(self._images.items(), transports, strict=True):
            type_ = Image if transport == 'raw' else CompressedImage
            subscription = self._node.create_subscription(
                type_, topic, partial(self._on_image, kind), qos
            )
            self._subscriptions[kind] = subscription

    def _on_info(self, kind: str, info: CameraInfo) -> None:
        is_color = kind == 'color'
        if is_color and not self.counts['color']:
            self.missed.add(stamp_ns(info.header.stamp))
        refused = ''
        try:
            self.reader.on_info(kind, info)
        except DcgsError as error:
            refused = str(error)
            self._warn(f'camera_info of {kind} refused: {error}')
        if is_color:
            self._refused_camera = refused

    def _on_image(self, kind: str, image: SomeImage) -> None:
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
            has_camera=self.reader.has_camera,
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
        reliable = self._settings.reliability == 'reliable'
        return Topic(name, len(found), reliable and bool(found) and all(best_effort))

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
