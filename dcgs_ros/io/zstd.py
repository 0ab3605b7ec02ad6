# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Zstandard in memory; sizes in headers are not trusted."""

from __future__ import annotations

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


def unzstd(data: bytes | memoryview, limit: int) -> bytes:
    """Decompress a frame; raises `ValueError` if it is broken or gives more than `limit` bytes."""
    import zstandard

    try:
        size = zstandard.frame_content_size(data)  # negative if unknown
        if size > limit:
            raise ValueError(f'{size} bytes are compressed where at most {limit} can be')
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=limit)
    except (zstandard.ZstdError, MemoryError) as error:
        raise ValueError(f'its zstd is broken: {error}') from error
