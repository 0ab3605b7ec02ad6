# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ScanNet's .sens files, version 4: a header, the RGB-D frames, the IMU's measurements.

The layout is that of SensReader in ScanNet's repository, little-endian throughout. Sizes in the
file are checked against the file's own size before anything is read by them.
"""

from __future__ import annotations

import os
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FrameError
from ..images.association import MAX_PAIR_GAP_NS
from ..images.indexed_frames import stamp_of_index
from ..source import ImuSample, SourceError
from .sens_images import (
    JPEG_COLOR,
    OCCI_DEPTH,
    RAW_COLOR,
    RAW_DEPTH,
    ZLIB_DEPTH,
    color_of,
    depth_of,
)

_VERSION = 4
_MAX_NAME = 4096  # bytes of the sensor's name
_MAX_SIDE = 8192  # pixels: a larger image means a broken header
_MAX_BLOB = 2**26  # bytes of one stored image; ScanNet's have up to half a megabyte
_MAX_STAMP_US = 2**62 // 1000
_MAX_PER_METRE = 1e6

_START = struct.Struct('<IQ')  # version, length of the sensor's name
_CALIBRATION_BYTES = 4 * 16 * 4
_FORMAT = struct.Struct('<ii4IfQ')  # compressions, sizes, depth per metre, number of frames
_FRAME = np.dtype(
    [
        ('T_world_cam', '<f4', (4, 4)),
        ('color_us', '<u8'),
        ('depth_us', '<u8'),
        ('color_bytes', '<u8'),
        ('depth_bytes', '<u8'),
    ]
)
# Rotation rate, acceleration, magnetic field, attitude, gravity; microseconds.
_IMU = struct.Struct('<15dQ')


@dataclass(frozen=True)
class SensFile:
    """The headers of a .sens file; `read_images` reads the images one by one."""

    path: Path
    calibration: NDArray[np.float32]  # (4, 4, 4) K_color, T_rig_color, K_depth, T_rig_depth
    color_type: int
    depth_type: int
    color_size: tuple[int, int]  # width and height, pixels
    depth_size: tuple[int, int]
    depth_per_metre: float
    frames: NDArray[Any]  # (N,) of _FRAME: the complete frames
    offsets: NDArray[np.int64]  # (N,) bytes, of their images
    loss: str | None  # why there are fewer frames than the header says
    rate_hz: float | None = None  # instead of the stamps

    def read_images(
        self, file: BinaryIO, number: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Read colour (H, W, 3) RGB and raw depth (h, w) of frame `number`, from 0.

        Raises `FrameError`.
        """
        sizes = [int(self.frames[number][name]) for name in ('color_bytes', 'depth_bytes')]
        if max(sizes) > _MAX_BLOB:
            raise FrameError(f'{max(sizes)} bytes are not an image, which has at most {_MAX_BLOB}')
        file.seek(int(self.offsets[number]))
        color, depth = (file.read(size) for size in sizes)
        return (
            color_of(color, self.color_type, self.color_size),
            depth_of(depth, self.depth_type, self.depth_size),
        )

    def stamps_ns(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return stamps (N,) of colour and depth: the file's if they increase, else at a rate.

        That is `rate_hz`, also where they increase, or 30 Hz.

        Depth gets colour's stamps if its own are not of the same clock.
        """
        color_us, depth_us = self.frames['color_us'], self.frames['depth_us']
        if self.rate_hz is not None or not _increase(color_us):
            indices = range(len(self.frames))
            stamps_ns = np.array([stamp_of_index(k, self.rate_hz) for k in indices], np.int64)
            return stamps_ns, stamps_ns
        color_ns, depth_ns = (us.astype(np.int64) * 1000 for us in (color_us, depth_us))
        if _increase(depth_us) and np.abs(depth_ns - color_ns).max() <= MAX_PAIR_GAP_NS:
            return color_ns, depth_ns
        return color_ns, color_ns

    def imu(self) -> Iterator[ImuSample]:
        """Read the rotation rates. Accelerations are left out, as their unit is not documented."""
        if self.loss is not None or not _increase(self.frames['color_us']):
            return  # the file is cut off before them, or there is no common clock
        with open_binary(self.path) as file:
            last = self.frames[-1]
            file.seek(int(self.offsets[-1]) + int(last['color_bytes']) + int(last['depth_bytes']))
            left, last_us = int.from_bytes(file.read(8), 'little'), -1
            while left > 0 and len(raw := file.read(_IMU.size)) == _IMU.size:
                left -= 1
                x, y, z, *_, stamp_us = _IMU.unpack(raw)
                if last_us < stamp_us <= _MAX_STAMP_US and np.isfinite((x, y, z)).all():
                    last_us = stamp_us
                    yield ImuSample(1000 * stamp_us, 'imu', None, (x, y, z))


def open_binary(path: Path) -> BinaryIO:
    """Open a file for reading; raises `SourceError`."""
    try:
        return path.open('rb')
    except OSError as error:
        raise SourceError(f'{path}: cannot be read: {error.strerror}') from error


def read_sens(path: Path) -> SensFile:
    """Read the header and find the frames; raises `SourceError` with what is wrong."""
    with open_binary(path) as file:
        version, length = _START.unpack(_exactly(file, _START.size))
        if version != _VERSION or length > _MAX_NAME:
            raise SourceError(
                f'{path}: version {version} with a name of {length} bytes is not a .sens file of '
                f'version {_VERSION}'
            )
        _exactly(file, length)
        calibration = np.frombuffer(_exactly(file, _CALIBRATION_BYTES), '<f4').reshape(4, 4, 4)
        color_type, depth_type, *sides, depth_per_metre, count = _FORMAT.unpack(
            _exactly(file, _FORMAT.size)
        )
        _check(path, (color_type, depth_type), sides, depth_per_metre)
        frames, offsets, loss = _walk(file, count)
    if not len(frames):
        raise SourceError(f'{path}: holds no frame: {loss or "its header counts none"}')
    return SensFile(
        path=path,
        calibration=calibration,
        color_type=color_type,
        depth_type=depth_type,
        color_size=(sides[0], sides[1]),
        depth_size=(sides[2], sides[3]),
        depth_per_metre=depth_per_metre,
        frames=frames,
        offsets=offsets,
        loss=loss,
    )


def _exactly(file: BinaryIO, size: int) -> bytes:
    if len(data := file.read(size)) < size:
        raise SourceError(f'{file.name}: ends after {file.tell()} bytes, within its header')
    return data


def _check(path: Path, kinds: tuple[int, int], sides: list[int], depth_per_metre: float) -> None:
    """Check that compressions, image sizes and unit are plausible; raises `SourceError`."""
    color_type, depth_type = kinds
    if depth_type == OCCI_DEPTH:
        raise SourceError(f'{path}: its depth is compressed as OCCI, which is not supported')
    if not (RAW_COLOR <= color_type <= JPEG_COLOR and depth_type in (RAW_DEPTH, ZLIB_DEPTH)):
        raise SourceError(f'{path}: compressions {color_type}, {depth_type} are unknown')
    if not all(0 < side <= _MAX_SIDE for side in sides):
        raise SourceError(
            f'{path}: images of {sides[0]}x{sides[1]} and {sides[2]}x{sides[3]} pixels; '
            f'a side has 1 to {_MAX_SIDE}'
        )
    if not 1 <= depth_per_metre <= _MAX_PER_METRE:
        raise SourceError(
            f'{path}: {depth_per_metre} units of depth per metre, not 1 to {_MAX_PER_METRE:.0f}'
        )


def _walk(file: BinaryIO, count: int) -> tuple[NDArray[Any], NDArray[np.int64], str | None]:
    """Return headers (N,) and image offsets (N,) of complete frames, and why N < count."""
    end = os.fstat(file.fileno()).st_size
    headers, offsets, loss = bytearray(), array('q'), None
    position = file.tell()
    while len(offsets) < count:
        file.seek(position)
        header = file.read(_FRAME.itemsize)
        position += _FRAME.itemsize
        sizes = struct.unpack_from('<QQ', header, 80) if len(header) == _FRAME.itemsize else ()
        if not sizes or position + sum(sizes) > end:
            loss = (
                f'the file ends at {end} bytes, within frame {len(offsets) + 1} of {count}, '
                f'whose images would begin at {position}'
            )
            break
        headers += header
        offsets.append(position)
        position += sum(sizes)
    return np.frombuffer(bytes(headers), _FRAME), np.array(offsets, np.int64), loss


def _increase(stamps_us: NDArray[np.uint64]) -> bool:
    """Return whether these are usable stamps, rather than zeros or noise."""
    return bool((stamps_us[1:] > stamps_us[:-1]).all() and 0 < stamps_us[-1] < _MAX_STAMP_US)
