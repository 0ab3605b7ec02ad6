# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Reading MCAP files: https://mcap.dev/spec.

Of the libraries, `rosbags` cannot read a file without its end, and `mcap` takes a chunk that
breaks off for complete.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from heapq import heappop, heappush
from pathlib import Path
from typing import BinaryIO

from ..messages import RawMessage
from ..recovery.mcap import read_summary
from .compression import is_packed, unpack
from .mcap_index import McapIndex
from .mcap_records import (
    CHANNEL,
    CHUNK,
    MESSAGE,
    MESSAGE_HEAD,
    PLAIN_HEAD,
    RECORD,
    SCHEMA,
    Block,
    open_chunk,
    split_records,
)

_MAX_HELD = 1 << 26  # bytes of messages that wait for earlier ones
_HEAD_BYTES = 4096  # of a message: a whole pose or CameraInfo, the header of an image


def read_mcap(
    path: Path, topics: Collection[str] | None, losses: list[str]
) -> Iterator[RawMessage]:
    """Read the messages of those topics, or all, in order of their stamps.

    Chunks that overlap in time are merged within 64 MB of memory. What is damaged is skipped and
    appended to `losses`. Raises `SourceError` if the file is no MCAP at all.
    """
    with path.open('rb') as file:
        yield from _messages(_index(file, losses), topics, heads=False)


def read_mcap_heads(
    path: Path, topics: Collection[str] | None, losses: list[str]
) -> Iterator[RawMessage]:
    """Read messages as `read_mcap` does, but of long ones only the beginning if that is faster.

    It is for chunks without compression, whose checksums are not verified then.
    """
    with path.open('rb') as file:
        yield from _messages(_index(file, losses), topics, heads=True)


def mcap_types(path: Path) -> dict[str, str] | None:
    """Return the types of the topics that hold messages, by the statistics; None without them."""
    losses: list[str] = []
    with path.open('rb') as file:
        index = _index(file, losses)
    known = index.counts and not losses and all(key in index.channels for key in index.counts)
    return dict(index.channels[key] for key, n in index.counts.items() if n) if known else None


def _index(file: BinaryIO, losses: list[str]) -> McapIndex:
    """Index a file; what its records do not lead to is found by its own index."""
    index = McapIndex(file, losses)
    if index.broken_at is not None:
        read_summary(index, index.broken_at)
    return index


def _messages(
    index: McapIndex, topics: Collection[str] | None, heads: bool
) -> Iterator[RawMessage]:
    """Merge the messages of the blocks, or their beginnings, by their stamps."""
    waiting: list[tuple[int, int, RawMessage]] = []
    held = count = 0
    for block in index.blocks:
        while waiting and (waiting[0][0] < block.start_ns or held > _MAX_HELD):
            message = heappop(waiting)[2]
            held -= len(message.cdr)
            yield message
        try:
            for message in _block_messages(index, block, topics, heads):
                heappush(waiting, (message.stamp_ns, count, message))
                held += len(message.cdr)
                count += 1
        except (ValueError, struct.error, OSError) as error:
            what = 'chunk' if block.opcode == CHUNK else 'message'
            index.losses.append(f'{what} at byte {block.at}: {error}')
    while waiting:
        yield heappop(waiting)[2]


def _block_messages(
    index: McapIndex, block: Block, topics: Collection[str] | None, heads: bool
) -> Iterator[RawMessage]:
    """Read the messages of a block in their order in it."""
    if topics is not None and (within := index.channels_in.get(block.at)):
        if not any(index.channels.get(key, ('',))[0] in ('', *topics) for key in within):
            return  # a reader of one topic need not decompress the chunks of others
    if block.opcode == MESSAGE:
        yield from _message(index, memoryview(index.read(block.at, block.length)), topics)
        return
    plain = _plain_content(index, block) if heads else None
    if plain is None:
        body = memoryview(index.read(block.at, block.length))
        records = split_records(open_chunk(body, index.limit))
    else:
        records = _split_heads(index, *plain)
    for opcode, record in records:
        if opcode == MESSAGE:
            yield from _message(index, record, topics)
        elif opcode in (SCHEMA, CHANNEL):
            index.define(opcode, record)


def _plain_content(index: McapIndex, block: Block) -> tuple[int, int] | None:
    """Return where the content of a chunk begins and ends; None if it is compressed."""
    index.file.seek(block.at)
    head = index.file.read(min(PLAIN_HEAD.size, block.length))
    _, _, _, _, compression_length, length = PLAIN_HEAD.unpack(head)
    if compression_length or length > block.length - PLAIN_HEAD.size:
        return None
    return block.at + PLAIN_HEAD.size, block.at + PLAIN_HEAD.size + length


def _split_heads(index: McapIndex, at: int, end: int) -> Iterator[tuple[int, memoryview]]:
    """Split an uncompressed chunk's content, reading only the beginning of messages."""
    while at < end:
        index.file.seek(at)
        head = index.file.read(min(RECORD.size + MESSAGE_HEAD.size + _HEAD_BYTES, end - at))
        opcode, length = RECORD.unpack_from(head)
        at += RECORD.size
        if length > end - at:
            raise ValueError(f'a record of {length} bytes, {end - at} are left')
        body = head[RECORD.size : RECORD.size + length]
        if opcode != MESSAGE or is_packed(body[MESSAGE_HEAD.size :]):
            body = index.read(at, length)
        yield opcode, memoryview(body)
        at += length


def _message(
    index: McapIndex, body: memoryview, topics: Collection[str] | None
) -> Iterator[RawMessage]:
    """Read a message if its topic is wanted."""
    key, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(body)
    topic, type_ = index.channels.get(key, ('', ''))
    if topic and (topics is None or topic in topics):
        cdr = unpack(bytes(body[MESSAGE_HEAD.size :]))
        yield RawMessage(topic, type_, stamp_ns, cdr)
