# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Decoding the images of .sens files; none may have more pixels than the header says."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...io.images.decoding import decode_color, encoded_size

RAW_COLOR, PNG_COLOR, JPEG_COLOR = range(3)
RAW_DEPTH, ZLIB_DEPTH, OCCI_DEPTH = range(3)


def color_of(data: bytes, kind: int, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Decode colour (H, W, 3) RGB of that width and height; raises `FrameError`."""
    width, height = size
    if kind == RAW_COLOR:
        return _pixels(data, 'colour', np.dtype(np.uint8), (height, width, 3))
    if (found := encoded_size(data, 'colour')) != size:
        raise FrameError(f'colour is {found[0]}x{found[1]}, not {width}x{height} pixels')
    return decode_color(data, 'colour')


def depth_of(data: bytes, kind: int, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Decode raw depth (H, W) of that width and height; raises `FrameError`."""
    width, height = size
    if kind == ZLIB_DEPTH:
        try:  # one byte more than expected, to detect longer data
            data = zlib.decompressobj().decompress(data, 2 * width * height + 1)
        except zlib.error as error:
            raise FrameError(f'depth ({len(data)} bytes): {error}') from error
    return _pixels(data, 'depth', np.dtype('<u2'), (height, width))


def _pixels(data: bytes, name: str, kind: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    expected = int(np.prod(shape)) * kind.itemsize
    if len(data) != expected:
        raise FrameError(
            f'{name} has {"more" if len(data) > expected else len(data)} bytes, '
            f'not the {expected} of {shape[1]}x{shape[0]} pixels'
        )
    return np.frombuffer(data, kind).reshape(shape)
