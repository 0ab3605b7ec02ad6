# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Colour and depth of an Image or a CompressedImage, whatever image_transport's plugin sent it."""

from __future__ import annotations

import struct
import zlib
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import ros_images
from ..ros_images import MessageError, UnknownEncodingError, depth_unit, measured
from ..zstd import ZSTD_MAGIC, unzstd
from .decoding import decode_color, decode_depth, encoded_size, is_png_or_jpeg
from .encodings import COLOR_ENCODINGS
from .rvl import decode_rvl, rvl_size

# The plugins and what they add to the name of the raw topic, the best one to read first.
COLOR_TRANSPORTS = {'raw': '', 'zstd': '/zstd', 'compressed': '/compressed'}
DEPTH_TRANSPORTS = {
    'raw': '',
    'compressedDepth': '/compressedDepth',
    'zstd': '/zstd',
    'compressed': '/compressed',
}
CODECS = {'colour': ('png', 'jpeg'), 'depth': ('png', 'rvl')}  # of the two compressed transports

_PNG = b'\x89PNG\r\n\x1a\n'
_DEPTH_HEADER = struct.Struct('<Iff')  # compressed_depth_image_transport's: format, A, B
# Of zstd_image_transport: height, width, is_bigendian, step, length of the encoding's name.
_ZSTD_HEADER = struct.Struct('<IIBII')
_LONGEST_NAME, _MAX_BYTES = 64, 2**28
_ZLIB_OR_GZIP = zlib.MAX_WBITS | 32
_MOST_ROWS = max(encoding.rows for encoding in COLOR_ENCODINGS.values())


def is_compressed(message: Any) -> bool:
    """Return whether the message is a CompressedImage rather than an Image."""
    return hasattr(message, 'format')


def encoding_of(message: Any) -> str:
    """Return the encoding of the raw image, as far as the message tells."""
    if not is_compressed(message):
        return str(message.encoding)
    if not _is_zstd(message):
        return str(message.format).partition(';')[0].strip()
    try:
        return str(_head(message).encoding)
    except MessageError:
        return ''


def image_size(message: Any) -> tuple[int, int]:
    """Return the width and height in the header; raises `FrameError` or `MessageError`."""
    if not is_compressed(message):
        return ros_images.image_size(message)
    if _is_zstd(message):
        return ros_images.image_size(_head(message))
    _, data = _split(bytes(message.data))
    if _is_rvl(message, data):
        return rvl_size(data, _name('image', message))
    return encoded_size(data, _name('image', message))


def read_color(message: Any) -> NDArray[np.uint8]:
    """Return colour (H, W, 3) RGB or (H, W); raises `FrameError` or `MessageError`.

    A PNG or JPEG has its own colours, whatever the format says of their order; but a Bayer mosaic
    is compressed as it is.
    """
    if not is_compressed(message):
        return ros_images.read_color(message)
    if _is_zstd(message):
        return ros_images.read_color(_unzstd(message))
    data = bytes(message.data)
    _check_codec('colour', message, data)
    color = decode_color(data, _name('colour', message))
    mosaic = COLOR_ENCODINGS.get(message.format.split(';')[0].strip().replace('16', '8'))
    if mosaic is None or not message.format.startswith('bayer_'):
        return color
    is_grey = np.array_equal(color[..., 0], color[..., 1])  # else it was interpolated before
    return mosaic.convert(np.ascontiguousarray(color[..., 0])) if is_grey else color


def read_depth(message: Any, per_metre: float | None = None) -> NDArray[np.float32]:
    """Return depth (H, W) in metres, 0 = none; raises `FrameError` or `MessageError`.

    `per_metre` is the value of a pixel at one metre, by default `depth_unit`. Compressed depth is
    a 16-bit PNG or RVL, with or without compressed_depth_image_transport's header; with one, 32FC1
    is stored as inverse depth: a value q > 0 means A / (q - B).
    """
    if not is_compressed(message):
        return ros_images.read_depth(message, per_metre)
    if _is_zstd(message):
        return ros_images.read_depth(_unzstd(message), per_metre)
    header, data = _split(bytes(message.data))
    if _is_rvl(message, data):
        raw = decode_rvl(data, _name('depth', message))
    else:
        _check_codec('depth', message, data)
        raw = decode_depth(data, _name('depth', message))
    encoding = encoding_of(message)
    unit = np.float32(per_metre or depth_unit(encoding))
    if not (header and encoding == '32FC1'):
        return raw.astype(np.float32) / unit
    _, a, b = _DEPTH_HEADER.unpack(header)
    with np.errstate(all='ignore'):  # A and B may be damaged
        depth_m = np.float32(a) / (raw.astype(np.float32) - np.float32(b))
    depth_m[raw == 0] = 0.0
    return measured(depth_m / unit)


def _name(what: str, message: Any) -> str:
    return f'{what} ({message.format[:40]})'


def _check_codec(what: str, message: Any, data: bytes) -> None:
    """Raise `UnknownEncodingError` for what is no damaged PNG or JPEG either."""
    said = message.format.lower()
    if not is_png_or_jpeg(data) and not any(name in said for name in ('png', 'jp', 'compressedd')):
        known = ', '.join((*CODECS[what], 'zstd'))
        raise UnknownEncodingError(
            f'{what} is compressed as {message.format[:40]!r}, not as one of {known}'
        )


def _split(data: bytes) -> tuple[bytes, bytes]:
    """Split compressed depth into its header, empty if there is none, and the image."""
    size = _DEPTH_HEADER.size
    return (b'', data) if is_png_or_jpeg(data) else (data[:size], data[size:])


def _is_rvl(message: Any, data: bytes) -> bool:
    return 'rvl' in message.format.lower() and not data.startswith(_PNG)


def _is_zstd(message: Any) -> bool:
    return 'zstd' in message.format.lower()


def _head(message: Any) -> Any:
    """Return the Image within, its data still compressed; raises `MessageError`."""
    data, size = bytes(message.data), _ZSTD_HEADER.size
    if len(data) < size:
        raise MessageError(f'{len(data)} bytes do not begin as zstd_image_transport sends them')
    height, width, big, step, length = _ZSTD_HEADER.unpack_from(data)
    encoding = data[size : size + min(length, _LONGEST_NAME)].decode('ascii', 'replace')
    return SimpleNamespace(
        width=width, height=height, is_bigendian=big, step=step, encoding=encoding,
        data=data[size + length :],
    )  # fmt: skip


def _unzstd(message: Any) -> Any:
    """Return the Image within; raises `MessageError`."""
    image = _head(message)
    limit = int(_MOST_ROWS * image.step * image.height)
    if limit > _MAX_BYTES:
        raise MessageError(f'{image.height} rows of {image.step} bytes are no plausible image')
    try:
        if image.data.startswith(ZSTD_MAGIC):
            image.data = unzstd(image.data, limit)
        else:  # what the transport sent at first, despite its name
            image.data = zlib.decompressobj(_ZLIB_OR_GZIP).decompress(image.data, limit)
    except ImportError as error:
        raise MessageError(
            f'zstd needs one more package: pip install zstandard ({error})'
        ) from None
    except (ValueError, zlib.error) as error:
        raise MessageError(f'{image.encoding} in zstd: {error}') from None
    return image
