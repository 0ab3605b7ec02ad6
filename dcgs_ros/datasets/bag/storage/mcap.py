# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""MCAP files, whole or damaged: https://mcap.dev/spec.

What is missing in a damaged file is mostly its end, with the index. The records' own lengths lead
from one to the next, so an index is made in passing; the file's is used only behind a gap. (Of the
libraries `rosbags` needs the end, and `mcap` takes what breaks off within a chunk for whole.)
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from heapq import heappop, heappush
from pathlib import Path
from typing import BinaryIO

from ...source import SourceError
from .compression import is_packed, size_limit, unpack
from .files import RawMessage
from .mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    COUNTS_AT,
    END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    PLAIN_HEAD,
    RECORD,
    SCHEMA,
    STATISTICS,
    Block,
    open_chunk,
    read_text,
    split_records,
)

_MAX_HELD = 1 << 26  # bytes of messages that wait for earlier ones
_HEAD_BYTES = 4096  # of a message: a pose or a camera as a whole, of an image the header


def read_mcap(
    path: Path, topics: Collection[str] | None, losses: list[str]
) -> Iterator[RawMessage]:
    """Read messages of those topics, or all, in order of their stamps; tell what is lost.

    Chunks that overlap are merged as far as 64 MB hold them. Raises `SourceError` for what is no
    MCAP at all.
    """
    with path.open('rb') as file:
        yield from _McapFile(file, losses).messages(topics)


def read_mcap_heads(
    path: Path, topics: Collection[str] | None, losses: list[str]
) -> Iterator[RawMessage]:
    """Read messages as `read_mcap` does, but of long ones only how they begin, if that is quicker.

    What is not compressed is skipped then, and its checksums with it.
    """
    with path.open('rb') as file:
        yield from _McapFile(file, losses).messages(topics, heads=True)


def mcap_types(path: Path) -> dict[str, str] | None:
    """Types of the topics that hold messages, if the file's statistics tell."""
    losses: list[str] = []
    with path.open('rb') as file:
        mcap = _McapFile(file, losses)
    known = mcap.counts and not losses and all(key in mcap.channels for key in mcap.counts)
    return dict(mcap.channels[key] for key, n in mcap.counts.items() if n) if known else None


class _McapFile:
    """An MCAP file of which the blocks are known."""

    def __init__(self, file: BinaryIO, losses: list[str]) -> None:
        """Go through the records; `losses` is told where that fails."""
        self._file = file
        self._losses = losses
        self._limit = size_limit(file)
        self._schemas: dict[int, str] = {}
        self._blocks: list[Block] = []
        self._within: dict[int, set[int]] = {}  # channels of each chunk, if the file tells
        self.channels: dict[int, tuple[str, str]] = {}  # topic and type
        self.counts: dict[int, int] = {}  # messages of each channel, by the statistics
        self._broken_at: int | None = None  # where the records cannot be followed any further
        if (magic := file.read(len(MAGIC))) != MAGIC:
            raise SourceError(f'no MCAP: it begins with {magic!r}')
        if self._scan():
            self._blocks.sort()

    def messages(
        self, topics: Collection[str] | None, heads: bool = False
    ) -> Iterator[RawMessage]:
        """Merge the messages of the blocks, or how they begin, by their stamps."""
        waiting: list[tuple[int, int, RawMessage]] = []
        held = count = 0
        for block in self._blocks:
            while waiting and (waiting[0][0] < block.start_ns or held > _MAX_HELD):
                message = heappop(waiting)[2]
                held -= len(message.cdr)
                yield message
            try:
                for message in self._block_messages(block, topics, heads):
                    heappush(waiting, (message.stamp_ns, count, message))
                    held += len(message.cdr)
                    count += 1
            except (ValueError, struct.error, OSError) as error:
                what = 'chunk' if block.opcode == CHUNK else 'message'
                self._losses.append(f'{what} at byte {block.at}: {error}')
        while waiting:
            yield heappop(waiting)[2]

    def _scan(self) -> bool:
        """Find the blocks; whether the file has its end."""
        size = os.fstat(self._file.fileno()).st_size
        broken_at = self._walk(len(MAGIC), size)
        if broken_at is None:
            return True
        self._losses.append(
            f'never closed: it ends at byte {size} without a footer'
            if broken_at == size
            else f'cut off or overwritten at byte {broken_at} of {size}'
        )
        self._broken_at = broken_at
        summary = self._summary_start(size)
        return summary > broken_at and self._walk(summary, size) is None

    def _walk(self, at: int, size: int) -> int | None:
        """Note the records from there to the footer, or tell where they break off."""
        while at + RECORD.size <= size:
            self._file.seek(at)
            opcode, length = RECORD.unpack(self._file.read(RECORD.size))
            if opcode == FOOTER:
                return None
            if opcode == 0 or length > size - at - RECORD.size:
                break
            at += RECORD.size
            try:
                self._note(opcode, at, length)
            except (ValueError, struct.error) as error:
                self._losses.append(f'record at byte {at}: {error}')
            at += length
        return at

    def _summary_start(self, size: int) -> int:
        """Tell where the summary begins, by the file's last bytes; 0 where these are lost."""
        self._file.seek(max(0, size - END.size))
        tail = self._file.read(END.size)
        if len(tail) < END.size:
            return 0
        opcode, length, start, _, _, magic = END.unpack(tail)
        return start if (opcode, length, magic) == (FOOTER, 20, MAGIC) else 0

    def _note(self, opcode: int, at: int, length: int) -> None:
        """Keep what a record outside of chunks says."""
        if opcode == CHUNK:
            (start_ns, _) = struct.unpack('<QQ', self._file.read(16))
            self._blocks.append(Block(start_ns, at, length, opcode))
        elif opcode == MESSAGE_INDEX and self._blocks:
            (key,) = struct.unpack('<H', self._file.read(2))
            self._within.setdefault(self._blocks[-1].at, set()).add(key)
        elif opcode == MESSAGE:
            (_, _, stamp_ns, _) = MESSAGE_HEAD.unpack(self._file.read(MESSAGE_HEAD.size))
            self._blocks.append(Block(stamp_ns, at, length, opcode))
        elif opcode in (SCHEMA, CHANNEL):
            self._define(opcode, memoryview(self._read(at, length)))
        elif opcode == CHUNK_INDEX and self._broken_at is not None:
            start_ns, _, chunk_at, chunk_length = struct.unpack_from(
                '<QQQQ', self._read(at, length)
            )
            if self._broken_at < chunk_at and chunk_at + chunk_length <= at:
                content_at, content_length = chunk_at + RECORD.size, chunk_length - RECORD.size
                self._blocks.append(Block(start_ns, content_at, content_length, CHUNK))
        elif opcode == STATISTICS:
            counts = self._read(at, length)[COUNTS_AT + 4 :]
            self.counts = dict(struct.iter_unpack('<HQ', counts))

    def _read(self, at: int, length: int) -> bytes:
        if length > self._limit:
            raise ValueError(f'{length} bytes where at most {self._limit} can be')
        self._file.seek(at)
        return self._file.read(length)

    def _define(self, opcode: int, body: memoryview) -> None:
        """Note a schema's name or a channel's topic."""
        (key,) = struct.unpack_from('<H', body)
        if opcode == SCHEMA:
            self._schemas[key] = read_text(body, 2)[0]
            return
        (schema,) = struct.unpack_from('<H', body, 2)
        topic, at = read_text(body, 4)
        if read_text(body, at)[0] == 'cdr':
            self.channels[key] = topic, self._schemas.get(schema, '')

    def _block_messages(
        self, block: Block, topics: Collection[str] | None, heads: bool
    ) -> Iterator[RawMessage]:
        """Read the messages of a block in their order in it."""
        if topics is not None and (within := self._within.get(block.at)):
            if not any(self.channels.get(key, ('',))[0] in ('', *topics) for key in within):
                return  # else each topic's reader would decompress all chunks
        if block.opcode == MESSAGE:
            yield from self._message(memoryview(self._read(block.at, block.length)), topics)
            return
        plain = self._plain_content(block) if heads else None
        if plain is None:
            body = memoryview(self._read(block.at, block.length))
            records = split_records(open_chunk(body, self._limit))
        else:
            records = self._split_heads(*plain)
        for opcode, record in records:
            if opcode == MESSAGE:
                yield from self._message(record, topics)
            elif opcode in (SCHEMA, CHANNEL):
                self._define(opcode, record)

    def _plain_content(self, block: Block) -> tuple[int, int] | None:
        """Where the content of a chunk begins and ends; None where it is compressed."""
        self._file.seek(block.at)
        head = self._file.read(min(PLAIN_HEAD.size, block.length))
        _, _, _, _, compression_length, length = PLAIN_HEAD.unpack(head)
        if compression_length or length > block.length - PLAIN_HEAD.size:
            return None
        return block.at + PLAIN_HEAD.size, block.at + PLAIN_HEAD.size + length

    def _split_heads(self, at: int, end: int) -> Iterator[tuple[int, memoryview]]:
        """Split a chunk's content as it is in the file; of messages only the beginning is read."""
        while at < end:
            self._file.seek(at)
            head = self._file.read(min(RECORD.size + MESSAGE_HEAD.size + _HEAD_BYTES, end - at))
            opcode, length = RECORD.unpack_from(head)
            at += RECORD.size
            if length > end - at:
                raise ValueError(f'a record of {length} bytes, {end - at} are left')
            body = head[RECORD.size : RECORD.size + length]
            if opcode != MESSAGE or is_packed(body[MESSAGE_HEAD.size :]):
                body = self._read(at, length)
            yield opcode, memoryview(body)
            at += length

    def _message(self, body: memoryview, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """Read a message if its topic is wanted."""
        key, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(body)
        topic, type_ = self.channels.get(key, ('', ''))
        if topic and (topics is None or topic in topics):
            cdr = unpack(bytes(body[MESSAGE_HEAD.size :]))
            yield RawMessage(topic, type_, stamp_ns, cdr)
