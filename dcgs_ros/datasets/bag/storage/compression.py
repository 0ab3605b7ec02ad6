# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Compressed files, chunks and messages of recordings; sizes in headers are not trusted."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from ....io.zstd import ZSTD_MAGIC, unzstd

ZSTD_SUFFIX = '.zstd'

_MAX_RATIO = 64
_MIN_LIMIT, _MAX_LIMIT = 1 << 26, 1 << 30  # bytes
_STEP = 1 << 20  # bytes


@contextmanager
def plain_file(path: Path) -> Iterator[Path]:
    """Return the path to read: of the file itself, or of a temporary decompressed copy.

    If the compressed data are cut off, so is the copy.
    """
    if path.suffix != ZSTD_SUFFIX:
        yield path
        return
    import zstandard

    limit = max(_MAX_LIMIT, _MAX_RATIO * path.stat().st_size)  # on the disk
    with TemporaryDirectory() as folder:
        copy = Path(folder, path.stem)
        with path.open('rb') as packed, copy.open('wb') as out:
            reader = zstandard.ZstdDecompressor().stream_reader(packed)
            with suppress(zstandard.ZstdError):  # the copy's reader finds its end missing
                while (data := reader.read(_STEP)) and out.tell() < limit:
                    out.write(data)
        yield copy


def size_limit(file: BinaryIO) -> int:
    """Return how many bytes a record of the file may take in memory, whatever its header says."""
    return min(_MAX_LIMIT, max(_MIN_LIMIT, _MAX_RATIO * os.fstat(file.fileno()).st_size))


def unpack(data: bytes) -> bytes:
    """Decompress a message that was compressed by itself, with zstd; raises `ValueError`."""
    return unzstd(data, _MIN_LIMIT) if is_packed(data) else data


def is_packed(data: bytes) -> bool:
    """Return whether a message was compressed by itself, as CDR begins with a zero."""
    return data[:4] == ZSTD_MAGIC


def decompress(kind: str, data: bytes | memoryview, limit: int) -> bytes | memoryview:
    """Decompress an MCAP chunk; raises `ValueError`.

    Data that give more than `limit` bytes are cut off (lz4) or refused (zstd).
    """
    if kind == '':
        return data
    if kind == 'zstd':
        return unzstd(data, limit)
    if kind != 'lz4':
        raise ValueError(f'compression {kind!r} is not known')
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

    try:
        return LZ4FrameDecompressor().decompress(data, max_length=limit)
    except (RuntimeError, EOFError, MemoryError) as error:
        raise ValueError(f'its lz4 is broken: {error}') from error
