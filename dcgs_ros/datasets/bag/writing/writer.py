# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Writing a sequence as a rosbag2, which `ros2 bag play` plays as the camera published it.

Each message is recorded at its stamp, and messages are written in that order.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from heapq import heappop, heappush, merge
from itertools import chain, count
from pathlib import Path

from ....core.frame import RgbdFrame
from ...images.association import LARGEST_PAIR_GAP_NS
from ...mounts import mounts_of
from ...source import RobotSource, Source
from ..camera import SENSOR_KEY
from ..messages import RawMessage
from .encoding import (
    LINK_FRAME,
    OPTICAL_FRAME,
    encode_imu,
    encode_mounts,
    encode_odometry,
    encode_truth,
)
from .frame_encoder import FrameEncoder
from .storage import BagOptions, message_writer, open_writer

_MARGIN_NS = 100_000_000  # before and after the frames, in which poses and IMU samples are kept


def write_bag(
    folder: Path, source: Source, frames: Iterable[RgbdFrame], options: BagOptions
) -> list[str]:
    """Write these frames of the source to a new folder, with the source's poses and sensors.

    IMU samples, odometry and static transforms are written where there are some. Of poses and
    samples only those within the time of the frames. Returns what was lost, one line
    each. Raises `BagWritingError`, or `EncodingError` for a stamp that messages cannot hold.
    """
    encoder = FrameEncoder(source.camera, options.compress)
    with open_writer(folder, options) as writer:
        writer.set_custom_data(SENSOR_KEY, json.dumps(asdict(source.sensor)))
        write = message_writer(writer)
        for message in _messages(source, _in_order(frames, encoder.messages)):
            write(message)
    if not encoder.rounded:
        return []
    return [f'depth of {encoder.rounded} frames was rounded to 1 mm']


def _messages(source: Source, frames: Iterator[RawMessage]) -> Iterator[RawMessage]:
    """Merge the messages of the frames with all others, by stamp."""
    first = next(frames, None)
    if first is None:
        return
    start_ns = max(first.stamp_ns - _MARGIN_NS, 0)
    yield encode_mounts(mounts_of(source, LINK_FRAME, OPTICAL_FRAME), start_ns)
    inertial = (encode_imu(sample) for sample in source.imu() if sample.stamp_ns >= start_ns)
    truth = () if source.groundtruth is None else encode_truth(source.groundtruth, start_ns)
    wheels: Iterator[RawMessage] = iter(())
    if isinstance(source, RobotSource):
        samples = source.odometry()
        wheels = (encode_odometry(sample) for sample in samples if sample.stamp_ns >= start_ns)
    beside = merge(inertial, wheels, truth, key=lambda message: message.stamp_ns)
    yield from _merged(chain([first], frames), beside)


def _in_order(
    frames: Iterable[RgbdFrame], encode: Callable[[RgbdFrame], Iterator[RawMessage]]
) -> Iterator[RawMessage]:
    """Sort the messages of frames by stamp: depth may precede or follow colour by a pair's gap."""
    waiting: list[tuple[int, int, RawMessage]] = []
    tie = count()
    for frame in frames:
        for message in encode(frame):
            heappush(waiting, (message.stamp_ns, next(tie), message))
        while waiting[0][0] < frame.stamp_ns - LARGEST_PAIR_GAP_NS:
            yield heappop(waiting)[-1]
    while waiting:
        yield heappop(waiting)[-1]


def _merged(frames: Iterator[RawMessage], beside: Iterator[RawMessage]) -> Iterator[RawMessage]:
    """Merge both by stamp, until `_MARGIN_NS` after the last of `frames`."""
    other = next(beside, None)
    end_ns = 0
    for message in frames:
        while other is not None and other.stamp_ns <= message.stamp_ns:
            yield other
            other = next(beside, None)
        yield message
        end_ns = message.stamp_ns + _MARGIN_NS
    while other is not None and other.stamp_ns <= end_ns:
        yield other
        other = next(beside, None)
