# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ROS's Image and CameraInfo as arrays, for messages decoded by rclpy or by a reader of bags.

Only attributes are read, so ROS is not needed. Every size is checked against the data before
anything is allocated.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.camera import PinholeCamera
from ..core.errors import DcgsError
from ..core.lens_camera import Camera, make_camera
from .images.encodings import COLOR_ENCODINGS

_MAX_SIDE = 16384  # pixels: a larger image means a broken header
_MAX_COEFFICIENTS = 14  # rational_polynomial's

DEPTH_ENCODINGS = {'16UC1': 'u2', 'mono16': 'u2', '32FC1': 'f4'}
_LENS_MODELS = ('', 'plumb_bob', 'rational_polynomial')
_FISHEYE_MODELS = ('equidistant', 'fisheye', 'kannala_brandt', 'kannala_brandt4')
MM_PER_M = 1000.0
_RECTIFIED = re.compile('(^|[/_])rect([/_]|$)')
_MAX_M = np.float32(65.535)  # the largest depth in 16 bits of millimetres
_SPARSE = 16  # pixels, between those checked first


class MessageError(DcgsError):
    """A message cannot be used."""


class UnknownEncodingError(MessageError):
    """No image that is encoded so can be read."""


def stamp_ns(stamp: Any) -> int:
    """Return the time of a header in integer nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def image_size(image: Any) -> tuple[int, int]:
    """Return width and height of an Image, even if its height counts the rows of all planes.

    Raises `MessageError` if these are not plausible.
    """
    width, height = _size(image)
    encoding = COLOR_ENCODINGS.get(image.encoding)
    if encoding is None or encoding.rows == 1:
        return width, height
    whole = image.step * height == len(image.data) and image.step < encoding.rows * width
    return width, int(height / encoding.rows) if whole else height


def read_color(image: Any) -> NDArray[np.uint8]:
    """Return colour of an Image in one of `COLOR_ENCODINGS`: (H, W, 3) RGB or (H, W), in C order.

    If no conversion is needed, it is a view of the message's data. Raises `MessageError`.
    """
    encoding = COLOR_ENCODINGS.get(image.encoding)
    if encoding is None:
        raise _unknown('colour', image.encoding, COLOR_ENCODINGS)
    size = image_size(image)
    if any(side % pixels for side, pixels in zip(size, encoding.block, strict=True)):
        raise MessageError(
            f'{image.encoding} of {size[0]}x{size[1]} pixels is not whole blocks of '
            f'{encoding.block[0]}x{encoding.block[1]}'
        )
    pixels = _pixels(image, _type(image, encoding.kind), encoding.channels, encoding.rows)
    return encoding.convert(pixels)


def depth_unit(encoding: str) -> float:
    """Return the value at one metre of a depth image: 1 of 32FC1, 1000 of 16 bits (REP 118)."""
    return 1.0 if encoding.startswith('32FC1') else MM_PER_M


def read_depth(image: Any, per_metre: float | None = None) -> NDArray[np.float32]:
    """Return depth (H, W) in metres, 0 = none, of an Image in 16UC1, mono16 or 32FC1.

    `per_metre` is the value of a pixel at one metre, by default `depth_unit`. Negative and
    non-finite values count as none. Raises `MessageError`.
    """
    kind = DEPTH_ENCODINGS.get(image.encoding)
    if kind is None:
        raise _unknown('depth', image.encoding, DEPTH_ENCODINGS)
    raw = _pixels(image, _type(image, kind), 1)
    unit = np.float32(per_metre or depth_unit(image.encoding))
    if kind == 'u2':
        return raw.astype(np.float32) / unit
    depth_m = raw.astype(np.float32)
    return measured(depth_m if unit == 1 else depth_m / unit)


def measured(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Set values that are not finite and positive to 0, in place."""
    depth_m[~((depth_m > 0) & (depth_m < np.inf))] = 0.0
    return depth_m


def in_millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert depth (H, W) in metres to 16UC1, rounded; 0 for none and beyond 65.535 m."""
    usable = (depth_m > 0) & (depth_m <= _MAX_M)
    return np.rint(np.where(usable, depth_m, 0) * np.float32(MM_PER_M)).astype(np.uint16)


def exact_millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16] | None:
    """Convert depth (H, W) in metres to 16UC1; None if that is not exact."""
    for part in (depth_m[::_SPARSE, ::_SPARSE], depth_m):  # a few pixels first, for speed
        depth_mm = in_millimetres(part)
        if not np.array_equal(depth_mm / np.float32(MM_PER_M), part):
            return None
    return depth_mm


def exact_pixels(depth_m: NDArray[np.float32]) -> tuple[str, NDArray[Any]]:
    """Return an encoding that holds depth (H, W) in metres exactly, and its pixels (H, W).

    That is 16UC1, as cameras send it, if all depths are whole millimetres, else 32FC1.
    """
    depth_mm = exact_millimetres(depth_m)
    return ('32FC1', in_metres(depth_m)) if depth_mm is None else ('16UC1', depth_mm.astype('<u2'))


def in_metres(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Convert depth (H, W) in metres to 32FC1, where none is NaN (REP 118)."""
    return np.where(depth_m > 0, depth_m, np.nan).astype('<f4')


def is_rectified(topic: str) -> bool:
    """Return whether a topic's images are rectified, by image_proc's names: image_rect ..."""
    return _RECTIFIED.search(topic.lower()) is not None


def read_camera(info: Any, rectified: bool = False) -> Camera:
    """Return the camera of a CameraInfo, ROS 1's (K, D, P) or ROS 2's (k, d, p).

    That of `rectified` images is P's, where it has one. If all coefficients are zero, the lens
    model may have any name. Raises `MessageError` for an unknown lens model, skew or an
    implausible size, and `CameraError` for invalid intrinsics.
    """
    size = _size(info)
    matrix = info.k if hasattr(info, 'k') else info.K
    distortion = info.d if hasattr(info, 'd') else info.D
    P: Any = info.p if hasattr(info, 'p') else getattr(info, 'P', ())
    if rectified and len(P) == 12 and P[0]:
        matrix, distortion = [*P[0:3], *P[4:7]], ()
    fx, skew, cx, _, fy, cy = (float(value) for value in matrix[:6])
    if skew != 0:
        raise MessageError(f'camera matrix has a skew of {skew:.6g} pixels, not 0')
    if len(distortion) > _MAX_COEFFICIENTS:
        raise MessageError(
            f'distortion has {len(distortion)} numbers, at most {_MAX_COEFFICIENTS} are supported'
        )
    coefficients = tuple(float(value) for value in distortion)
    fisheye = info.distortion_model in _FISHEYE_MODELS
    if not any(coefficients):
        coefficients, fisheye = (), False
    elif not fisheye and info.distortion_model not in _LENS_MODELS:
        raise MessageError(
            f'distortion model {info.distortion_model[:40]!r} is not supported; these are: '
            f'{", ".join(name or "(none)" for name in (*_LENS_MODELS, *_FISHEYE_MODELS))}'
        )
    return make_camera(size, (fx, fy, cx, cy), coefficients, fisheye)


class CameraFields(NamedTuple):
    """The fields of a CameraInfo besides the size; matrices are row by row."""

    model: str
    D: NDArray[np.float64]
    K: NDArray[np.float64]  # (9,)
    R: NDArray[np.float64]  # (9,) the identity
    P: NDArray[np.float64]  # (12,) K and zeros: there is no rectification


def camera_fields(camera: PinholeCamera) -> CameraFields:
    """Return the fields for a camera; plumb_bob has five coefficients, filled up with zeros."""
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    P = np.hstack([K, np.zeros((3, 1))])
    rational = len(camera.distortion) > 5
    model = 'rational_polynomial' if rational else 'plumb_bob'
    D = camera.parameters[4:] if rational else camera.parameters[4:9]
    return CameraFields(model, D, K.ravel(), np.eye(3).ravel(), P.ravel())


def _unknown(what: str, encoding: object, known: Iterable[str]) -> UnknownEncodingError:
    return UnknownEncodingError(f'{what} is {str(encoding)[:40]!r}, not one of {", ".join(known)}')


def _type(image: Any, kind: str) -> np.dtype[Any]:
    return np.dtype(('>' if image.is_bigendian else '<') + kind)


def _size(message: Any) -> tuple[int, int]:
    """Return width and height; raises `MessageError` if these are not plausible."""
    width, height = int(message.width), int(message.height)
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise MessageError(f'image of {width}x{height} pixels; a side has 1 to {_MAX_SIDE}')
    return width, height


def _pixels(image: Any, kind: np.dtype[Any], channels: int, rows: float = 1.0) -> NDArray[Any]:
    """Return a view (rows * H, W) or (H, W, channels) of an Image's data; rows may be padded."""
    width, height = image_size(image)
    step, row, stored = int(image.step), width * channels * kind.itemsize, int(rows * height)
    if rows > 1 and step * stored > len(image.data):  # the step counts all planes
        step = width
    if step < row:
        raise MessageError(
            f'{width} pixels of {image.encoding} are {row} bytes, but a row has {step}'
        )
    if len(image.data) < step * stored:
        raise MessageError(
            f'{stored} rows of {step} bytes are {step * stored}, but there are {len(image.data)}'
        )
    shape: tuple[int, ...] = (stored, width)
    strides: tuple[int, ...] = (step, channels * kind.itemsize)
    if channels > 1:
        shape, strides = (*shape, channels), (*strides, kind.itemsize)
    return np.ndarray(shape, kind, np.frombuffer(image.data, np.uint8), 0, strides)
