# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Colour and depth of recorded images of a known camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...core.lens_camera import Camera
from ...io.images.transports import image_size, read_color, read_depth


def color_of(message: Any, camera: Camera) -> NDArray[np.uint8]:
    """Decode an Image or CompressedImage to colour (H, W, 3) RGB or (H, W).

    Raises `FrameError` or `MessageError`; an image not of the camera's size is not decoded.
    """
    _check_size('colour', message, camera)
    return read_color(message)


def depth_of(message: Any, camera: Camera, per_metre: float) -> NDArray[np.float32]:
    """Decode an Image or CompressedImage to depth (H, W) in metres, 0 = none.

    `per_metre` is the value of a pixel at one metre. Raises `FrameError` or `MessageError`; an
    image not of the camera's size is not decoded.
    """
    _check_size('depth', message, camera)
    return read_depth(message, per_metre)


def _check_size(what: str, message: Any, camera: Camera) -> None:
    width, height = image_size(message)
    if (width, height) != (camera.width, camera.height):
        raise FrameError(
            f"{what} is {width}x{height} pixels, but the camera's images are "
            f'{camera.width}x{camera.height}'
        )
