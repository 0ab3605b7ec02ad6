# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Digests of whole files, kept inside them: one flipped bit anywhere is found.

In a zip file the digest is the archive's comment, in a PLY a comment of the header: other
programs skip both.
"""

from __future__ import annotations

import hashlib
import os
import struct
from pathlib import Path
from typing import BinaryIO

_DIGEST_BYTES = 32
_CHUNK = 1 << 18  # bytes read at a time
_MARK = b'blake2b '
SEAL_LENGTH = len(_MARK) + 2 * _DIGEST_BYTES  # bytes, of the mark and the digest in hexadecimal
_COMMENT_LENGTH = struct.Struct('<H')  # at the very end of a zip file without a comment


def seal_zip(path: Path) -> None:
    """Append the digest of a zip file without a comment as its comment."""
    with path.open('r+b') as file:
        file.seek(-_COMMENT_LENGTH.size, os.SEEK_END)
        file.write(_COMMENT_LENGTH.pack(SEAL_LENGTH))
        size = file.tell()
        file.write(seal(file, size, size))


def is_sealed(file: BinaryIO) -> bool:
    """Return whether a zip file ends with a seal, which may be wrong."""
    size = os.fstat(file.fileno()).st_size
    file.seek(max(0, size - SEAL_LENGTH))
    return is_mark(file)


def is_mark(file: BinaryIO) -> bool:
    """Return whether a seal, which may be wrong, begins where an open file is."""
    return file.read(len(_MARK)) == _MARK


def seal_holds(file: BinaryIO, start: int) -> bool:
    """Return whether the seal at `start` is that of the rest of an open file."""
    file.seek(start)
    found = file.read(SEAL_LENGTH)
    return found == seal(file, start, start + SEAL_LENGTH)


def seal(file: BinaryIO, start: int, end: int) -> bytes:
    """Return the seal of all bytes of an open file but those from `start` to `end`.

    The file is left at `start`.
    """
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    file.seek(0)
    left = start
    while left and (chunk := file.read(min(left, _CHUNK))):
        digest.update(chunk)
        left -= len(chunk)
    file.seek(end)
    while chunk := file.read(_CHUNK):
        digest.update(chunk)
    file.seek(start)
    return _MARK + digest.hexdigest().encode('ascii')
