# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Decoding of PNG and JPEG images; damaged ones are refused rather than filled in."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from .encodings import eight_bits

_COLOR = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
MAX_PIXELS = 2**25  # 8192 x 4096: a larger size is a corrupt number
_PNG, _JPEG, _END_OF_JPEG = b'\x89PNG\r\n\x1a\n', b'\xff\xd8', b'\xff\xd9'
# Segments C0 to CF hold the size, except the tables of Huffman and arithmetic codes, and JPG.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def read_color_file(folder: Path, path: str) -> NDArray[np.uint8]:
    """Read colour (H, W, 3) RGB from a PNG or JPEG; raises `FrameError` naming it."""
    return decode_color(_read(folder, path), path)


def read_depth_file(folder: Path, path: str) -> NDArray[np.uint16]:
    """Read raw depth (H, W) from a 16-bit PNG; raises `FrameError` naming it."""
    return decode_depth(_read(folder, path), path)


def read_grey_file(folder: Path, path: str) -> NDArray[np.uint8]:
    """Read an image of one channel (H, W), of 8 bits; raises `FrameError` naming it."""
    grey: NDArray[np.uint8] = _decode(_read(folder, path), path, cv2.IMREAD_GRAYSCALE)
    return grey


def decode_color(data: bytes, name: str) -> NDArray[np.uint8]:
    """Decode a PNG's or JPEG's bytes to colour (H, W, 3) RGB; raises `FrameError` with `name`."""
    color = _decode(data, name, _COLOR)
    return cv2.cvtColor(color if color.itemsize == 1 else eight_bits(color), cv2.COLOR_BGR2RGB)


def decode_depth(data: bytes, name: str) -> NDArray[np.uint16]:
    """Decode the bytes of a 16-bit PNG to raw depth (H, W); raises `FrameError` with `name`."""
    depth = _decode(data, name, cv2.IMREAD_UNCHANGED)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        channels = 1 if depth.ndim == 2 else depth.shape[2]
        raise FrameError(
            f'{name} has {channels} channel(s) of {8 * depth.itemsize} bits, not one of 16'
        )
    return depth


def is_png_or_jpeg(data: bytes) -> bool:
    """Return whether the bytes begin as a PNG or JPEG does."""
    return data.startswith((_PNG, _JPEG))


def encoded_size(data: bytes, name: str) -> tuple[int, int]:
    """Return the width and height in the header of a PNG or JPEG, without decoding it.

    Decoders allocate by this size, so it is checked first. Raises `FrameError` with `name` for
    anything else, and for a file that is cut off.
    """
    try:
        if data.startswith(_PNG):
            return _png_size(data)
        if data.startswith(_JPEG):
            return _jpeg_size(data)
    except struct.error:
        raise FrameError(f'{name} is cut off after {len(data)} bytes, or damaged') from None
    raise FrameError(f'{name} ({len(data)} bytes) is neither PNG nor JPEG')


def _png_size(data: bytes) -> tuple[int, int]:
    """Walk all chunks, as decoders allocate the length a chunk claims; raises `struct.error`."""
    at, kind = len(_PNG), b''
    while kind != b'IEND':
        length, kind = struct.unpack_from('>I4s', data, at)
        at += 12 + length
    if at > len(data):
        raise struct.error
    width, height = struct.unpack_from('>II', data, 16)
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Walk the segments up to the one with the size; raises `struct.error`."""
    at = 2
    while True:
        mark, kind, length = struct.unpack_from('>BBH', data, at)
        if mark != 0xFF or length < 2:
            raise struct.error
        if kind in _JPEG_FRAMES:
            height, width = struct.unpack_from('>HH', data, at + 5)
            return width, height
        at += 1 if kind == 0xFF else 2 + length  # markers may be padded with 0xFF


def _read(folder: Path, path: str) -> bytes:
    try:
        return (folder / path).read_bytes()
    except OSError as error:
        raise FrameError(f'{path}: {error.strerror}') from error


def _decode(data: bytes, name: str, flags: int) -> NDArray[Any]:
    width, height = encoded_size(data, name)
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameError(f'{name}: {width}x{height} pixels is not a plausible image size')
    # OpenCV fills the missing part of a JPEG with grey.
    if data.startswith(_JPEG) and _END_OF_JPEG not in data[-4096:]:
        raise FrameError(f'{name} is cut off after {len(data)} bytes')
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f'{name} ({len(data)} bytes) cannot be decoded as an image')
    return image
