# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Bags of ROS 1, their messages converted to what ROS 2 would have recorded.

`rosbags` reads and converts them, by the definitions of the types that each bag brings along.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from ...source import SourceError
from .files import RawMessage

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader

_HEADER = 'std_msgs/msg/Header'


def read_ros1(
    path: Path, topics: Collection[str] | None, losses: list[str]
) -> Iterator[RawMessage]:
    """Read messages of those topics, or all, in order of their stamps; tell what is lost.

    Raises `SourceError` for what is no recording, or has no index.
    """
    with _reading(path) as reader:
        converters: dict[int, Callable[[bytes], bytes]] = {}
        for connection in reader.connections:
            if topics is None or connection.topic in topics:
                try:
                    converters[connection.id] = _converter(
                        connection.msgdef.data, connection.msgtype
                    )
                except Exception as error:  # a damaged file fails anywhere in rosbags' parsers
                    losses.append(f'the type of {connection.topic}: {error!r}')
        for connection, stamp_ns, data in _messages(reader, converters, losses):
            try:
                cdr = converters[connection.id](data)
            except Exception as error:
                losses.append(f'a message of {connection.topic}: {error!r}')
                continue
            yield RawMessage(connection.topic, connection.msgtype, stamp_ns, cdr)


def ros1_types(path: Path) -> dict[str, str]:
    """Types of the topics that hold messages, by the index."""
    with _reading(path) as reader:
        return {c.topic: c.msgtype for c in reader.connections if c.msgcount}


@contextmanager
def _reading(path: Path) -> Iterator[Reader]:
    """Open a bag; raises `SourceError` where its index cannot be read."""
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
    """Read messages of those connections up to the first chunk that is damaged."""
    connections = [c for c in reader.connections if c.id in wanted]
    if not connections:  # which to rosbags means all
        return
    try:
        yield from reader.messages(connections)
    except Exception as error:
        losses.append(f'a chunk cannot be read: {error!r}')


@lru_cache(maxsize=128)
def _converter(definition: str, type_: str) -> Callable[[bytes], bytes]:
    """Make a function from a message of ROS 1 to CDR."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_types_from_msg(definition, type_)
    # Headers of ROS 1 count; `ros1_to_cdr` drops that if their type is ROS 2's.
    types[_HEADER] = get_typestore(Stores.ROS2_JAZZY).fielddefs[_HEADER]
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return lambda data: bytes(store.ros1_to_cdr(data, type_))
