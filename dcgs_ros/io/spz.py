# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Gaussians as SPZ files: 20 bytes each before gzip.

The axes are those of the PLY, as in the files of SuperSplat and most other tools. The format's
specification has y up and z backward, which no file tells.
"""

from __future__ import annotations

import gzip
import math
import os
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError
from ..core.mapping.splats import PLANES, Splats
from .quantized import Floats, opacity_logits, smallest_three, unit_quaternions
from .whole_files import replacing

# Magic, version, Gaussians, degree of harmonics, fractional bits, flags, streams (version 4).
_HEADER = struct.Struct('<4sII4B')
_MAGIC = b'NGSP'
_GZIP = b'\x1f\x8b'
_VERSIONS = (2, 3, 4)
_WRITTEN = 3  # which most readers have
_ZSTD = 4  # each stream compressed by itself, after a table of contents
_TABLE = struct.Struct('<I12x')  # its offset
_ENTRY = struct.Struct('<QQ')  # of the table: size packed, size
_STREAMS = (9, 1, 3, 3, 4)  # bytes a Gaussian: position, opacity, colour, scales, rotation
_FRACTION_BITS = 12  # of positions: 0.24 mm, within 2 km
_POSITION_BITS = 24  # with the sign
_MAX_RATIO, _MIN_LIMIT = 64, 1 << 26  # of unpacked to packed bytes; bytes unpacked in any case
_STEP = 1 << 20  # bytes
_COLOR_RANGE = 0.15
_MAGNITUDE = 511 * math.sqrt(2.0)  # nine bits for up to 1/sqrt(2)


class SpzError(DcgsError):
    """A file is not an SPZ, or Gaussians cannot be written as one."""


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    fraction_bits: int
    streams: int  # in version 4

    def sizes(self) -> list[int]:
        """Return the bytes of each stream that is read."""
        rotation = 3 if self.version == 2 else 4
        return [self.count * size for size in (*_STREAMS[:4], rotation)]


def write_spz(path: Path | str, splats: Splats) -> None:
    """Write version 3. Sizes are rounded to 6 %, colours and opacities to 8 bits.

    The file is written completely or not at all. Raises `SpzError` if it cannot be written, or if
    Gaussians are not finite.
    """
    path = Path(path)
    bad = np.count_nonzero(~np.isfinite(splats.planes).all(axis=0))
    if bad:
        raise SpzError(f'{path}: not written: {bad} of {len(splats)} Gaussians are not finite')
    farthest_m = float(np.abs(splats.means).max(initial=1.0))
    bits = min(_FRACTION_BITS, math.floor(math.log2((2 ** (_POSITION_BITS - 1) - 1) / farthest_m)))
    if bits < 0:
        raise SpzError(f'{path}: not written: positions up to {farthest_m:.3g} m are too far')
    header = _HEADER.pack(_MAGIC, _WRITTEN, len(splats), 0, bits, 0, 0)
    data = b''.join([header, *_encoded(splats, bits)])
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(gzip.compress(data, mtime=0))
    except OSError as error:
        raise SpzError(f'{path}: cannot be written: {error.strerror or error}') from error


def read_spz(path: Path | str, warn: Callable[[str], None] = warnings.warn) -> Splats:
    """Read versions 2 to 4; of the spherical harmonics only degree 0.

    Raises `SpzError` naming the file and what is wrong with it. Nothing needs a warning: all that
    the format can hold is finite.
    """
    try:
        with open(path, 'rb') as file:
            packed = file.read(2) == _GZIP
            file.seek(0)
            header, streams = _read(gzip.GzipFile(fileobj=file) if packed else file, file)
            return Splats(_decode(header, *streams))
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise SpzError(f'{path}: its gzip is broken: {error}') from error
    except OSError as error:
        raise SpzError(f'{path}: cannot be read: {error.strerror or error}') from error
    except SpzError as error:
        raise SpzError(f'{path}: {error}') from None


def _encoded(splats: Splats, fraction_bits: int) -> Iterator[bytes]:
    """Return the streams."""
    fixed = np.rint(splats.means.T * 2.0**fraction_bits).astype('<i4', order='C')
    yield fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    with np.errstate(over='ignore'):
        yield _bytes(255 / (1 + np.exp(-splats.opacity_logits)))
    yield _bytes(splats.sh_dc.T * (_COLOR_RANGE * 255) + 127.5)
    yield _bytes((splats.log_scales.T + 10) * 16)
    w, x, y, z = splats.quats_wxyz.astype(np.float64)
    quats = np.stack([x, y, z, w])
    quats /= np.maximum(np.linalg.norm(quats, axis=0), np.finfo(float).tiny)
    largest = np.abs(quats).argmax(axis=0)
    quats *= np.where(np.take_along_axis(quats, largest[None], axis=0) < 0, -1, 1)
    others = quats.T[np.arange(4) != largest[:, None]].reshape(-1, 3).T
    codes = np.rint(_MAGNITUDE * np.abs(others)).astype('<u4')
    a, b, c = codes | (others < 0).astype('<u4') << 9
    yield (largest.astype('<u4') << 30 | a << 20 | b << 10 | c).tobytes()


def _bytes(values: NDArray[np.floating]) -> bytes:
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8).tobytes()


def _read(
    stream: BinaryIO | gzip.GzipFile, file: BinaryIO
) -> tuple[_Header, list[NDArray[np.uint8]]]:
    """Read the header and the first five streams; `stream` is the file, or what it unpacks to."""
    header = _read_header(stream)
    sizes, size = header.sizes(), os.fstat(file.fileno()).st_size
    limit = max(_MAX_RATIO * size, _MIN_LIMIT)
    if sum(sizes) > limit:
        raise SpzError(f'{header.count} Gaussians are more than its {size} bytes can hold')
    parts = _unzstd(file, header) if header.version >= _ZSTD else map(stream.read, sizes)
    streams = []
    for part, needed in zip(parts, sizes, strict=True):
        if len(part) < needed:
            raise SpzError(f'ends within its {header.count} Gaussians')
        streams.append(np.frombuffer(part, np.uint8))
    while stream.read(_STEP) and stream.tell() < limit:
        pass  # gzip's checksum is at its end
    return header, streams


def _read_header(stream: BinaryIO | gzip.GzipFile) -> _Header:
    head = stream.read(_HEADER.size)
    if len(head) < _HEADER.size or not head.startswith(_MAGIC):
        raise SpzError(f'no SPZ: begins with {head[:12]!r}')
    _, version, count, _, bits, _, streams = _HEADER.unpack(head)
    if version not in _VERSIONS:
        raise SpzError(f'is of version {version}; versions 2 to 4 are read')
    if bits > _POSITION_BITS:
        raise SpzError(f'{bits} of the {_POSITION_BITS} bits of positions are fraction')
    return _Header(version, count, bits, streams)


def _unzstd(file: BinaryIO, header: _Header) -> Iterator[bytes]:
    """Yield the first five streams of a version 4; a broken one is short."""
    try:
        import zstandard
    except ImportError as error:
        raise SpzError(
            f"version 4 needs one more package: pip install 'dcgs_ros[bags]' ({error})"
        ) from error
    (offset,) = _TABLE.unpack(file.read(_TABLE.size).ljust(_TABLE.size, b'\0'))
    file.seek(offset)
    table = file.read(_ENTRY.size * header.streams).ljust(_ENTRY.size * len(_STREAMS), b'\0')
    for index, needed in enumerate(header.sizes()):
        packed, _ = _ENTRY.unpack_from(table, _ENTRY.size * index)
        left = os.fstat(file.fileno()).st_size - file.tell()
        data = file.read(max(0, min(packed, left)))
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            try:
                yield reader.read(needed)
            except zstandard.ZstdError as error:
                raise SpzError(f'its zstd is broken: {error}') from error


def _decode(
    header: _Header,
    position: NDArray[np.uint8],
    opacity: NDArray[np.uint8],
    color: NDArray[np.uint8],
    scale: NDArray[np.uint8],
    rotation: NDArray[np.uint8],
) -> NDArray[np.float32]:
    """Return planes (14, N) of the streams."""
    low, middle, high = position.reshape(-1, 3, 3).astype(np.int32).transpose(2, 1, 0)
    fixed = low | middle << 8 | high.astype(np.int8).astype(np.int32) << 16
    x, y, z, w = _quaternions(header.version, rotation)
    planes = np.empty((len(PLANES), header.count), np.float32)
    planes[0:3] = fixed / 2.0**header.fraction_bits
    planes[3:6] = scale.reshape(-1, 3).T / 16 - 10
    planes[6:10] = w, x, y, z
    planes[10] = opacity_logits(opacity / 255)
    planes[11:14] = (color.reshape(-1, 3).T / 255 - 0.5) / _COLOR_RANGE
    return planes


def _quaternions(version: int, rotation: NDArray[np.uint8]) -> Floats:
    """Return quaternions (4, N), xyzw."""
    if version == 2:
        others = rotation.reshape(-1, 3).T / 127.5 - 1
        return unit_quaternions(np.full(others.shape[1], 3), others)
    largest, codes = smallest_three(rotation.view('<u4'))
    return unit_quaternions(largest, np.where(codes & 512, -1, 1) * (codes & 511) / _MAGNITUDE)
