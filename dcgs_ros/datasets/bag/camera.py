# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The RGB-D camera of a recording: intrinsics, unit and noise of depth, its registration."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.camera import PinholeCamera
from ...core.errors import DcgsError, FrameError
from ...core.sensor import SensorNoise
from ...io.images.transports import image_size, is_compressed, read_color, read_depth
from ...io.ros_images import MessageError, UnknownEncodingError, read_camera
from ..camera_presets import PRESETS
from ..images.depth_registration import register_depth
from ..parsing.intrinsics import parse_intrinsics
from ..source import SourceError
from .extrinsics import find_T_colorcam_depthcam
from .images import color_of, depth_of
from .recording import custom_data, first_messages
from .topics import CameraTopics, camera_topics, viewer_stream

_SENSOR_ADDED = {'depth_readout_ms', 'stamp_ms'}  # older recordings lack them
SENSOR_KEY = 'dcgs_ros.sensor'  # of metadata.yaml's custom data: JSON of SensorNoise's fields

_MM_PER_M = 1000.0
_SAME_PX = 0.5  # intrinsics that differ by less count as the same camera


@dataclass(frozen=True)
class DepthMount:
    """A depth camera beside the colour camera."""

    camera: PinholeCamera
    T_colorcam_depthcam: NDArray[np.float64]  # (4, 4) metres


@dataclass(frozen=True)
class RecordedCamera:
    """How to make frames of a recording's images."""

    topics: CameraTopics
    camera: PinholeCamera
    sensor: SensorNoise
    depth_per_metre: float  # value of a 16-bit depth pixel at one metre
    mount: DepthMount | None  # None: depth is recorded registered to colour
    as_published: bool  # raw, registered, in ROS's units: messages can be replayed unchanged

    def images(self, color: Any, depth: Any) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour and registered depth in metres of two messages.

        Raises `FrameError` or `MessageError`.
        """
        pixels = color_of(color, self.camera)
        if self.mount is None:
            return pixels, depth_of(depth, self.camera, self.depth_per_metre)
        depth_m = depth_of(depth, self.mount.camera, self.depth_per_metre)
        return pixels, register_depth(
            depth_m, self.mount.camera, self.mount.T_colorcam_depthcam, self.camera
        )


def find_camera(
    path: Path | str,
    text: str | None = None,
    color_topic: str | None = None,
    depth_topic: str | None = None,
) -> RecordedCamera:
    """Find the camera's topics and read its parameters.

    `text` is a preset or intrinsics instead of colour's CameraInfo. Raises `SourceError`.
    """
    topics = camera_topics(path, color_topic, depth_topic)
    try:
        first = first_messages(path, (topics.color, topics.depth))
        for topic in (topics.color, topics.depth):
            if topic not in first:
                raise SourceError(f'no message of {topic} can be read')
        _check_encodings(topics, first)
        first.update(first_messages(path, filter(None, (topics.camera_info, topics.depth_info))))
        camera = _color_camera(text, topics, first)
        mount = _find_mount(path, topics, first)
        sensor = _find_sensor(path, text, camera, mount)
        per_metre = _depth_per_metre(path, topics)
        compressed = any(is_compressed(first[topic]) for topic in (topics.color, topics.depth))
        as_published = mount is None and per_metre == _MM_PER_M and not compressed
        return RecordedCamera(topics, camera, sensor, per_metre, mount, as_published)
    except DcgsError as error:
        raise SourceError(f'{path}: {error}') from error


def _check_encodings(topics: CameraTopics, first: dict[str, Any]) -> None:
    """Raise `SourceError` where no image of a topic can be read; one that is damaged may."""
    for topic, read in ((topics.color, read_color), (topics.depth, read_depth)):
        try:
            read(first[topic])
        except UnknownEncodingError as error:
            raise SourceError(f'{topic}: {error}') from error
        except (FrameError, MessageError):
            pass


def _color_camera(text: str | None, topics: CameraTopics, first: dict[str, Any]) -> PinholeCamera:
    if text is not None and text in PRESETS:
        return PRESETS[text].camera
    if text is not None:
        return parse_intrinsics(text, *image_size(first[topics.color]))
    if topics.camera_info not in first:
        raise SourceError(
            f'no CameraInfo beside {topics.color}; '
            f'give --camera {"|".join(PRESETS)} or fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]'
        )
    return read_camera(first[topics.camera_info])


def _find_mount(
    path: Path | str, topics: CameraTopics, first: dict[str, Any]
) -> DepthMount | None:
    """Read the depth camera's extrinsics; None if depth is registered to colour."""
    color_info = first.get(topics.camera_info or '')
    depth_info = first.get(topics.depth_info or '')
    frames = first[topics.color].header.frame_id, first[topics.depth].header.frame_id
    T_colorcam_depthcam: NDArray[np.float64] | None = np.eye(4)
    # RealSense Viewer records unregistered images, and its frame ids are numbers.
    if viewer_stream(topics.depth) is not None or (all(frames) and frames[0] != frames[1]):
        T_colorcam_depthcam = find_T_colorcam_depthcam(path, topics, frames)
    elif color_info is None or depth_info is None or _same(color_info, depth_info):
        return None
    if T_colorcam_depthcam is None or depth_info is None:
        missing = 'extrinsics' if T_colorcam_depthcam is None else 'CameraInfo'
        raise SourceError(
            f'{topics.depth} is in frame {frames[1]!r}, {topics.color} in {frames[0]!r}: depth is '
            f'not registered to colour, and no {missing} to do it is recorded; record with '
            'align_depth.enable:=true (rs_launch.py of realsense2_camera)'
        )
    return DepthMount(read_camera(depth_info), T_colorcam_depthcam)


def _same(one: Any, other: Any) -> bool:
    """Return whether two CameraInfo describe the same pixels."""
    sizes = (one.width, one.height) == (other.width, other.height)
    return sizes and np.allclose(one.k, other.k, rtol=0.0, atol=_SAME_PX)


def _depth_per_metre(path: Path | str, topics: CameraTopics) -> float:
    """Return the unit of 16-bit depth: millimetres, unless RealSense Viewer recorded another."""
    if (stream := viewer_stream(topics.depth)) is None:
        return _MM_PER_M
    name = f'{stream.rsplit("/", 1)[0]}/option/Depth_Units/value'
    if (message := first_messages(path, [name]).get(name)) is None:
        return _MM_PER_M
    if not 0 < message.data < math.inf:
        raise MessageError(f'{name} is {message.data} metres')
    return 1.0 / float(str(np.float32(message.data)))  # 0.001, not its 32-bit neighbour


def _find_sensor(
    path: Path | str, text: str | None, camera: PinholeCamera, mount: DepthMount | None
) -> SensorNoise:
    """Return the recorded noise, the preset's, or a D435i's of that focal length or mode."""
    recorded = custom_data(path).get(SENSOR_KEY)
    if recorded is not None:
        return _parse_sensor(recorded)
    if text is not None and text in PRESETS:
        return PRESETS[text].sensor
    if mount is not None:
        return SensorNoise.realsense(mount.camera.focal)
    return PRESETS.get(f'd435i_{camera.width}', PRESETS['d435i']).sensor


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
