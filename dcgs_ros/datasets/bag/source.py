# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""RGB-D sequences recorded by ROS 2, ROS 1 or RealSense Viewer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.errors import FrameError
from ...core.frame import RgbdFrame
from ...core.lens_camera import Camera
from ...core.sensor import SensorNoise
from ...core.trajectory import Trajectory
from ...io.ros_images import MessageError
from ...io.trajectory import format_stamp_ns, read_tum
from ..images.registration import AS_RECORDED
from ..options import AS_STORED, SourceOptions
from ..source import BadFrame, ImuSample, OdometrySample, sequence_name
from .camera import RecordedCamera, find_camera
from .contents import RecordedImage, read_contents
from .imu import imu_samples
from .messages import RawMessage, decode, read_header
from .recording import raw_messages
from .recovery.losses import DamagedError
from .robot import RecordedRobot, find_robot, odometry_samples

LAYOUT = 'a recording: a rosbag2 folder with its metadata.yaml, an .mcap, a .db3 or a .bag'

_MAX_WAITING = 100  # images of a topic that are held until their pair is due


class BagSource:
    """Colour and depth of a recording, paired by the stamps of their headers.

    `camera` is a preset or `fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]` in pixels instead of the recorded
    CameraInfo; `groundtruth` a trajectory file instead of the recorded poses. The topics are found
    unless they are given. Depth that is not registered to colour is registered with the recorded
    extrinsics; `options.depth_registration` overrides whether it is. Intrinsics that change
    are followed: all frames are those of one camera. Opening reads all messages once, for their
    stamps, and keeps none.

    Raises a `DcgsError` that names the topics or stamps that do not match. Of a damaged recording
    the readable part is read; the losses are the last `BadFrame`s.
    """

    camera: PinholeCamera
    sensor: SensorNoise
    depth_per_metre: float | None
    groundtruth: Trajectory | None
    notes: list[str]
    recorded: RecordedCamera

    def __init__(
        self,
        path: Path | str,
        camera: str | None = None,
        groundtruth: Path | str | None = None,
        color_topic: str | None = None,
        depth_topic: str | None = None,
        options: SourceOptions = AS_STORED,
    ) -> None:
        """Find the camera and pair the stamps."""
        self._path = path
        self.name = sequence_name(path)
        self.recorded = find_camera(path, camera, color_topic, depth_topic, options)
        self.camera, self.sensor = self.recorded.camera, self.recorded.sensor
        self.depth_per_metre = self.recorded.depth_per_metre
        self._contents = read_contents(path, self.recorded.topics, options)
        self.groundtruth = self._contents.groundtruth
        self.notes = [*self._contents.notes]
        if self.recorded.registration.reason != AS_RECORDED:
            depth = self.recorded.topics.depth
            self.notes.append(f'{depth} is registered {self.recorded.registration.reason}')
        if groundtruth is not None:
            self.groundtruth = read_tum(groundtruth, self.notes)

    def __len__(self) -> int:
        """Return the number of pairs of colour and depth, readable or not, and of losses."""
        return len(self._contents.pairs) + len(self._contents.lost)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Read the frames one by one; an unreadable one is a `BadFrame`."""
        topics, pairs = self.recorded.topics, self._contents.pairs
        colors = _ImageReader(self._path, topics.color, {pair.color for pair in pairs})
        depths = _ImageReader(self._path, topics.depth, {pair.depth for pair in pairs})
        for number, pair in enumerate(pairs, start=1):
            color, depth = colors.take(pair.color), depths.take(pair.depth)
            try:
                if color is None or depth is None:
                    raise FrameError(f'not there, or more than {_MAX_WAITING} images late')
                images = self.recorded.images(
                    decode(color.cdr, color.type), decode(depth.cdr, depth.type),
                    self._camera_at(topics.camera_info, pair.color.header_ns),
                    self._camera_at(topics.depth_info, pair.depth.header_ns),
                )  # fmt: skip
                frame: RgbdFrame | BadFrame = RgbdFrame(pair.color_ns, pair.depth_ns, *images)
            except (FrameError, MessageError) as error:
                stamp = format_stamp_ns(pair.color_ns)
                name = f'frame {number} of {len(pairs)} (colour at {stamp} s)'
                frame = BadFrame(name, str(error))
            yield frame
        yield from self._contents.lost

    def _camera_at(self, topic: str | None, stamp_ns: int) -> Camera | None:
        timeline = self._contents.cameras.get(topic or '')
        return None if timeline is None else timeline.at(stamp_ns)

    def imu(self) -> Iterator[ImuSample]:
        """Read the measurements of all IMUs, in order of their stamps."""
        return imu_samples(self._path)

    @cached_property
    def robot(self) -> RecordedRobot:
        """The sensors beside the camera, and where they are."""
        return find_robot(self._path, self.recorded.topics.color)

    @property
    def T_cam_imu(self) -> NDArray[np.float64] | None:
        """(4, 4) IMU to colour camera, by /tf_static."""
        return self.robot.T_cam_imu

    @property
    def imu_frames(self) -> tuple[str, ...]:
        """Frames of the samples of that IMU."""
        return self.robot.imu_frames

    @property
    def T_base_cam(self) -> NDArray[np.float64] | None:
        """(4, 4) colour camera to base, by /tf_static."""
        return self.robot.T_base_cam

    @property
    def base_frame(self) -> str:
        """Frame of the base, as the odometry names it."""
        return self.robot.base_frame

    def odometry(self) -> Iterator[OdometrySample]:
        """Read what the wheels say."""
        topic = self.robot.odometry_topic
        return iter(()) if topic is None else odometry_samples(self._path, topic)


class _ImageReader:
    """Reads the images of one topic, each as it is asked for.

    Each topic has its own reader, so that no images are held if one topic is recorded far behind
    the other.
    """

    def __init__(self, path: Path | str, topic: str, wanted: set[RecordedImage]) -> None:
        self._messages = raw_messages(path, [topic])
        self._wanted = wanted  # and not yet read
        self._waiting: dict[RecordedImage, RawMessage] = {}
        self._seen: Counter[int] = Counter()  # of each header's stamp

    def take(self, image: RecordedImage) -> RawMessage | None:
        """Read on until this image; None if it is missing or comes too late."""
        with suppress(StopIteration, DamagedError):  # losses are in the contents
            while image not in self._waiting and len(self._waiting) < _MAX_WAITING:
                self._read_next()
        self._wanted.discard(image)
        return self._waiting.pop(image, None)

    def _read_next(self) -> None:
        message = next(self._messages)
        with suppress(MessageError):
            at_ns = read_header(message.cdr)[0]
            image = RecordedImage(at_ns, self._seen[at_ns])
            self._seen[at_ns] += 1
            if image in self._wanted:
                self._wanted.remove(image)
                self._waiting[image] = message
