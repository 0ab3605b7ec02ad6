# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Encoding frames as realsense2_camera publishes them; `io.ros_images` is the inverse."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ....core.camera import PinholeCamera
from ....core.frame import RgbdFrame
from ....io.ros_images import camera_fields, exact_millimetres, exact_pixels, in_millimetres
from ..messages import RawMessage
from ..topics import COLOR_TOPIC, DEPTH_TOPIC
from .encoding import OPTICAL_FRAME, header, make, on_topic

_JPEG_QUALITY = 95
_CONFIG = bytes(12)  # compressed_depth_image_transport's header; unused for 16UC1

_Body = tuple[str, tuple[Any, ...]]  # a message's name and its fields after the header


class FrameEncoder:
    """Encodes frames of one camera as Image or, with `compress`, as CompressedImage."""

    def __init__(self, camera: PinholeCamera, compress: bool) -> None:
        """Set `rounded`, the number of frames whose depth was rounded to millimetres, to zero."""
        self.rounded = 0
        self._camera, self._compress = camera, compress

    def messages(self, frame: RgbdFrame) -> Iterator[RawMessage]:
        """Encode colour and depth, each with its CameraInfo and its own stamp."""
        color, depth = frame.stamp_ns, frame.depth_stamp_ns
        for topic, stamp_ns in ((COLOR_TOPIC, color), (DEPTH_TOPIC, depth)):
            beside = topic.rsplit('/', 1)[0] + '/camera_info'
            yield _on(beside, stamp_ns, *_camera_info(self._camera))
        if self._compress:
            yield _on(f'{COLOR_TOPIC}/compressed', color, *_jpeg(frame.color))
            yield _on(f'{DEPTH_TOPIC}/compressedDepth', depth, *self._png(frame.depth_m))
        else:
            yield _on(COLOR_TOPIC, color, *_color(frame.color))
            yield _on(DEPTH_TOPIC, depth, *_image(*exact_pixels(frame.depth_m)))

    def _png(self, depth_m: NDArray[np.float32]) -> _Body:
        depth_mm = exact_millimetres(depth_m)
        if depth_mm is None:
            self.rounded += 1
            depth_mm = in_millimetres(depth_m)
        data = _CONFIG + encode_image('.png', depth_mm)
        return _compressed('16UC1; compressedDepth png', data)


def encode_image(suffix: str, pixels: NDArray[Any], *parameters: int) -> bytes:
    """Return the bytes of an image file; colour (H, W, 3) is RGB."""
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(suffix, pixels, parameters)
    return data.tobytes()


def _on(topic: str, stamp_ns: int, name: str, fields: tuple[Any, ...]) -> RawMessage:
    return on_topic(topic, stamp_ns, make(name, header(stamp_ns, OPTICAL_FRAME), *fields))


def _camera_info(camera: PinholeCamera) -> _Body:
    no_binning, whole_image = (0, 0), make('sensor_msgs/RegionOfInterest', 0, 0, 0, 0, False)
    fields = (camera.height, camera.width, *camera_fields(camera), *no_binning, whole_image)
    return 'sensor_msgs/CameraInfo', fields


def _color(color: NDArray[np.uint8]) -> _Body:
    return _image('mono8' if color.ndim == 2 else 'rgb8', color)


def _image(encoding: str, pixels: NDArray[Any]) -> _Body:
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    little_endian, step = 0, len(data) // height
    return 'sensor_msgs/Image', (height, width, encoding, little_endian, step, data)


def _jpeg(color: NDArray[np.uint8]) -> _Body:
    what = 'mono8; jpeg compressed ' if color.ndim == 2 else 'rgb8; jpeg compressed bgr8'
    return _compressed(what, encode_image('.jpg', color, cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))


def _compressed(what: str, data: bytes) -> _Body:
    return 'sensor_msgs/CompressedImage', (what, np.frombuffer(data, np.uint8))
