# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Records of MCAP files: https://mcap.dev/spec."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from .compression import decompress

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 2, 3, 4, 5, 6, 7
CHUNK_INDEX, STATISTICS = 8, 11
RECORD = struct.Struct('<BQ')  # opcode, length of the body
MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, logged and published in ns
CHUNK_HEAD = struct.Struct('<QQQI')  # first and last message in ns, size, CRC
PLAIN_HEAD = struct.Struct('<QQQIIQ')  # the same, an empty compression name, length of the content
COUNTS_AT = 42  # byte, in the statistics


class CutOffError(Exception):
    """The records end, or make no sense, before the footer."""

    def __init__(self, at: int) -> None:
        """Keep the byte from which they cannot be followed."""
        super().__init__(at)
        self.at = at


class Block(NamedTuple):
    """A chunk, or a message outside of chunks."""

    start_ns: int
    at: int  # byte in the file, of the record's body
    length: int
    opcode: int


def walk_records(file: BinaryIO, at: int, size: int) -> Iterator[tuple[int, int, int]]:
    """Read opcode, and first byte and length of the body, of each record from `at` to the footer.

    The file is left at the body's first byte. Raises `CutOffError` if a record does not fit into
    the file's `size`, or there is no footer.
    """
    while at + RECORD.size <= size:
        file.seek(at)
        opcode, length = RECORD.unpack(file.read(RECORD.size))
        if opcode == FOOTER:
            return
        if opcode == 0 or length > size - at - RECORD.size:
            break
        at += RECORD.size
        yield opcode, at, length
        at += length
    raise CutOffError(at)


def split_records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Split a chunk's content into opcodes and bodies; raises `ValueError`."""
    at = 0
    while at < len(data):
        opcode, length = RECORD.unpack_from(data, at)
        at += RECORD.size
        if length > len(data) - at:
            raise ValueError(f'a record of {length} bytes, {len(data) - at} are left')
        yield opcode, data[at : at + length]
        at += length


def open_chunk(body: memoryview, limit: int) -> memoryview:
    """Return the content of a chunk, decompressed and checked; raises `ValueError`."""
    _, _, size, crc = CHUNK_HEAD.unpack_from(body)
    compression, at = read_text(body, CHUNK_HEAD.size)
    (length,) = struct.unpack_from('<Q', body, at)
    if size > limit or length > len(body) - at - 8:
        raise ValueError(f'it says {length} bytes give {size}; at most {limit} can be')
    data = decompress(compression, body[at + 8 : at + 8 + length], size)
    if len(data) != size:
        raise ValueError(f'it has {len(data)} bytes instead of {size}')
    if crc and zlib.crc32(data) != crc:
        raise ValueError('its checksum is wrong')
    return memoryview(data)


def read_text(body: memoryview, at: int) -> tuple[str, int]:
    """Return the string at byte `at`, after its length, and where it ends."""
    (length,) = struct.unpack_from('<I', body, at)
    end = at + 4 + length
    if end > len(body):
        raise ValueError(f'a name of {length} bytes, {len(body) - at - 4} are left')
    return bytes(body[at + 4 : end]).decode(), end
