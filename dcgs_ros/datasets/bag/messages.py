# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Recorded messages: their types, headers and fields, read without ROS."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

from ...io.ros_images import MessageError
from ..source import SourceError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
IMU = 'sensor_msgs/msg/Imu'
ODOMETRY = 'nav_msgs/msg/Odometry'
POSE = 'geometry_msgs/msg/PoseStamped'
EXTRINSICS = 'realsense2_camera_msgs/msg/Extrinsics'
_EXTRINSICS_FIELDS = 'float64[9] rotation\nfloat64[3] translation\n'

_STAMP_AT = 4  # byte, after the four that tell the encoding
_FRAME_AT = 16


class RawMessage(NamedTuple):
    """A message as it was recorded, not yet decoded."""

    topic: str
    type: str  # package/msg/Name
    stamp_ns: int  # when it was recorded; its header has another stamp
    cdr: bytes


def read_header(cdr: bytes) -> tuple[int, str]:
    """Return stamp in ns and frame of a message that begins with a header.

    Raises `MessageError`.
    """
    try:
        order = _byte_order(cdr)
        sec, nanosec, length = struct.unpack_from(f'{order}iII', cdr, _STAMP_AT)
        (name,) = struct.unpack_from(f'{max(length - 1, 0)}s', cdr, _FRAME_AT)
        return sec * 1_000_000_000 + nanosec, name.decode()
    except (IndexError, struct.error, UnicodeDecodeError) as error:
        raise MessageError(f'{len(cdr)} bytes do not begin with a header: {error}') from None


def with_stamp(cdr: bytes, stamp_ns: int) -> bytes:
    """Return a copy of a message that begins with a header, with another stamp."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    stamp = struct.pack(f'{_byte_order(cdr)}iI', sec, nanosec)
    return cdr[:_STAMP_AT] + stamp + cdr[_STAMP_AT + len(stamp) :]


def decode(cdr: bytes, type_: str) -> Any:
    """Return the message as an object with its fields; raises `MessageError`."""
    with as_source_error():
        types = message_types()
    try:
        return types.deserialize_cdr(cdr, type_)
    except Exception as error:  # SerdeError, and what rosbags does not catch
        raise MessageError(f'{len(cdr)} bytes are not a {type_}: {error}') from error


@cache
def message_types() -> Typestore:
    """Return the definitions of the message types, ROS 2's and the RealSense's own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(_EXTRINSICS_FIELDS, EXTRINSICS))
    return store


@contextmanager
def as_source_error() -> Iterator[None]:
    """Convert errors of the system, and of packages that are not installed, to `SourceError`."""
    try:
        yield
    except OSError as error:
        raise SourceError(str(error)) from error
    except ImportError as error:
        raise SourceError(
            f"this needs more packages: pip install 'dcgs_ros[bags]' ({error})"
        ) from error


def _byte_order(cdr: bytes) -> str:
    return '<' if cdr[1] & 1 else '>'
