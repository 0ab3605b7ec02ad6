# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Colour in every encoding of a ROS Image, and image_transport's codes, by their definitions."""

from __future__ import annotations

import gzip
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

_YUYV, _UYVY = ('yuyv', 'yuv422_yuy2'), ('uyvy', 'yuv422')
_ORDERS = {
    'rgb': [0, 1, 2], 'bgr': [2, 1, 0], 'rgba': [0, 1, 2, 3], 'bgra': [2, 1, 0, 3],
    '8UC3': [2, 1, 0], '8UC4': [2, 1, 0, 3],
}  # fmt: skip
_LIMITED = np.array(  # of BT.601 with 8 bits: Y from 16 to 235, U and V from 16 to 240
    [[65.481, 128.553, 24.966], [-37.797, -74.203, 112.0], [112.0, -93.786, -18.214]]
)


def pack(rgb: NDArray[np.uint8], encoding: str) -> NDArray[Any]:
    """Return the pixels of an Image, (rows, W) or (rows, W, channels), of colour (H, W, 3).

    Of grey encodings the green channel is kept; of 16 bits the lower ones are noise.
    """
    if '16' in encoding:
        narrow = pack(rgb, encoding.replace('16', '8')).astype(np.uint16)
        noise = np.random.default_rng(16).integers(0, 256, narrow.shape, np.uint16)
        return narrow << 8 | noise
    if encoding in ('mono8', '8UC1'):
        return rgb[..., 1].copy()
    if encoding.startswith('bayer'):
        return _mosaic(rgb, encoding[6:10])
    if encoding.startswith(('yuy', 'yuv', 'uyvy', 'nv')):
        return _yuv(rgb, encoding)
    opaque = np.full((*rgb.shape[:2], 1), 255, np.uint8)
    return np.concatenate([rgb, opaque], axis=-1)[..., _ORDERS[encoding.removesuffix('8')]]


def _mosaic(rgb: NDArray[np.uint8], pattern: str) -> NDArray[np.uint8]:
    """Keep one channel a pixel: the pattern names the four of a block, row by row."""
    out = np.empty(rgb.shape[:2], np.uint8)
    for k, channel in enumerate(pattern):
        block = slice(k // 2, None, 2), slice(k % 2, None, 2)
        out[block] = rgb[..., 'rgb'.index(channel)][block]
    return out


def _yuv(rgb: NDArray[np.uint8], encoding: str) -> NDArray[np.uint8]:
    """Brightness of every pixel, and chroma of every one (nv24), or of each 2x1 or 2x2."""
    yuv = rgb @ _LIMITED.T / 255 + [16, 128, 128]
    y, uv = np.rint(yuv[..., 0]).astype(np.uint8), yuv[..., 1:]
    height, width = y.shape
    if encoding == 'nv24':
        return np.vstack([y, _rounded(uv).reshape(2 * height, width)])
    uv = 0.5 * (uv[:, ::2] + uv[:, 1::2])
    if encoding in ('nv12', 'nv21'):
        chroma = _rounded(0.5 * (uv[::2] + uv[1::2]))[..., :: 1 if encoding == 'nv12' else -1]
        return np.vstack([y, chroma.reshape(height // 2, width)])
    assert encoding in _YUYV + _UYVY
    pair = [y, _rounded(uv).reshape(height, width)]  # u and v in turn
    return np.stack(pair if encoding in _YUYV else pair[::-1], axis=-1)


def _rounded(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(values).astype(np.uint8)


def rvl(depth: NDArray[np.uint16]) -> bytes:
    """Return depth (H, W) as compressed_depth_image_transport codes it with `rvl`."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while value > 7:
            nibbles.append(value & 7 | 8)
            value >>= 3
        nibbles.append(value)

    pixels, at, previous = depth.ravel().tolist(), 0, 0
    while at < len(pixels):
        start = at
        while at < len(pixels) and not pixels[at]:
            at += 1
        put(at - start)
        start = at
        while at < len(pixels) and pixels[at]:
            at += 1
        put(at - start)
        for value in pixels[start:at]:
            delta, previous = value - previous, value
            put(2 * delta if delta >= 0 else -2 * delta - 1)
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        sum(nibble << 28 - 4 * k for k, nibble in enumerate(nibbles[i : i + 8]))
        for i in range(0, len(nibbles), 8)
    ]
    return struct.pack(f'<II{len(words)}I', *depth.shape[::-1], *words)


def zstd(pixels: NDArray[Any], height: int, encoding: str, really: bool) -> bytes:
    """Return pixels as zstd_image_transport sends them: in zstd, or at first really in gzip."""
    raw = pixels.tobytes()
    if really:
        import zstandard

        packed = zstandard.ZstdCompressor().compress(raw)
    else:
        packed = gzip.compress(raw)
    step = pixels.nbytes // len(pixels)
    head = struct.pack('<IIBII', height, pixels.shape[1], 0, step, len(encoding))
    return head + encoding.encode() + packed
