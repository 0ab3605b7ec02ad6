# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The files of a rosbag2, as `ros2 bag play` reads them, written by rosbags without ROS."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ....core.errors import DcgsError
from ..messages import RawMessage, message_types
from ..topics import STATIC_TOPIC

if TYPE_CHECKING:
    from rosbags.interfaces import Qos
    from rosbags.rosbag2 import Writer

STORAGES = ('mcap', 'sqlite3')

_FOREVER = 9223372036, 854775807  # s, ns: ROS 2's value for no limit


class BagWritingError(DcgsError):
    """A recording cannot be written."""


@dataclass(frozen=True)
class BagOptions:
    """How a recording is stored."""

    storage: str = 'mcap'  # one of `STORAGES`
    compress: bool = False  # colour as JPEG, depth as PNG of whole millimetres
    zstd: bool = False  # chunks of an mcap, messages of a sqlite3


@contextmanager
def open_writer(folder: Path, options: BagOptions) -> Iterator[Writer]:
    """Open a new recording; raises `BagWritingError`, also for errors while writing."""
    try:
        from rosbags.rosbag2 import (
            CompressionFormat,
            CompressionMode,
            StoragePlugin,
            Writer,
            WriterError,
        )
    except ImportError as error:
        raise BagWritingError(
            f"writing a rosbag2 needs rosbags: pip install 'dcgs_ros[bags]' ({error})"
        ) from error
    plugin = StoragePlugin[options.storage.upper()]
    # Of these modes neither makes a reader decompress the whole file first; only mcap has chunks.
    mode = CompressionMode.STORAGE if plugin is StoragePlugin.MCAP else CompressionMode.MESSAGE
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if options.zstd:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    try:
        with writer:
            yield writer
    except (WriterError, sqlite3.Error) as error:
        raise BagWritingError(f'{folder.name}: cannot be written: {error}') from error


def message_writer(writer: Writer) -> Callable[[RawMessage], None]:
    """Return a function that writes a message, and its topic's connection before the first one."""
    connections: dict[str, Any] = {}

    def write(message: RawMessage) -> None:
        topic = message.topic
        if topic not in connections:
            connections[topic] = writer.add_connection(
                topic, message.type, typestore=message_types(), offered_qos_profiles=[_qos(topic)]
            )
        writer.write(connections[topic], message.stamp_ns, message.cdr)

    return write


def _qos(topic: str) -> Qos:
    """Return the QoS that `ros2 bag play` offers: reliable, latched for the static transform."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    latched, forever = topic == STATIC_TOPIC, QosTime(*_FOREVER)
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else 10,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )
