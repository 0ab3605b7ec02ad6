# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What rosbag2 recorded, message by message, and which topics are an RGB-D camera's.

The reader is `rosbags`, which needs no ROS; nothing is decoded here but the header.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..core.errors import DcgsError
from ..io.ros_images import MessageError
from .source import SourceError

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader
    from rosbags.typesys.store import Typestore

IMAGE = 'sensor_msgs/msg/Image'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'

# What realsense2_camera calls its topics.
COLOR_TOPIC = '/camera/camera/color/image_raw'
DEPTH_TOPIC = '/camera/camera/aligned_depth_to_color/image_raw'

_STAMP_AT = 4  # behind the four bytes that tell the encoding
_FRAME_AT = 16


class RawMessage(NamedTuple):
    """A message as it was on the wire."""

    topic: str
    type: str  # package/msg/Name
    stamp_ns: int  # when it was recorded; its header has its own
    cdr: bytes


@dataclass(frozen=True)
class CameraTopics:
    """Topics of one RGB-D camera."""

    color: str
    depth: str
    camera_info: str | None  # beside colour


def is_bag(path: Path) -> bool:
    """Whether the path is a recording: a folder with its metadata.yaml, an .mcap or a .db3."""
    if path.is_dir():
        return (path / 'metadata.yaml').exists()
    return path.exists() and path.suffix in ('.mcap', '.db3')


def raw_messages(path: Path | str, topics: Collection[str]) -> Iterator[RawMessage]:
    """Messages of those topics in the order they were recorded; raises `SourceError`."""
    with _reading(path) as reader:
        connections = [c for c in reader.connections if c.topic in topics]
        if connections:  # none would mean all of them
            for connection, stamp_ns, cdr in reader.messages(connections):
                yield RawMessage(connection.topic, connection.msgtype, stamp_ns, bytes(cdr))


def camera_topics(path: Path | str) -> CameraTopics:
    """Find the camera: realsense2_camera's names, else what type and name leave but one choice.

    Raises `SourceError` that lists the topics where there is no choice, or more than one.
    """
    with _reading(path) as reader:
        types = {c.topic: c.msgtype for c in reader.connections if c.msgcount}
    images = [topic for topic, type_ in types.items() if type_ == IMAGE]
    infos = [topic for topic, type_ in types.items() if type_ == CAMERA_INFO]
    depths = [topic for topic in images if 'depth' in topic]
    colors = [topic for topic in images if topic not in depths]
    color = _only(colors, COLOR_TOPIC, ('color', 'rgb'))
    depth = _only(depths, DEPTH_TOPIC, ('aligned', 'registered'))
    if color is None or depth is None:
        what = 'colour' if color is None else 'depth'
        have = ', '.join(f'{topic} ({type_})' for topic, type_ in sorted(types.items()))
        raise SourceError(f'{path}: not one topic is the {what} image among {have or "none"}')
    info = color.rsplit('/', 1)[0] + '/camera_info'
    return CameraTopics(color, depth, info if info in infos else None)


def read_header(cdr: bytes) -> tuple[int, str]:
    """Stamp in ns and frame of a message that begins with a header; raises `MessageError`."""
    try:
        order = _byte_order(cdr)
        sec, nanosec, length = struct.unpack_from(f'{order}iII', cdr, _STAMP_AT)
        (name,) = struct.unpack_from(f'{max(length - 1, 0)}s', cdr, _FRAME_AT)
        return sec * 1_000_000_000 + nanosec, name.decode()
    except (IndexError, struct.error, UnicodeDecodeError) as error:
        raise MessageError(f'{len(cdr)} bytes do not begin with a header: {error}') from None


def with_stamp(cdr: bytes, stamp_ns: int) -> bytes:
    """Copy of a message that begins with a header, its stamp replaced."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    stamp = struct.pack(f'{_byte_order(cdr)}iI', sec, nanosec)
    return cdr[:_STAMP_AT] + stamp + cdr[_STAMP_AT + len(stamp) :]


def decode(cdr: bytes, type_: str) -> Any:
    """Message as an object of its fields; raises `MessageError`."""
    from rosbags.serde import SerdeError

    try:
        return _types().deserialize_cdr(cdr, type_)
    except SerdeError as error:
        raise MessageError(f'{len(cdr)} bytes are no {type_}: {error}') from error


@contextmanager
def _reading(path: Path | str) -> Iterator[Reader]:
    """Open a recording; whatever rosbags stumbles over becomes a `SourceError`."""
    try:
        from rosbags.rosbag2 import Reader
    except ImportError as error:
        raise SourceError(
            f"{path}: to read it takes rosbags: pip install 'dcgs_ros[bags]' ({error})"
        ) from error
    try:
        with Reader(Path(path)) as reader:
            yield reader
    except DcgsError:
        raise
    except Exception as error:  # a damaged file fails anywhere in its parsers
        raise SourceError(f'{path}: cannot be read as a rosbag2: {error!r}') from error


@cache
def _types() -> Typestore:
    """Layouts of the messages, the same in every ROS 2."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _byte_order(cdr: bytes) -> str:
    return '<' if cdr[1] & 1 else '>'


def _only(candidates: list[str], default: str, words: tuple[str, ...]) -> str | None:
    """Choose the default, the only one with one of the words in its name, or the only one."""
    if default in candidates:
        return default
    named = [topic for topic in candidates if any(word in topic for word in words)]
    for choice in (named, candidates):
        if len(choice) == 1:
            return choice[0]
    return None
