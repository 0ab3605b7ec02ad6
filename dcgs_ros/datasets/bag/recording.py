# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Reading a recording, of ROS 2 or ROS 1, message by message."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from ...io.ros_images import MessageError
from ..source import SourceError
from .messages import RawMessage, as_source_error, decode
from .recovery.losses import DamagedError, RecordingLosses
from .storage.compression import plain_file
from .storage.files import find_files, storage_of
from .storage.mcap import mcap_types, read_mcap, read_mcap_heads
from .storage.ros1 import read_ros1, ros1_types
from .storage.sqlite import read_sqlite, sqlite_types


class _Storage(NamedTuple):
    """The readers of one kind of file."""

    # Of messages of these topics or all; appends what is lost to the list.
    read: Callable[[Path, Collection[str] | None, list[str]], Iterator[RawMessage]]
    types: Callable[[Path], dict[str, str] | None]  # from an index; None if it has none


_STORAGES = {
    '.mcap': _Storage(read_mcap, mcap_types),
    '.db3': _Storage(read_sqlite, sqlite_types),
    '.bag': _Storage(read_ros1, ros1_types),
}


def raw_messages(
    path: Path | str, topics: Collection[str] | None, heads: bool = False
) -> Iterator[RawMessage]:
    """Read the messages of those topics, or all, in the order they were recorded.

    Messages of ROS 1 are converted to CDR. With `heads`, long messages may be cut off after their
    header where that is faster. Of a damaged recording the readable part is read, and then
    `DamagedError` raised. Raises `SourceError` if nothing can be read.
    """
    recording = find_files(Path(path))
    losses = RecordingLosses(path, recording, topics)
    for file in recording.files:
        with losses.of_file(file) as lost:
            for message in _file_messages(file, topics, lost, heads):
                losses.read += 1
                yield message
    losses.check()


def topic_types(path: Path | str) -> dict[str, str]:
    """Return the types (package/msg/Name) of the topics that hold messages.

    A file without a readable index is read as a whole. Raises `SourceError`.
    """
    types: dict[str, str] = {}
    errors = []
    files = find_files(Path(path)).files
    for file in files:
        try:
            with as_source_error(), plain_file(file) as plain:
                found = _STORAGES[storage_of(file)].types(plain)
            if found is None:
                found = {m.topic: m.type for m in _file_messages(file, None, [])}
            types.update(found)
        except SourceError as error:
            errors.append(f'{file.name}: {error}')
    if len(errors) == len(files):
        raise SourceError(f'{path}: cannot be read: {"; ".join(errors)}')
    return types


def first_messages(path: Path | str, topics: Iterable[str]) -> dict[str, Any]:
    """Return the first readable message of each of the topics that have one."""
    wanted = set(topics)
    found: dict[str, Any] = {}
    with suppress(DamagedError):  # reported with the frames
        for message in raw_messages(path, wanted):
            if message.topic not in found:
                with suppress(MessageError):
                    found[message.topic] = decode(message.cdr, message.type)
            if len(found) == len(wanted):
                break
    return found


def custom_data(path: Path | str) -> dict[str, str]:
    """Return the recorder's custom data in metadata.yaml; raises `SourceError`."""
    return find_files(Path(path)).custom_data


def _file_messages(
    file: Path, topics: Collection[str] | None, losses: list[str], heads: bool = False
) -> Iterator[RawMessage]:
    kind = storage_of(file)
    read = read_mcap_heads if heads and kind == '.mcap' else _STORAGES[kind].read
    with as_source_error(), plain_file(file) as plain:
        yield from read(plain, topics, losses)
