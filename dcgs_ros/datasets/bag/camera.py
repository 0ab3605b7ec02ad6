# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The RGB-D camera of a recording: intrinsics, unit and noise of depth, its registration."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.config.presets import RegistrationChoice
from ...core.errors import DcgsError, FrameError
from ...core.lens_camera import Camera
from ...core.sensor import SensorNoise
from ...io.images.transports import (
    encoding_of,
    image_size,
    is_compressed,
    read_color,
    read_depth,
)
from ...io.ros_images import (
    MessageError,
    UnknownEncodingError,
    depth_unit,
    is_rectified,
)
from ..camera_presets import PRESETS
from ..images.camera_timeline import check_same
from ..images.registration import (
    Registration,
    Stream,
    find_registration,
    rectified,
)
from ..images.resampling import scaled
from ..options import AS_STORED, SourceOptions
from ..parsing.intrinsics import parse_intrinsics
from ..source import SourceError
from .camera_info import first_camera
from .extrinsics import find_T_colorcam_depthcam
from .images import color_of, depth_of
from .messages import decode
from .recording import custom_data, first_messages, raw_messages
from .recovery.losses import DamagedError
from .topics import CameraTopics, camera_topics, viewer_stream

# Fields that older recordings lack.
_SENSOR_ADDED = {'depth_bias', 'depth_readout_ms', 'color_readout_ms', 'stamp_ms'}
_FEW = 5  # images at the beginning: some may be damaged
SENSOR_KEY = 'dcgs_ros.sensor'  # of metadata.yaml's custom data: JSON of SensorNoise's fields


@dataclass(frozen=True)
class RecordedCamera:
    """How to make frames of a recording's images."""

    topics: CameraTopics
    color_camera: Camera  # of the colour images, when the recording begins
    depth_camera: Camera | None  # by its own CameraInfo
    depth_size: tuple[int, int]  # width and height
    registration: Registration
    sensor: SensorNoise
    depth_per_metre: float  # value of a depth pixel at one metre
    as_published: bool  # raw, registered, in ROS's units: messages can be replayed unchanged
    is_given: bool  # colour's camera, whatever its CameraInfo says

    @property
    def camera(self) -> PinholeCamera:
        """Camera of the frames."""
        return self.registration.camera

    def images(
        self, color: Any, depth: Any, color_now: Camera | None, depth_now: Camera | None
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour and registered depth in metres of two messages.

        `color_now` and `depth_now` are what their CameraInfo say then, if there are any. Raises
        `FrameError` or `MessageError`.
        """
        if color_now is None or self.is_given:
            color_now = self.color_camera
        check_same(color_now, self.color_camera)
        pixels = color_of(color, color_now)
        own = None if self.depth_camera is None else depth_now or self.depth_camera
        sized = own or scaled(color_now, *self.depth_size)
        depth_m = depth_of(depth, sized, self.depth_per_metre)
        return self.registration(pixels, depth_m, color_now, own)


def find_camera(
    path: Path | str,
    text: str | None = None,
    color_topic: str | None = None,
    depth_topic: str | None = None,
    options: SourceOptions = AS_STORED,
) -> RecordedCamera:
    """Find the camera's topics and read its parameters.

    `text` is a preset or intrinsics instead of colour's CameraInfo, `depth_per_metre` replaces the
    recorded unit. Raises `SourceError`.
    """
    topics = camera_topics(path, color_topic, depth_topic)
    try:
        first = {
            topics.color: _first_image(path, topics.color, read_color),
            topics.depth: _first_image(path, topics.depth, read_depth),
        }
        color = _color_camera(path, text, topics, first)
        size = color.width, color.height
        sizes = [size, _usual_size(path, topics.depth) or size]
        depth, _ = first_camera(path, topics.depth_info, topics.depth)
        asked = options.depth_registration
        registered = _registration(path, topics, first, sizes, color, depth, asked)
        sensor = _find_sensor(path, text, registered, depth)
        unit = depth_unit(encoding_of(first[topics.depth]))
        per_metre = options.depth_per_metre or _depth_per_metre(path, topics, unit)
        compressed = any(is_compressed(first[topic]) for topic in (topics.color, topics.depth))
        plain = registered.as_recorded and sizes[0] == sizes[1] and registered.camera == color
        plain = plain and not is_rectified(topics.color)  # else CameraInfo is not these images'
        return RecordedCamera(
            topics, color, None if registered.by_size else depth, sizes[1], registered, sensor,
            per_metre, plain and per_metre == unit and not compressed, text is not None,
        )  # fmt: skip
    except DcgsError as error:
        raise SourceError(f'{path}: {error}') from error


def _first_image(path: Path | str, topic: str, read: Callable[[Any], object]) -> Any:
    """Return the first image that can be read, of the first few, or else the first one.

    Raises `SourceError` where there is none, and where none is encoded so that it can be read.
    """
    found = []
    with suppress(DamagedError):  # reported with the frames
        for message in islice(raw_messages(path, [topic]), _FEW):
            with suppress(FrameError, MessageError):
                found.append(decode(message.cdr, message.type))
                try:
                    read(found[-1])
                except UnknownEncodingError as error:
                    raise SourceError(f'{topic}: {error}') from error
                return found[-1]
    if not found:
        raise SourceError(f'no message of {topic} can be read')
    return found[0]


def _color_camera(
    path: Path | str, text: str | None, topics: CameraTopics, first: dict[str, Any]
) -> Camera:
    if text is not None and text in PRESETS:
        return PRESETS[text].camera
    if text is not None:
        return parse_intrinsics(text, *image_size(first[topics.color]))
    camera, error = first_camera(path, topics.camera_info, topics.color)
    if camera is not None:
        return camera
    what = f'no CameraInfo beside {topics.color}'
    if error is not None:
        what = f'no CameraInfo of {topics.camera_info} can be used: {error}'
    raise SourceError(
        f'{what}; give --camera {"|".join(PRESETS)} or fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]'
    )


def _usual_size(path: Path | str, topic: str) -> tuple[int, int] | None:
    """Return the width and height that most of the first images have: one may be damaged."""
    sizes: Counter[tuple[int, int]] = Counter()
    with suppress(DamagedError):
        for message in islice(raw_messages(path, [topic]), _FEW):
            with suppress(MessageError, FrameError):
                sizes[image_size(decode(message.cdr, message.type))] += 1
    return max(sizes, key=lambda size: sizes[size], default=None)


def _registration(
    path: Path | str,
    topics: CameraTopics,
    first: dict[str, Any],
    sizes: list[tuple[int, int]],
    color: Camera,
    depth: Camera | None,
    asked: RegistrationChoice,
) -> Registration:
    """Return how depth comes onto colour's pixels."""
    names = topics.color, topics.depth
    frames = first[topics.color].header.frame_id, first[topics.depth].header.frame_id
    if viewer_stream(topics.depth) is not None:  # it records unregistered images, and frame ids
        frames = names  # that are numbers
    streams = [Stream(*what) for what in zip(names, frames, sizes, (color, depth), strict=True)]
    return find_registration(
        asked, streams[0], color, streams[1],
        lambda: find_T_colorcam_depthcam(path, topics, frames),
    )  # fmt: skip


def _depth_per_metre(path: Path | str, topics: CameraTopics, standard: float) -> float:
    """Return the value at one metre: the standard's, unless RealSense Viewer recorded another."""
    if (stream := viewer_stream(topics.depth)) is None:
        return standard
    name = f'{stream.rsplit("/", 1)[0]}/option/Depth_Units/value'
    if (message := first_messages(path, [name]).get(name)) is None:
        return standard
    if not 0 < message.data < math.inf:
        raise MessageError(f'{name} is {message.data} metres')
    return 1.0 / float(str(np.float32(message.data)))  # 0.001, not its 32-bit neighbour


def _find_sensor(
    path: Path | str, text: str | None, registration: Registration, depth: Camera | None
) -> SensorNoise:
    """Return the recorded noise, the preset's, or a D435i's of that focal length or mode."""
    recorded = custom_data(path).get(SENSOR_KEY)
    if recorded is not None:
        return _parse_sensor(recorded)
    if text is not None and text in PRESETS:
        return PRESETS[text].sensor
    if depth is not None and not registration.by_size:
        return SensorNoise.realsense(rectified(depth).focal)
    return PRESETS.get(f'd435i_{registration.camera.width}', PRESETS['d435i']).sensor


def _parse_sensor(text: str) -> SensorNoise:
    try:
        values = json.loads(text)
        names = {field.name for field in fields(SensorNoise)}
        needed = names - _SENSOR_ADDED
        if not isinstance(values, dict) or not needed <= values.keys() <= names:
            raise ValueError(f'not an object of {", ".join(sorted(names))}')
        numbers = {name: float(value) for name, value in values.items()}
        if not all(map(math.isfinite, numbers.values())):
            raise ValueError('not all values are finite')
        return SensorNoise(**numbers)
    except (ValueError, TypeError, RecursionError, OverflowError, DcgsError) as error:
        raise SourceError(f'{SENSOR_KEY} {text[:200]!r}: {error}') from error
