# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Images as .sens files hold them; none is decoded to more pixels than the header promises."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ..images.files import decode_color, encoded_size

RAW_COLOR, PNG_COLOR, JPEG_COLOR = range(3)
RAW_DEPTH, ZLIB_DEPTH, OCCI_DEPTH = range(3)


def color_of(data: bytes, kind: int, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Colour (H, W, 3) RGB of an image of that width and height; raises `FrameError`."""
    width, height = size
    if kind == RAW_COLOR:
        return _pixels(data, 'colour', np.dtype(np.uint8), (height, width, 3))
    if (found := encoded_size(data, 'colour')) != size:
        raise FrameError(f'colour is {found[0]}x{found[1]}, not {width}x{height} pixels')
    return decode_color(data, 'colour')


def depth_of(data: bytes, kind: int, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Raw depth (H, W) of an image of that width and height; raises `FrameError`."""
    width, height = size
    if kind == ZLIB_DEPTH:
        try:  # one byte more than there should be tells that there is more
            data = zlib.decompressobj().decompress(data, 2 * width * height + 1)
        except zlib.error as error:
            raise FrameError(f'depth ({len(data)} bytes): {error}') from error
    return _pixels(data, 'depth', np.dtype('<u2'), (height, width))


def _pixels(data: bytes, name: str, kind: np.dtype, shape: tuple[int, ...]) -> NDArray:
    expected = int(np.prod(shape)) * kind.itemsize
    if len(data) != expected:
        raise FrameError(
            f'{name} has {"more" if len(data) > expected else len(data)} bytes, '
            f'not the {expected} of {shape[1]}x{shape[0]} pixels'
        )
    return np.frombuffer(data, kind).reshape(shape)
