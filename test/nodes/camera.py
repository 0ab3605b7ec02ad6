# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A camera in the test's own process, that may misbehave and never is too fast."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.images.resampling import resample_color, resample_depth
from dcgs_ros.datasets.source import BadFrame, Source
from dcgs_ros.nodes.harness.observer import Observer
from dcgs_ros.nodes.messages.images import (
    array_of,
    header,
    write_camera,
    write_color,
    write_depth,
)
from dcgs_ros.nodes.transport import sensor_qos

FRAME_ID = 'camera_color_optical_frame'
TOPICS: dict[str, tuple[type, str]] = {
    'camera_info': (CameraInfo, 'color/camera_info'),
    'color': (Image, 'color/image_raw'),
    'depth': (Image, 'aligned_depth_to_color/image_raw'),
}
COMPRESSED_TOPICS = TOPICS | {
    'color': (CompressedImage, 'color/image_raw/compressed'),
    'depth': (CompressedImage, 'aligned_depth_to_color/image_raw/compressedDepth'),
}
AHEAD = 3  # pairs on their way to a tracker, which keeps four
HANGS_S = 300.0  # only a failure takes so long
_POLL_S = 0.001
_INFO_S = 0.2


@dataclass(frozen=True)
class Shot:
    """One frame as messages."""

    stamp_ns: int
    messages: dict[str, Any]  # by name of their topic


class Camera:
    """Sends a frame when the tracker has room for it: nothing depends on anybody's speed.

    There is room while fewer than `AHEAD` pairs lack a pose. Where no pose comes, as of a camera
    that is lost, the tracker's reports tell when it is through with what it has.
    """

    def __init__(self, observer: Observer, topics: dict[str, tuple[type, str]] = TOPICS) -> None:
        qos = sensor_qos('reliable')
        self.publishers = {
            name: observer.node.create_publisher(kind, f'/camera/camera/{topic}', qos)
            for name, (kind, topic) in topics.items()
        }
        self._observer = observer
        self._begin()

    def _begin(self) -> None:
        self._sent = dict.fromkeys(TOPICS, 0)
        self._came = self._observer.came
        self._given_up = 0  # pairs of which no pose will come

    def connect(self, camera: PinholeCamera) -> None:
        """Wait until a tracker that has just started listens, and knows the camera."""
        self._begin()
        images = [self.publishers[name] for name in ('color', 'depth')]
        self._until(lambda: all(p.get_subscription_count() for p in images), 'a subscriber')

        def known() -> bool:
            return self._observer.ready('dcgs_tracker') and 'camera_info' not in self._report[1]

        while not known():
            self.publishers['camera_info'].publish(write_camera(camera, header(1, FRAME_ID)))
            time.sleep(_INFO_S)

    def send(self, shot: Shot, *names: str) -> None:
        """Send a frame, or some of its messages, once there is room."""
        self._until(self._has_room, 'room for a frame')
        for name in names or tuple(TOPICS):
            self._sent[name] += 1
            self.publishers[name].publish(shot.messages[name])

    def play(self, shots: Iterable[Shot]) -> None:
        for shot in shots:
            self.send(shot)

    def settle(self) -> None:
        """Wait until the tracker is through with all that was sent, and says so."""
        self._until(self.caught_up, 'through with all')

    def take_stock(self) -> None:
        """Count anew from what the tracker has, where others have sent it images too."""
        before = self.next_report()
        while before != (now := self.next_report()):
            before = now
        self._sent['color'], self._sent['depth'] = now[:2]
        self._given_up = self._unanswered()

    def next_report(self) -> tuple[int, ...]:
        """Wait for another report of the tracker; returns its figures."""
        last = self._report
        self._until(lambda: self._report is not last, 'a report')
        return self._figures()

    def caught_up(self) -> bool:
        """The last report has all images and what became of them, and the poses are here."""
        color, depth, pairs, tracked, unused = self._figures()
        return (
            (color, depth) == (self._sent['color'], self._sent['depth'])
            and pairs == tracked + unused
            and tracked == self._observer.came - self._came
        )

    def _has_room(self) -> bool:
        if self._unanswered() - self._given_up >= AHEAD and self.caught_up():
            self._given_up = self._unanswered()
        return self._unanswered() - self._given_up < AHEAD

    def _unanswered(self) -> int:
        sent = min(self._sent['color'], self._sent['depth'])
        return sent - (self._observer.came - self._came)

    def _figures(self) -> tuple[int, ...]:
        """Colour and depth images, pairs, tracked ones and others, as last reported."""
        names = (
            ('color',), ('depth',), ('pairs',), ('ok', 'degenerate', 'relocalised'),
            ('lost', 'refused', 'dropped'),
        )  # fmt: skip
        values = self._report[2]
        return tuple(sum(int(values.get(key, 0)) for key in keys) for keys in names)

    @property
    def _report(self) -> tuple[int, str, dict[str, str]]:
        return self._observer.status.get('dcgs_tracker', (0, '', {}))

    def _until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait as `wait_until` does, but look often."""
        end = time.monotonic() + HANGS_S
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError(
                    f'{what}: not within {HANGS_S:g} s; sent {self._sent}; colour, depth, pairs, '
                    f'tracked, not tracked: {self._figures()}'
                )
            time.sleep(_POLL_S)


def every_shot(source: Source) -> Iterator[Shot]:
    """Make each when it is asked for."""
    return (shot(f, source.camera) for f in source if not isinstance(f, BadFrame))


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


def compressed(shot: Shot) -> Shot:
    """Lossless, by the plugins compressed and compressedDepth."""
    color, depth = shot.messages['color'], shot.messages['depth']
    pixels = np.frombuffer(color.data, np.uint8).reshape(color.height, color.width, 3)
    depth_m = np.frombuffer(depth.data, '<f4').reshape(depth.height, depth.width)
    depth_mm = np.rint(1000 * np.nan_to_num(depth_m)).astype(np.uint16)
    messages = {
        'color': ('rgb8; png compressed bgr8', b'', pixels[..., ::-1]),
        'depth': ('16UC1; compressedDepth png', bytes(12), depth_mm),
    }
    for name, (format_, head, image) in messages.items():
        data = array_of(head + bytes(cv2.imencode('.png', image)[1]))
        shot.messages[name] = CompressedImage(
            header=shot.messages[name].header, format=format_, data=data
        )
    return shot


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


def zoomed(frame: RgbdFrame, camera: PinholeCamera, zoom: float) -> Shot:
    """The same view with other focal lengths."""
    now = replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy)
    seen = replace(
        frame,
        color=resample_color(frame.color, camera, now),
        depth_m=resample_depth(frame.depth_m, camera, now),
    )
    return shot(seen, now)
