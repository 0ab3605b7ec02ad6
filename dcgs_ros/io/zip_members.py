# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Reading the stored members of zip files in the file's order, from files that are not trusted."""

from __future__ import annotations

import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from io import BufferedReader

from ..core.errors import DcgsError
from .digest import SEAL_LENGTH, is_sealed

# What zip files can hold without the ZIP64 extensions.
MEMBERS_LIMIT = (1 << 16) - 1
MEMBER_LIMIT = 2_000_000_000  # bytes

_NAME = re.compile('[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}')

# Signature, version, flags, method, time, date, CRC, packed, size, length of name, of extra field.
_LOCAL = struct.Struct('<4s5H3I2H')
_LOCAL_SIGNATURE = b'PK\x03\x04'
_CENTRAL_SIGNATURE = b'PK\x01\x02'
# Signature, two disks, members here, members, size and offset of the directory, comment's length.
_END = struct.Struct('<4s4H2IH')
_END_SIGNATURE = b'PK\x05\x06'
_NAMES_IN_UTF8 = 0x800  # the only flag allowed, as it changes nothing for ASCII names


class ArchiveError(DcgsError):
    """A file is not an archive, or contents cannot be written as one."""


def check_name(name: str) -> None:
    """Check that members may have this name; raises `ArchiveError`."""
    if not _NAME.fullmatch(name):
        raise ArchiveError(
            f'{name[:40]!r} is no name of a member: up to 100 letters, digits and _ . -'
        )


def read_members(file: BufferedReader) -> Iterator[tuple[str, bytes | bytearray]]:
    """Read name and content of the members in the file's order, by the header before each.

    The directory at the file's end is not used, as it could list members that overlap: read in
    order, they are together no larger than the file.
    """
    names: set[str] = set()
    while (head := file.read(_LOCAL.size)).startswith(_LOCAL_SIGNATURE):
        name, data = _read_member(file, head)
        if name in names:
            raise ArchiveError(f'member {name!r} is there twice')
        names.add(name)
        if len(names) > MEMBERS_LIMIT:
            raise ArchiveError(f'more than {MEMBERS_LIMIT} members')
        yield name, data
    if not names:
        raise ArchiveError(f'no archive: begins with {head[:12]!r}')
    _check_end(file, head, len(names))


def _read_member(file: BufferedReader, head: bytes) -> tuple[str, bytes | bytearray]:
    """Read name and content of the member whose header begins with `head`."""
    if len(head) < _LOCAL.size:
        raise ArchiveError('cut off within the header of a member')
    _, _, flags, method, _, _, crc, packed, size, name_size, extra_size = _LOCAL.unpack(head)
    name = file.read(name_size).decode('ascii', errors='replace')
    file.seek(extra_size, os.SEEK_CUR)
    check_name(name)
    if flags & ~_NAMES_IN_UTF8:
        raise ArchiveError(f'member {name!r} is encrypted or streamed: flags 0x{flags:04x}')
    if method != zipfile.ZIP_STORED or packed != size:
        raise ArchiveError(
            f'member {name!r} is compressed: method {method}, {size} bytes in {packed}'
        )
    left = os.fstat(file.fileno()).st_size - file.tell()
    if size > left:
        raise ArchiveError(
            f'member {name!r} has {size} bytes by its header, but {left} are left of the file'
        )
    if name.endswith('.npy'):
        data: bytes | bytearray = bytearray(size)  # to make the array writable
        file.readinto(data)
    else:
        data = file.read(size)
    found = zlib.crc32(data)
    if found != crc:
        raise ArchiveError(f'member {name!r} is damaged: CRC {found:08x}, not {crc:08x}')
    return name, data


def _check_end(file: BufferedReader, head: bytes, members: int) -> None:
    """Check that a complete directory of so many members follows; raises `ArchiveError`."""
    comment = SEAL_LENGTH if is_sealed(file) else 0
    start = max(0, os.fstat(file.fileno()).st_size - _END.size - comment)
    file.seek(start)
    end = file.read(_END.size)
    if not head.startswith(_CENTRAL_SIGNATURE) or not end.startswith(_END_SIGNATURE):
        raise ArchiveError(f'cut off or damaged after {members} members')
    counted = _END.unpack(end)[4]
    if counted != members:
        raise ArchiveError(f'holds {members} members, but its end counts {counted}')
