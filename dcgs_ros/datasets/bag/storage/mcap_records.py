# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Records of MCAP: https://mcap.dev/spec."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from .compression import decompress

MAGIC = b'\x89MCAP0\r\n'
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 2, 3, 4, 5, 6, 7
CHUNK_INDEX, STATISTICS = 8, 11
RECORD = struct.Struct('<BQ')  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, logged and published in ns
CHUNK_HEAD = struct.Struct('<QQQI')  # first and last message in ns, size, CRC
PLAIN_HEAD = struct.Struct('<QQQIIQ')  # the same, no name of a compression, length of what follows
END = struct.Struct('<BQQQI8s')  # the footer and the magic behind it
COUNTS_AT = 42  # in the statistics


class Block(NamedTuple):
    """A chunk, or a message outside of chunks."""

    start_ns: int
    at: int  # byte in the file
    length: int
    opcode: int


def split_records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Split a chunk's content; raises `ValueError`."""
    at = 0
    while at < len(data):
        opcode, length = RECORD.unpack_from(data, at)
        at += RECORD.size
        if length > len(data) - at:
            raise ValueError(f'a record of {length} bytes, {len(data) - at} are left')
        yield opcode, data[at : at + length]
        at += length


def open_chunk(body: memoryview, limit: int) -> memoryview:
    """Content of a chunk, decompressed and checked; raises `ValueError`."""
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
    """Read a string with its length before it, and where it ends."""
    (length,) = struct.unpack_from('<I', body, at)
    end = at + 4 + length
    if end > len(body):
        raise ValueError(f'a name of {length} bytes, {len(body) - at - 4} are left')
    return bytes(body[at + 4 : end]).decode(), end
