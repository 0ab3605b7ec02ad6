# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Recordings as messages of a camera: frames that are converted, bags that are not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from heapq import merge
from itertools import islice
from pathlib import Path
from typing import Any, Literal, Protocol

from ...core.frame import RgbdFrame
from ...datasets.bag.camera import find_camera
from ...datasets.bag.messages import RawMessage, read_header, with_stamp
from ...datasets.bag.recording import raw_messages
from ...datasets.bag.recovery.losses import DamagedError
from ...datasets.bag.robot import find_robot
from ...datasets.bag.storage.files import is_bag
from ...datasets.bag.topics import CameraTopics, split_topics
from ...datasets.mounts import LOOKING_FORWARD, Mount, mounts_of
from ...datasets.open import open_source
from ...datasets.options import AS_STORED, split_options
from ...datasets.source import (
    BadFrame,
    ImuSample,
    OdometrySample,
    RobotSource,
    Source,
    SourceError,
)
from ..messages.images import header, write_camera, write_color, write_exact_depth
from ..messages.robot import write_imu, write_odometry

Output = Literal['camera_info', 'color', 'depth', 'imu', 'gyro', 'accel', 'odometry']
Item = RgbdFrame | ImuSample | OdometrySample

_FIRST = 100  # samples that tell which sensors there are


class PlaybackSource(Protocol):
    """A recording to be replayed."""

    camera_frame: str
    beside: frozenset[Output]  # what it holds beside images
    mounts: list[Mount]  # the transforms between its frames

    def items(self) -> Iterator[tuple[int, Any]]:
        """Yield the recording from its start: (stamp in ns, item) each."""
        ...

    def messages(self, item: Any, shift_ns: int) -> list[tuple[Output, Any]]:
        """Return the messages of an item in the order of publishing, with their stamps shifted."""
        ...


class FramePlayback:
    """Frames of a source, each due at the later one of its stamps, and its sensors' samples."""

    def __init__(
        self, source: Source, link: str, camera_frame: str, warn: Callable[[str], None]
    ) -> None:
        """`link` is the frame that the camera is at.

        `warn` gets the source's notes, and a line for each frame that cannot be read.
        """
        for note in source.notes:
            warn(note)
        self._source = source
        self.camera_frame = camera_frame
        self._warn = warn
        first = islice(self._samples(), _FIRST)
        self.beside = frozenset(_output_of(sample) for sample in first)
        self.mounts = mounts_of(source, link, camera_frame)

    def items(self) -> Iterator[tuple[int, Item]]:
        """Yield the frames that can be read, and before each the samples since the last."""
        samples, begun = self._samples(), False
        waiting = next(samples, None)
        for frame in self._source:
            if isinstance(frame, BadFrame):
                self._warn(f'{frame.name}: {frame.reason}')
                continue
            due_ns = max(frame.stamp_ns, frame.depth_stamp_ns)
            while waiting is not None and waiting.stamp_ns <= due_ns:
                if begun:
                    yield waiting.stamp_ns, waiting
                waiting = next(samples, None)
            yield due_ns, frame
            begun = True

    def _samples(self) -> Iterator[ImuSample | OdometrySample]:
        source = self._source
        wheels = source.odometry() if isinstance(source, RobotSource) else iter(())
        samples: list[Iterator[ImuSample | OdometrySample]] = [source.imu(), wheels]
        return merge(*samples, key=lambda sample: sample.stamp_ns)

    def messages(self, item: Item, shift_ns: int) -> list[tuple[Output, Any]]:
        """Return the messages of a frame or a sample."""
        if isinstance(item, OdometrySample):
            return [('odometry', write_odometry(item, shift_ns))]
        if isinstance(item, ImuSample):
            return [(_output_of(item), write_imu(item, shift_ns))]
        return self._images(item, shift_ns)

    def _images(self, item: RgbdFrame, shift_ns: int) -> list[tuple[Output, Any]]:
        color = header(item.stamp_ns + shift_ns, self.camera_frame)
        depth = header(item.depth_stamp_ns + shift_ns, self.camera_frame)
        return [
            ('camera_info', write_camera(self._source.camera, color)),
            ('color', write_color(item.color, color)),
            ('depth', write_exact_depth(item.depth_m, depth)),
        ]


class BagPlayback:
    """Messages of a bag as they were recorded, each due when it was recorded."""

    def __init__(
        self,
        path: Path,
        topics: CameraTopics,
        link: str,
        camera_frame: str,
        warn: Callable[[str], None],
    ) -> None:
        """Take the frame of the camera's `link`, and its own where images name none.

        `warn` gets a line about what is lost.
        """
        self._path, self._warn = path, warn
        if topics.camera_info is None:
            raise SourceError(f'{path}: no CameraInfo beside {topics.color}; give camera')
        self._outputs: dict[str, Output] = {
            topics.camera_info: 'camera_info',
            topics.color: 'color',
            topics.depth: 'depth',
        }
        robot = find_robot(path, topics.color)
        images = len(self._outputs)
        self._outputs |= {topic: _imu_output(topic) for topic in robot.imu_topics}
        if robot.odometry_topic is not None:
            self._outputs[robot.odometry_topic] = 'odometry'
        self.beside = frozenset([*self._outputs.values()][images:])
        self.camera_frame = _recorded_frame(path, topics.color, camera_frame)
        self.mounts = [
            (parent, child, T) for child, (parent, T) in (robot.transforms or {}).items()
        ]
        if not any(child == self.camera_frame for _, child, _ in self.mounts):
            self.mounts.append((link, self.camera_frame, LOOKING_FORWARD))

    def items(self) -> Iterator[tuple[int, RawMessage]]:
        """Yield the messages."""
        try:
            for message in raw_messages(self._path, self._outputs):
                yield message.stamp_ns, message
        except DamagedError as error:
            self._warn(str(error))

    def messages(self, item: RawMessage, shift_ns: int) -> list[tuple[Output, Any]]:
        """Return the message's bytes."""
        cdr = item.cdr
        if shift_ns:
            cdr = with_stamp(cdr, read_header(cdr)[0] + shift_ns)
        return [(self._outputs[item.topic], cdr)]


def _recorded_frame(path: Path, topic: str, otherwise: str) -> str:
    """Return the frame of the first image on a topic, where it has one that is a name."""
    frame = read_header(next(raw_messages(path, [topic])).cdr)[1]
    return otherwise if not frame or frame.isdigit() else frame


def _output_of(sample: ImuSample | OdometrySample) -> Output:
    if isinstance(sample, OdometrySample):
        return 'odometry'
    if sample.angular_velocity is None:
        return 'accel'
    return 'gyro' if sample.acceleration is None else 'imu'


def _imu_output(topic: str) -> Output:
    """Return which of realsense2_camera's topics is like that of a recorded IMU."""
    name = topic.lower()
    return 'gyro' if 'gyro' in name else 'accel' if 'accel' in name else 'imu'


def open_playback(
    source: str, camera: str | None, link: str, camera_frame: str, warn: Callable[[str], None]
) -> PlaybackSource:
    """Open a source by its address; a bag is converted if `camera` is given or its images need it.

    `link` and `camera_frame` are the frames of the camera where the source names none. Raises
    a `DcgsError` where it cannot be played.
    """
    if not source.startswith('synthetic:'):  # whose `?` begins no topics
        address, options = split_options(source)
        path, color, depth = split_topics(address)
        recorded = find_camera(path, camera, color, depth, options) if is_bag(path) else None
        plain = camera is None and options == AS_STORED
        if recorded is not None and recorded.as_published and plain:
            return BagPlayback(path, recorded.topics, link, camera_frame, warn)
        if recorded is not None:
            camera_frame = _recorded_frame(path, recorded.topics.color, camera_frame)
    return FramePlayback(open_source(source, camera), link, camera_frame, warn)
