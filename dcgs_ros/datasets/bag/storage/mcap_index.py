# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""An index of an MCAP file: where its messages are, and of which topics.

It is made by walking the records, which takes no more than their headers. The file's own index is
needed only if the records break off before their end (`recovery.mcap`).
"""

from __future__ import annotations

import os
import struct
from typing import BinaryIO

from ...source import SourceError
from .compression import size_limit
from .mcap_records import (
    CHANNEL,
    CHUNK,
    COUNTS_AT,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    SCHEMA,
    STATISTICS,
    Block,
    CutOffError,
    read_text,
    walk_records,
)


class McapIndex:
    """What the records outside of chunks say."""

    def __init__(self, file: BinaryIO, losses: list[str]) -> None:
        """Walk the records to the footer, or to where they break off; raises `SourceError`.

        Damaged records are appended to `losses`.
        """
        self.file = file
        self.losses = losses
        self.limit = size_limit(file)  # bytes, of one record
        self.blocks: list[Block] = []  # by their first stamps
        self.channels: dict[int, tuple[str, str]] = {}  # topic and type
        self.channels_in: dict[int, set[int]] = {}  # channels of the chunk at a byte, if known
        self.counts: dict[int, int] = {}  # messages of each channel, by the statistics
        self.size = os.fstat(file.fileno()).st_size  # bytes
        self.broken_at: int | None = None  # byte where the records break off; None: the footer
        self._schemas: dict[int, str] = {}
        if (magic := file.read(len(MAGIC))) != MAGIC:
            raise SourceError(f'no MCAP: it begins with {magic!r}')
        try:
            for opcode, at, length in walk_records(file, len(MAGIC), self.size):
                try:
                    self.note(opcode, at, length)
                except (ValueError, struct.error) as error:
                    losses.append(f'record at byte {at}: {error}')
            self.blocks.sort()
        except CutOffError as damage:
            self.broken_at = damage.at

    def note(self, opcode: int, at: int, length: int) -> None:
        """Keep what a record outside of chunks says; the file is at byte `at`, its body."""
        if opcode == CHUNK:
            (start_ns, _) = struct.unpack('<QQ', self.file.read(16))
            self.blocks.append(Block(start_ns, at, length, opcode))
        elif opcode == MESSAGE_INDEX and self.blocks:
            (key,) = struct.unpack('<H', self.file.read(2))
            self.channels_in.setdefault(self.blocks[-1].at, set()).add(key)
        elif opcode == MESSAGE:
            (_, _, stamp_ns, _) = MESSAGE_HEAD.unpack(self.file.read(MESSAGE_HEAD.size))
            self.blocks.append(Block(stamp_ns, at, length, opcode))
        elif opcode in (SCHEMA, CHANNEL):
            self.define(opcode, memoryview(self.read(at, length)))
        elif opcode == STATISTICS:
            counts = self.read(at, length)[COUNTS_AT + 4 :]
            self.counts = dict(struct.iter_unpack('<HQ', counts))

    def define(self, opcode: int, body: memoryview) -> None:
        """Keep a schema's name or a channel's topic; raises `ValueError` or `struct.error`."""
        (key,) = struct.unpack_from('<H', body)
        if opcode == SCHEMA:
            self._schemas[key] = read_text(body, 2)[0]
            return
        (schema,) = struct.unpack_from('<H', body, 2)
        topic, at = read_text(body, 4)
        if read_text(body, at)[0] == 'cdr':
            self.channels[key] = topic, self._schemas.get(schema, '')

    def read(self, at: int, length: int) -> bytes:
        """Read a record's body; raises `ValueError` if it is too long."""
        if length > self.limit:
            raise ValueError(f'{length} bytes where at most {self.limit} can be')
        self.file.seek(at)
        return self.file.read(length)
