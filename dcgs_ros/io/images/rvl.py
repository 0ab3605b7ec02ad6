# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""RVL, a lossless coding of 16-bit depth (Wilson, Fast Lossless Depth Image Compression, 2017).

The pixels are runs of zeros and of others in turn: the length of each, and the differences of the
others to the one before. A number is coded in nibbles of three bits from the lowest, with the
highest bit set in all but its last; nibbles fill words of 32 bits from the top.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ...core.kernels.jit import strict_kernel
from .decoding import MAX_PIXELS

_SIZE = struct.Struct('<II')  # width and height, before the words


def rvl_size(data: bytes, name: str) -> tuple[int, int]:
    """Return the width and height; raises `FrameError` with `name` for implausible ones."""
    if len(data) < _SIZE.size:
        raise FrameError(f'{name} is cut off after {len(data)} bytes')
    width, height = _SIZE.unpack_from(data)
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameError(f'{name}: {width}x{height} pixels is not a plausible image size')
    return width, height


def decode_rvl(data: bytes, name: str) -> NDArray[np.uint16]:
    """Return the pixels (H, W); raises `FrameError` with `name` where they are not all there."""
    width, height = rvl_size(data, name)
    words = np.frombuffer(data, '<u4', (len(data) - _SIZE.size) // 4, _SIZE.size)
    depth = np.zeros(width * height, np.uint16)
    if not _decode(words.astype(np.uint32), depth):
        raise FrameError(f'{name} is cut off after {len(data)} bytes, or damaged')
    return depth.reshape(height, width)


@strict_kernel
def _decode(words, out):
    """Fill `out` (N,) uint16, zeros at first, from `words` (M,) uint32; False if damaged."""
    at, pixel, previous = 0, 0, 0
    left, nonzero = 0, True  # of the run
    end = 8 * len(words)
    while pixel < len(out) or left:
        value, bits, more = 0, 0, True
        while more:
            if at == end or bits > 30:
                return False
            nibble = (words[at // 8] >> np.uint32(28 - 4 * (at % 8))) & np.uint32(15)
            value |= np.int64(nibble & np.uint32(7)) << bits
            more = nibble > 7
            bits += 3
            at += 1
        if left:
            previous += (value >> 1) ^ -(value & 1)
            out[pixel] = previous & 0xFFFF
            pixel += 1
            left -= 1
        else:
            nonzero = not nonzero
            if value > len(out) - pixel:
                return False
            if nonzero:
                left = value
            else:
                pixel += value
    return True
