# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What was recorded, message by message, by ROS 2 or ROS 1, whole or damaged.

None of it needs ROS.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ...io.ros_images import MessageError
from ..source import SourceError
from .storage.compression import plain_file
from .storage.files import DamagedError, RawMessage, find_files, is_bag, storage_of
from .storage.mcap import mcap_types, read_mcap, read_mcap_heads
from .storage.ros1 import read_ros1, ros1_types
from .storage.sqlite import read_sqlite, sqlite_types

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

__all__ = [
    'CAMERA_INFO',
    'EXTRINSICS',
    'IMAGE',
    'DamagedError',
    'RawMessage',
    'custom_data',
    'decode',
    'is_bag',
    'message_types',
    'raw_messages',
    'read_header',
    'topic_types',
    'with_stamp',
]

IMAGE = 'sensor_msgs/msg/Image'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
EXTRINSICS = 'realsense2_camera_msgs/msg/Extrinsics'
_EXTRINSICS = 'float64[9] rotation\nfloat64[3] translation\n'

_STAMP_AT = 4  # behind the four bytes that tell the encoding
_FRAME_AT = 16


class _Storage(NamedTuple):
    """How files of one kind are read."""

    # Reads messages of those topics or all; tells what is lost; raises where nothing can be read.
    read: Callable[[Path, Collection[str] | None, list[str]], Iterator[RawMessage]]
    types: Callable[[Path], dict[str, str] | None]  # at once, or none


_STORAGES = {
    '.mcap': _Storage(read_mcap, mcap_types),
    '.db3': _Storage(read_sqlite, sqlite_types),
    '.bag': _Storage(read_ros1, ros1_types),
}


def raw_messages(
    path: Path | str, topics: Collection[str] | None, heads: bool = False
) -> Iterator[RawMessage]:
    """Messages of those topics, or all, in the order they were recorded.

    Messages of ROS 1 are converted to CDR. With `heads` of a long one there may be no more than
    its header, where that is quicker. What is damaged is left out, and told at the end by a
    `DamagedError`; raises `SourceError` where there is nothing to read at all.
    """
    recording = find_files(Path(path))
    losses = [f'{name} is missing' for name in recording.missing]
    unusable = count = 0
    for file in recording.files:
        found: list[str] = []
        try:
            for message in _file_messages(file, topics, found, heads):
                count += 1
                yield message
        except SourceError as error:
            found.append(str(error))
            unusable += 1
        losses += [f'{file.name}: {loss}' for loss in found]
    if not count and unusable == len(recording.files):
        raise SourceError(f'{path}: cannot be read: {"; ".join(losses)}')
    if losses:
        known = [n for topic, n in recording.counts.items() if topics is None or topic in topics]
        whole = f' of {sum(known)}' if sum(known) >= count else ''
        more = f' (and {len(losses) - 1} more)' if len(losses) > 1 else ''
        raise DamagedError(f'{path}: {count}{whole} messages could be read: {losses[0]}{more}')


def topic_types(path: Path | str) -> dict[str, str]:
    """Types (package/msg/Name) of the topics that hold messages; raises `SourceError`.

    A damaged recording is read for it.
    """
    types: dict[str, str] = {}
    errors = []
    files = find_files(Path(path)).files
    for file in files:
        try:
            with _refusals(), plain_file(file) as plain:
                found = _STORAGES[storage_of(file)].types(plain)
            if found is None:
                found = {m.topic: m.type for m in _file_messages(file, None, [])}
            types.update(found)
        except SourceError as error:
            errors.append(f'{file.name}: {error}')
    if len(errors) == len(files):
        raise SourceError(f'{path}: cannot be read: {"; ".join(errors)}')
    return types


def custom_data(path: Path | str) -> dict[str, str]:
    """Read what the recorder noted in metadata.yaml of its own; raises `SourceError`."""
    return find_files(Path(path)).custom_data


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
    with _refusals():
        types = message_types()
    try:
        return types.deserialize_cdr(cdr, type_)
    except Exception as error:  # SerdeError, and what rosbags does not foresee
        raise MessageError(f'{len(cdr)} bytes are no {type_}: {error}') from error


def _file_messages(
    file: Path, topics: Collection[str] | None, losses: list[str], heads: bool = False
) -> Iterator[RawMessage]:
    """Read a file."""
    kind = storage_of(file)
    read = read_mcap_heads if heads and kind == '.mcap' else _STORAGES[kind].read
    with _refusals(), plain_file(file) as plain:
        yield from read(plain, topics, losses)


@contextmanager
def _refusals() -> Iterator[None]:
    """Turn what the system refuses and what is not installed into a `SourceError`."""
    try:
        yield
    except OSError as error:
        raise SourceError(str(error)) from error
    except ImportError as error:
        raise SourceError(f"that takes more: pip install 'dcgs_ros[bags]' ({error})") from error


@cache
def message_types() -> Typestore:
    """Layouts of the messages, the same in every ROS 2, and the RealSense's own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(_EXTRINSICS, EXTRINSICS))
    return store


def _byte_order(cdr: bytes) -> str:
    return '<' if cdr[1] & 1 else '>'
