# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""RGB-D sequences that rosbag2 recorded: mcap and sqlite3, one file or a folder of them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.camera import PinholeCamera
from ..core.errors import DcgsError, FrameError
from ..core.frame import RgbdFrame
from ..core.sensor import SensorNoise
from ..core.trajectory import Trajectory
from ..io.ros_images import MessageError, read_camera, read_color, read_depth, stamp_ns
from ..io.trajectory import format_stamp_ns, read_tum
from .bag_messages import (
    CAMERA_INFO,
    IMAGE,
    camera_topics,
    decode,
    raw_messages,
    read_header,
)
from .cameras import PRESETS, parse_intrinsics
from .source import BadFrame, SourceError
from .tum_index import MAX_PAIR_GAP_NS, associate_stamps

_MAX_STEP_BACK_NS = 1_000_000_000  # more is not disorder but another recording


class BagSource:
    """Colour and depth of a recording, paired by the stamps of their headers within 20 ms.

    `camera` is a preset (`fr1`, `fr2`, `fr3`, `d435i`) or `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` in
    pixels, used instead of the recorded CameraInfo; a preset tells the depth noise, too, which
    else is a D435i's. Opening reads all messages once, for their stamps; none is kept.

    Raises a `DcgsError` that names the topics, or the stamps, that do not fit.
    """

    camera: PinholeCamera
    sensor: SensorNoise
    groundtruth: Trajectory | None

    def __init__(
        self, path: Path | str, camera: str | None = None, groundtruth: Path | str | None = None
    ) -> None:
        """Find the topics, pair the stamps and read the camera."""
        self._path = path
        self.name = os.path.basename(os.path.abspath(path))
        self._topics = camera_topics(path)
        self._first: dict[str, bytes] = {}  # of each topic
        color_ns, depth_ns = self._survey()
        self._check_registration()
        self._pairs = self._pair(color_ns, depth_ns)
        self.sensor = PRESETS.get(camera or '', PRESETS['d435i']).sensor
        self.camera = self._find_camera(camera)
        self.groundtruth = None if groundtruth is None else read_tum(groundtruth)

    def __len__(self) -> int:
        """Count the pairs of colour and depth, readable or not."""
        return len(self._pairs)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames one by one; an unreadable one comes as a `BadFrame`."""
        color, depth = self._topics.color, self._topics.depth
        due = deque(((color, i), (depth, j)) for i, j in self._pairs)
        wanted = {key for pair in due for key in pair}
        held: dict[tuple[str, int], bytes] = {}
        numbers = {topic: count() for topic in (color, depth)}
        for message in raw_messages(self._path, (color, depth)):
            key = message.topic, next(numbers[message.topic])
            if key in wanted:
                held[key] = message.cdr
            while due and due[0][0] in held and due[0][1] in held:
                yield self._frame(len(self) - len(due) + 1, *(held.pop(k) for k in due.popleft()))

    def _frame(self, number: int, color_cdr: bytes, depth_cdr: bytes) -> RgbdFrame | BadFrame:
        """Decode a pair, or say why not."""
        try:
            color, depth = (decode(cdr, IMAGE) for cdr in (color_cdr, depth_cdr))
            frame = RgbdFrame(
                stamp_ns(color.header.stamp),
                stamp_ns(depth.header.stamp),
                read_color(color),
                read_depth(depth),
            )
            height, width = frame.depth_m.shape
            if (width, height) != (self.camera.width, self.camera.height):
                raise FrameError(
                    f"{width}x{height} pixels, but the camera's images are "
                    f'{self.camera.width}x{self.camera.height}'
                )
        except (FrameError, MessageError) as error:
            stamp = format_stamp_ns(read_header(color_cdr)[0])
            return BadFrame(f'frame {number} of {len(self)} (colour at {stamp} s)', str(error))
        return frame

    def _survey(self) -> list[NDArray[np.int64]]:
        """Read the header stamps of colour and depth, and each topic's first message."""
        stamps: dict[str, list[int]] = {self._topics.color: [], self._topics.depth: []}
        info = [self._topics.camera_info] if self._topics.camera_info else []
        for message in raw_messages(self._path, [*stamps, *info]):
            self._first.setdefault(message.topic, message.cdr)
            if (seen := stamps.get(message.topic)) is None:
                continue
            try:
                seen.append(read_header(message.cdr)[0])
            except MessageError as error:
                where = f'{message.topic}, message {len(seen) + 1}'
                raise SourceError(f'{self._path}: {where}: {error}') from error
            if len(seen) > 1 and seen[-1] < seen[-2] - _MAX_STEP_BACK_NS:
                raise SourceError(
                    f'{self._path}: {message.topic}, message {len(seen)}: its stamp '
                    f'{format_stamp_ns(seen[-1])} is before {format_stamp_ns(seen[-2])}: '
                    'more than one recording in one'
                )
        return [np.array(values, np.int64) for values in stamps.values()]

    def _check_registration(self) -> None:
        """Refuse depth in a frame of its own."""
        topics = self._topics
        frames = [read_header(self._first[topic])[1] for topic in (topics.color, topics.depth)]
        if all(frames) and frames[0] != frames[1]:
            raise SourceError(
                f'{self._path}: {topics.depth} is in frame {frames[1]!r}, {topics.color} in '
                f'{frames[0]!r}: depth is not registered to colour'
            )

    def _pair(
        self, color_ns: NDArray[np.int64], depth_ns: NDArray[np.int64]
    ) -> list[tuple[int, int]]:
        """Pair the messages: their numbers in their topics, by colour stamp."""
        color, color_at = np.unique(color_ns, return_index=True)
        depth, depth_at = np.unique(depth_ns, return_index=True)
        pairs = associate_stamps(color, depth, MAX_PAIR_GAP_NS)
        if not pairs:
            spans = [
                f'{format_stamp_ns(stamps[0])} to {format_stamp_ns(stamps[-1])} s'
                for stamps in (color, depth)
            ]
            raise SourceError(
                f'{self._path}: none of {len(color)} colour images has a depth image within '
                f'{MAX_PAIR_GAP_NS / 1e6:.0f} ms: colour {spans[0]}, depth {spans[1]}'
            )
        return [(int(color_at[i]), int(depth_at[j])) for i, j in pairs]

    def _find_camera(self, text: str | None) -> PinholeCamera:
        """Read the preset, the intrinsics given, or the recorded ones."""
        try:
            if text is not None and text in PRESETS:
                return PRESETS[text].camera
            if text is not None:
                image = decode(self._first[self._topics.color], IMAGE)
                return parse_intrinsics(text, image.width, image.height)
            if self._topics.camera_info is None:
                raise SourceError(
                    f'no CameraInfo beside {self._topics.color}; '
                    f'give --camera {"|".join(PRESETS)} or fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]'
                )
            return read_camera(decode(self._first[self._topics.camera_info], CAMERA_INFO))
        except DcgsError as error:
            raise SourceError(f'{self._path}: {error}') from error
