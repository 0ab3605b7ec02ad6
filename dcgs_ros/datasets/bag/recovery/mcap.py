# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""MCAP files whose records cannot be followed to the footer.

The records before the damage are indexed already. If the file was cut off, that is all there is.
If the damage is in the middle, the file's own index at its end leads to the chunks behind it.
"""

from __future__ import annotations

import struct

from ..storage.mcap_index import McapIndex
from ..storage.mcap_records import (
    CHUNK,
    CHUNK_INDEX,
    FOOTER,
    MAGIC,
    RECORD,
    Block,
    CutOffError,
    walk_records,
)
from .losses import skipping

_END = struct.Struct('<BQQQI8s')  # the footer, and the magic after it


def read_summary(index: McapIndex, broken_at: int) -> None:
    """Complete the index of a file whose records break off at byte `broken_at`.

    The loss is appended to the index' losses. If the summary at the file's end is readable, the
    chunks between the damage and the summary are added to the index.
    """
    size = index.size
    index.losses.append(
        f'never closed: it ends at byte {size} without a footer'
        if broken_at == size
        else f'cut off or overwritten at byte {broken_at} of {size}'
    )
    summary_at = _summary_at(index)
    if summary_at <= broken_at:
        return
    try:
        for opcode, at, length in walk_records(index.file, summary_at, size):
            with skipping(index.losses, f'record at byte {at}', ValueError, struct.error):
                if opcode == CHUNK_INDEX:
                    _add_chunk(index, broken_at, at, length)
                else:
                    index.note(opcode, at, length)
    except CutOffError:
        return
    index.blocks.sort()


def _summary_at(index: McapIndex) -> int:
    """Return where the summary begins, by the file's last bytes; 0 if these are damaged."""
    index.file.seek(max(0, index.size - _END.size))
    tail = index.file.read(_END.size)
    if len(tail) < _END.size:
        return 0
    opcode, length, start, _, _, magic = _END.unpack(tail)
    return start if (opcode, length, magic) == (FOOTER, 20, MAGIC) else 0


def _add_chunk(index: McapIndex, broken_at: int, at: int, length: int) -> None:
    """Add the chunk that an index record (at byte `at`) points to, if it is behind the damage."""
    start_ns, _, chunk_at, chunk_length = struct.unpack_from('<QQQQ', index.read(at, length))
    if broken_at < chunk_at and chunk_at + chunk_length <= at:
        content_at, content_length = chunk_at + RECORD.size, chunk_length - RECORD.size
        index.blocks.append(Block(start_ns, content_at, content_length, CHUNK))
