# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The encodings of colour in a ROS Image, as sensor_msgs/image_encodings names them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

_Convert = Callable[[NDArray[Any]], NDArray[np.uint8]]

_TWELVE_BITS = 1 << 12


class ColorEncoding(NamedTuple):
    """How the pixels are stored, and what makes RGB (H, W, 3) or grey (H, W) of them."""

    kind: str  # NumPy's type of a channel
    channels: int
    convert: _Convert  # of (H, W) or (H, W, channels); planes below each other: (rows * H, W)
    rows: float = 1.0  # stored for each of the image: more where planes follow the first one
    block: tuple[int, int] = (1, 1)  # pixels across and down that share their chroma


def eight_bits(pixels: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Return the upper 8 of 16 bits, or of 12 where no pixel has more.

    Cameras put 12 bits or fewer into the lower ones, where the upper 8 would be black.
    """
    return (pixels >> (4 if pixels.max() < _TWELVE_BITS else 8)).astype(np.uint8)


def _by(code: int) -> _Convert:
    return lambda pixels: cv2.cvtColor(pixels, code)


def _wide(encoding: ColorEncoding) -> ColorEncoding:
    """Return the same encoding with 16 bits a channel."""
    return encoding._replace(kind='u2', convert=lambda p: encoding.convert(eight_bits(p)))


def _nv24_to_rgb(planes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert brightness (H, W) above chroma of the same size (2 H, W); OpenCV has no code."""
    height, width = len(planes) // 3, planes.shape[1]
    chroma = planes[height:].reshape(height, width, 2)
    halved = cv2.resize(chroma, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(
        np.vstack([planes[:height], halved.reshape(-1, width)]), cv2.COLOR_YUV2RGB_NV12
    )


_MONO = ColorEncoding('u1', 1, np.ascontiguousarray)
_BGR = ColorEncoding('u1', 3, _by(cv2.COLOR_BGR2RGB))
_BGRA = ColorEncoding('u1', 4, _by(cv2.COLOR_BGRA2RGB))
_WITH_WIDE = {
    'rgb8': ColorEncoding('u1', 3, np.ascontiguousarray),
    'bgr8': _BGR,
    'mono8': _MONO,
    'rgba8': ColorEncoding('u1', 4, _by(cv2.COLOR_RGBA2RGB)),
    'bgra8': _BGRA,
    '8UC3': _BGR,  # the order of OpenCV, which cv_bridge labels so
    '8UC4': _BGRA,
    'bayer_rggb8': ColorEncoding('u1', 1, _by(cv2.COLOR_BayerRGGB2RGB)),
    'bayer_bggr8': ColorEncoding('u1', 1, _by(cv2.COLOR_BayerBGGR2RGB)),
    'bayer_gbrg8': ColorEncoding('u1', 1, _by(cv2.COLOR_BayerGBRG2RGB)),
    'bayer_grbg8': ColorEncoding('u1', 1, _by(cv2.COLOR_BayerGRBG2RGB)),
}
_UYVY = ColorEncoding('u1', 2, _by(cv2.COLOR_YUV2RGB_UYVY), block=(2, 1))
_YUYV = ColorEncoding('u1', 2, _by(cv2.COLOR_YUV2RGB_YUYV), block=(2, 1))

COLOR_ENCODINGS = {
    **_WITH_WIDE,
    '8UC1': _MONO,  # while 16UC1 is depth
    **{name.replace('8', '16'): _wide(encoding) for name, encoding in _WITH_WIDE.items()},
    'yuv422': _UYVY,
    'uyvy': _UYVY,
    'yuv422_yuy2': _YUYV,
    'yuyv': _YUYV,
    'nv12': ColorEncoding('u1', 1, _by(cv2.COLOR_YUV2RGB_NV12), 1.5, (2, 2)),
    'nv21': ColorEncoding('u1', 1, _by(cv2.COLOR_YUV2RGB_NV21), 1.5, (2, 2)),
    'nv24': ColorEncoding('u1', 1, _nv24_to_rgb, 3.0, (2, 2)),
}
