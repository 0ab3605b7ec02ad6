# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""RGB-D sequences that were recorded by ROS or RealSense Viewer."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ...core.camera import PinholeCamera
from ...core.errors import FrameError
from ...core.frame import RgbdFrame
from ...core.sensor import SensorNoise
from ...core.trajectory import Trajectory
from ...io.ros_images import MessageError
from ...io.trajectory import format_stamp_ns, read_tum
from ..source import BadFrame, ImuSample, sequence_name
from .camera import RecordedCamera, find_camera
from .imu import imu_samples
from .messages import DamagedError, RawMessage, decode, raw_messages, read_header
from .survey import survey

LAYOUT = 'a recording: a rosbag2 folder with its metadata.yaml, an .mcap, a .db3 or a .bag'

_MAX_WAITING = 100  # images of a topic that are read before they are due: a second's disorder


class BagSource:
    """Colour and depth of a recording, paired by the stamps of their headers within 20 ms.

    `camera` is a preset or `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` in pixels, used instead of the
    recorded CameraInfo; `groundtruth` a trajectory file instead of the recorded poses. The topics
    are found unless they are given. Depth that is not registered to colour is registered with the
    recorded extrinsics. Opening reads all messages once, for their stamps; none is kept.

    Raises a `DcgsError` that names the topics, or the stamps, that do not fit. Of a damaged
    recording the good part is read; what is lost comes as the last `BadFrame`s.
    """

    camera: PinholeCamera
    sensor: SensorNoise
    groundtruth: Trajectory | None
    recorded: RecordedCamera

    def __init__(
        self,
        path: Path | str,
        camera: str | None = None,
        groundtruth: Path | str | None = None,
        color_topic: str | None = None,
        depth_topic: str | None = None,
    ) -> None:
        """Find the camera and pair the stamps."""
        self._path = path
        self.name = sequence_name(path)
        self.recorded = find_camera(path, camera, color_topic, depth_topic)
        self.camera, self.sensor = self.recorded.camera, self.recorded.sensor
        topics = self.recorded.topics
        self._survey = survey(path, topics.color, topics.depth)
        self.groundtruth = self._survey.groundtruth
        if groundtruth is not None:
            self.groundtruth = read_tum(groundtruth)

    def __len__(self) -> int:
        """Count the pairs of colour and depth, readable or not, and what is lost."""
        return len(self._survey.pairs) + len(self._survey.lost)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames one by one; an unreadable one comes as a `BadFrame`."""
        topics, pairs = self.recorded.topics, self._survey.pairs
        colors = _Images(self._path, topics.color, {color_ns for color_ns, _ in pairs})
        depths = _Images(self._path, topics.depth, {depth_ns for _, depth_ns in pairs})
        for number, (color_ns, depth_ns) in enumerate(pairs, start=1):
            color, depth = colors.take(color_ns), depths.take(depth_ns)
            try:
                if color is None or depth is None:
                    raise FrameError(f'not there, or more than {_MAX_WAITING} images late')
                images = self.recorded.images(
                    decode(color.cdr, color.type), decode(depth.cdr, depth.type)
                )
                frame: RgbdFrame | BadFrame = RgbdFrame(color_ns, depth_ns, *images)
            except (FrameError, MessageError) as error:
                stamp = format_stamp_ns(color_ns)
                name = f'frame {number} of {len(pairs)} (colour at {stamp} s)'
                frame = BadFrame(name, str(error))
            yield frame
        yield from self._survey.lost

    def imu(self) -> Iterator[ImuSample]:
        """Read what inertial units measured, in order of the stamps."""
        return imu_samples(self._path)


class _Images:
    """One topic's images by their stamps, read on until the one asked for is there.

    Each topic has a reader of its own, so that nothing piles up where one is recorded far behind
    the other.
    """

    def __init__(self, path: Path | str, topic: str, wanted_ns: set[int]) -> None:
        self._messages = raw_messages(path, [topic])
        self._wanted_ns = wanted_ns  # and not yet read
        self._waiting: dict[int, RawMessage] = {}

    def take(self, stamp_ns: int) -> RawMessage | None:
        """Hand an image over, if it comes in time."""
        with suppress(StopIteration, DamagedError):  # the survey told of what is lost
            while stamp_ns not in self._waiting and len(self._waiting) < _MAX_WAITING:
                self._read_on()
        self._wanted_ns.discard(stamp_ns)
        return self._waiting.pop(stamp_ns, None)

    def _read_on(self) -> None:
        message = next(self._messages)
        with suppress(MessageError):
            at_ns = read_header(message.cdr)[0]
            if at_ns in self._wanted_ns:
                self._wanted_ns.remove(at_ns)
                self._waiting[at_ns] = message
