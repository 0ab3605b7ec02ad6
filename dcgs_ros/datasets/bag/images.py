# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Colour and depth of recorded images, raw (Image) or compressed (CompressedImage)."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...core.lens_camera import Camera
from ...io.ros_images import measured, read_color, read_depth
from ..images.decoding import decode_color, decode_depth, encoded_size

_PNG = b'\x89PNG\r\n\x1a\n'
_DEPTH_HEADER = struct.Struct('<Iff')  # compressed_depth_image_transport's: format, A, B


def color_of(message: Any, camera: Camera) -> NDArray[np.uint8]:
    """Decode an Image or CompressedImage to colour (H, W, 3) RGB or (H, W).

    Raises `FrameError` or `MessageError`; an image not of the camera's size is not decoded.
    """
    _check_size('colour', message, camera)
    if is_compressed(message):
        return decode_color(bytes(message.data), _name('colour', message))
    return read_color(message)


def depth_of(message: Any, camera: Camera, per_metre: float) -> NDArray[np.float32]:
    """Decode an Image or CompressedImage to depth (H, W) in metres, 0 = none.

    `per_metre` is the value of a pixel at one metre. Compressed depth is a 16-bit PNG, with or
    without compressed_depth_image_transport's header; with one, 32FC1 is stored as inverse depth:
    a value q > 0 means A / (q - B). Raises `FrameError` or `MessageError`; an image not of
    the camera's size is not decoded.
    """
    _check_size('depth', message, camera)
    if not is_compressed(message):
        return read_depth(message, per_metre)
    header, png = _split(bytes(message.data))
    raw = decode_depth(png, _name('depth', message))
    if not (header and message.format.startswith('32FC1')):
        return raw.astype(np.float32) / np.float32(per_metre)
    _, a, b = _DEPTH_HEADER.unpack(header)
    with np.errstate(all='ignore'):  # A and B may be damaged
        depth_m = np.float32(a) / (raw.astype(np.float32) - np.float32(b))
    depth_m[raw == 0] = 0.0
    return measured(depth_m / np.float32(per_metre))


def image_size(message: Any) -> tuple[int, int]:
    """Return the width and height in the header of an image; raises `FrameError`."""
    if not is_compressed(message):
        return int(message.width), int(message.height)
    return encoded_size(_split(bytes(message.data))[1], _name('image', message))


def is_compressed(message: Any) -> bool:
    """Return whether the message is a CompressedImage rather than an Image."""
    return hasattr(message, 'format')


def _name(what: str, message: Any) -> str:
    return f'{what} ({message.format[:40]})'


def _split(data: bytes) -> tuple[bytes, bytes]:
    """Split compressed depth into its header, empty if there is none, and the image."""
    size = _DEPTH_HEADER.size
    return (data[:size], data[size:]) if data[size:].startswith(_PNG) else (b'', data)


def _check_size(what: str, message: Any, camera: Camera) -> None:
    width, height = image_size(message)
    if (width, height) != (camera.width, camera.height):
        raise FrameError(
            f"{what} is {width}x{height} pixels, but the camera's images are "
            f'{camera.width}x{camera.height}'
        )
