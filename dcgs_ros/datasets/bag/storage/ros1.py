# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Reading bags of ROS 1; their messages are converted to what ROS 2 would have recorded.

`rosbags` reads and converts them, with the definitions of the types that each bag contains.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from ...source import SourceError
from ..messages import RawMessage
from ..recovery.losses import skipping

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader

_HEADER = 'std_msgs/msg/Header'


def read_ros1(
    path: Path, topics: Collection[str] | None, losses: list[str]
) -> Iterator[RawMessage]:
    """Read the messages of those topics, or all, in order of their stamps.

    What is damaged is skipped and appended to `losses`. Raises `SourceError` if the file is no
    bag, or has no index. All exceptions are caught, as damage may raise any in rosbags' parsers.
    """
    with _reading(path) as reader:
        converters: dict[int, Callable[[bytes], bytes]] = {}
        for connection in reader.connections:
            topic, type_ = connection.topic, connection.msgtype
            if topics is None or topic in topics:
                with skipping(losses, f'the type of {topic}', Exception, show=repr):
                    converters[connection.id] = _converter(connection.msgdef.data, type_)
        for connection, stamp_ns, data in _messages(reader, converters, losses):
            cdr = None
            with skipping(losses, f'a message of {connection.topic}', Exception, show=repr):
                cdr = converters[connection.id](data)
            if cdr is not None:
                yield RawMessage(connection.topic, connection.msgtype, stamp_ns, cdr)


def ros1_types(path: Path) -> dict[str, str]:
    """Return the types of the topics that hold messages, by the index."""
    with _reading(path) as reader:
        return {c.topic: c.msgtype for c in reader.connections if c.msgcount}


@contextmanager
def _reading(path: Path) -> Iterator[Reader]:
    """Open a bag; raises `SourceError` if its index cannot be read."""
    from rosbags.rosbag1 import Reader

    reader = Reader(path)
    try:
        reader.open()
    except Exception as error:
        raise SourceError(
            f'no bag of ROS 1, or not closed ({error!r}); in the latter case '
            "'rosbag reindex' repairs it"
        ) from error
    try:
        yield reader
    finally:
        reader.close()


def _messages(
    reader: Reader, wanted: Collection[int], losses: list[str]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Read the messages of those connections, up to the first damaged chunk."""
    connections = [c for c in reader.connections if c.id in wanted]
    if not connections:  # which rosbags would take for all
        return
    with skipping(losses, 'a chunk cannot be read', Exception, show=repr):
        yield from reader.messages(connections)


@lru_cache(maxsize=128)
def _converter(definition: str, type_: str) -> Callable[[bytes], bytes]:
    """Return a function that converts a message of ROS 1 to CDR."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_types_from_msg(definition, type_)
    # Headers of ROS 1 have a sequence number; `ros1_to_cdr` drops it if the type is ROS 2's.
    types[_HEADER] = get_typestore(Stores.ROS2_JAZZY).fielddefs[_HEADER]
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return lambda data: bytes(store.ros1_to_cdr(data, type_))
