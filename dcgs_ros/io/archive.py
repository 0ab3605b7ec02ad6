# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Named arrays, bytes and JSON in one zip file that `np.load` opens too.

Members are stored, not deflated: floats hardly compress, and what is stored cannot be a bomb. The
first is `metadata.json` with the version; arrays are `NAME.npy`. Equal contents are equal bytes.
"""

from __future__ import annotations

import json
import math
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError
from .whole_files import replacing

VERSION = 1  # of the archive and of what the package keeps in one

_FORMAT = 'dcgs_ros archive'
_METADATA = 'metadata.json'
_METADATA_LIMIT = 1 << 16  # bytes; parsed, JSON takes up to thirty times its size
_MEMBERS_LIMIT = (1 << 16) - 1  # what zip counts without an extension
_MEMBER_LIMIT = 2_000_000_000  # bytes: likewise, for zipfile
_NAME = re.compile('[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}')
_DTYPES = frozenset(
    ['|b1', '|i1', '|u1', '<i2', '<u2', '<i4', '<u4', '<i8', '<u8', '<f4', '<f8']
)  # fmt: skip

# Signature, version, flags, method, time, date, CRC, packed, size, length of name, of extra field.
_LOCAL = struct.Struct('<4s5H3I2H')
_LOCAL_SIGNATURE = b'PK\x03\x04'
_CENTRAL_SIGNATURE = b'PK\x01\x02'
# Signature, two disks, members here, members, size and offset of the directory, comment's length.
_END = struct.Struct('<4s4H2IH')
_END_SIGNATURE = b'PK\x05\x06'
_NAMES_IN_UTF8 = 0x800  # the one flag that changes nothing for these names

# The header as numpy writes it, and nothing else that `ast.literal_eval` would understand too.
_NPY = re.compile(
    rb"\x93NUMPY\x01\x00(..)\{'descr': '([^']{1,20})', 'fortran_order': False, "
    rb"'shape': \((|[0-9]{1,18},|[0-9]{1,18}(?:, [0-9]{1,18})+)\), \} *\n",
    re.DOTALL,
)
_NPY_HEADER_LIMIT = 1024  # bytes
_NPY_ALIGNMENT = 16  # bytes, of the data after the header


class ArchiveError(DcgsError):
    """A file is no archive, or contents cannot be written as one."""


@dataclass(frozen=True)
class Archive:
    """What an archive holds; the arrays are its own and may be written to."""

    arrays: Mapping[str, NDArray]
    metadata: Mapping[str, Any]
    blobs: Mapping[str, bytes]


def write_archive(
    path: Path | str,
    arrays: Mapping[str, NDArray],
    metadata: Mapping[str, Any],
    blobs: Mapping[str, bytes],
) -> None:
    """Write an archive, with its members in the order given.

    `metadata` is what JSON can hold, up to 64 KiB of it. A blob's name is its member's, suffix and
    all. The file appears whole or not at all. Raises `ArchiveError`, naming the member that cannot
    be written, or where the file cannot.
    """
    path = Path(path)
    try:
        members = _members_to_write(arrays, metadata, blobs)
    except ArchiveError as error:
        raise ArchiveError(f'{path}: not written: {error}') from None
    try:
        with replacing(path) as temporary, zipfile.ZipFile(temporary, 'w') as archive:
            for name, content in members.items():
                # ZipInfo's date is 1980 unless told otherwise, and its method to store.
                with archive.open(zipfile.ZipInfo(name), 'w') as member:
                    if isinstance(content, bytes):
                        member.write(content)
                    else:
                        np.lib.format.write_array(member, content, (1, 0), allow_pickle=False)
    except OSError as error:
        raise ArchiveError(f'{path}: cannot be written: {error.strerror or error}') from error


def read_archive(path: Path | str) -> Archive:
    """Read an archive; it takes no more memory than the file's size and a few MiB.

    Raises `ArchiveError`, naming the file and what is wrong with it.
    """
    try:
        with open(path, 'rb') as file:
            return _read(file)
    except OSError as error:
        raise ArchiveError(f'{path}: cannot be read: {error.strerror or error}') from error
    except ArchiveError as error:
        raise ArchiveError(f'{path}: {error}') from None


def _members_to_write(
    arrays: Mapping[str, NDArray], metadata: Mapping[str, Any], blobs: Mapping[str, bytes]
) -> dict[str, bytes | NDArray]:
    """Name and check every member; raises `ArchiveError`."""
    members: dict[str, bytes | NDArray] = {_METADATA: _encode_metadata(metadata)}
    for name, array in arrays.items():
        if array.dtype.str not in _DTYPES:
            raise ArchiveError(f'array {name!r} is {array.dtype}')
        _check_size(name, array.nbytes)
        members[f'{name}.npy'] = np.asarray(array, order='C')
    for name, blob in blobs.items():
        if name.endswith('.npy') or name == _METADATA:
            raise ArchiveError(f'blob {name!r} has the name of another kind of member')
        _check_size(name, len(blob))
        members[name] = blob
    for name in members:
        _check_name(name)
    if len(members) > _MEMBERS_LIMIT:
        raise ArchiveError(f'{len(members)} members are more than {_MEMBERS_LIMIT}')
    return members


def _encode_metadata(metadata: Mapping[str, Any]) -> bytes:
    tree = {'format': _FORMAT, 'version': VERSION, 'metadata': dict(metadata)}
    try:
        text = json.dumps(tree, indent=1, allow_nan=False).encode('ascii')
    except (TypeError, ValueError, RecursionError) as error:
        raise ArchiveError(f'metadata do not fit JSON: {error}') from error
    if len(text) > _METADATA_LIMIT:
        raise ArchiveError(f'metadata take {len(text)} bytes, more than {_METADATA_LIMIT}')
    return text


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise ArchiveError(
            f'{name[:40]!r} is no name of a member: up to 100 letters, digits and _ . -'
        )


def _check_size(name: str, size: int) -> None:
    if size > _MEMBER_LIMIT:
        raise ArchiveError(f'{name!r} has {size} bytes, more than {_MEMBER_LIMIT}')


def _read(file: BufferedReader) -> Archive:
    members = _members(file)
    name, data = next(members)
    if name != _METADATA:
        raise ArchiveError(f'begins with {name!r}, not with {_METADATA}')
    metadata = _decode_metadata(data)
    arrays: dict[str, NDArray] = {}
    blobs: dict[str, bytes] = {}
    for name, data in members:
        if name.endswith('.npy'):
            name = name.removesuffix('.npy')
            arrays[name] = _decode_array(name, data)
        else:
            blobs[name] = bytes(data)
    return Archive(arrays, metadata, blobs)


def _members(file: BufferedReader) -> Iterator[tuple[str, bytes | bytearray]]:
    """Yield name and content of the members, in the file's order, from the header before each.

    The directory at the file's end, which repeats them, could name them in any other way: without
    it no two members overlap, and together they are no larger than the file.
    """
    names: set[str] = set()
    while (head := file.read(_LOCAL.size)).startswith(_LOCAL_SIGNATURE):
        name, data = _read_member(file, head)
        if name in names:
            raise ArchiveError(f'member {name!r} is there twice')
        names.add(name)
        if len(names) > _MEMBERS_LIMIT:
            raise ArchiveError(f'more than {_MEMBERS_LIMIT} members')
        yield name, data
    if not names:
        raise ArchiveError(f'no archive: begins with {head[:12]!r}')
    _check_end(file, head, len(names))


def _read_member(file: BufferedReader, head: bytes) -> tuple[str, bytes | bytearray]:
    """Read what follows the first bytes of a member's header."""
    if len(head) < _LOCAL.size:
        raise ArchiveError('cut off within the header of a member')
    _, _, flags, method, _, _, crc, packed, size, name_size, extra_size = _LOCAL.unpack(head)
    name = file.read(name_size).decode('ascii', errors='replace')
    file.seek(extra_size, os.SEEK_CUR)
    _check_name(name)
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
        data: bytes | bytearray = bytearray(size)  # so that the array on top can be written to
        file.readinto(data)
    else:
        data = file.read(size)
    found = zlib.crc32(data)
    if found != crc:
        raise ArchiveError(f'member {name!r} is damaged: CRC {found:08x}, not {crc:08x}')
    return name, data


def _check_end(file: BufferedReader, head: bytes, members: int) -> None:
    """Raise `ArchiveError` unless a directory of so many members follows and is whole."""
    start = max(0, os.fstat(file.fileno()).st_size - _END.size)
    file.seek(start)
    end = file.read(_END.size)
    if not head.startswith(_CENTRAL_SIGNATURE) or not end.startswith(_END_SIGNATURE):
        raise ArchiveError(f'cut off or damaged after {members} members')
    counted = _END.unpack(end)[4]
    if counted != members:
        raise ArchiveError(f'holds {members} members, but its end counts {counted}')


def _decode_metadata(data: bytes | bytearray) -> dict[str, Any]:
    """Raise `ArchiveError` unless this program can read what follows."""
    if len(data) > _METADATA_LIMIT:
        raise ArchiveError(f'{_METADATA} has {len(data)} bytes, more than {_METADATA_LIMIT}')
    try:
        tree = json.loads(data.decode('ascii'))
    except (ValueError, RecursionError) as error:
        raise ArchiveError(f'{_METADATA} is no JSON: {error}') from None
    if not isinstance(tree, dict) or tree.get('format') != _FORMAT:
        raise ArchiveError(f'{_METADATA} does not say that this is a {_FORMAT}')
    version, metadata = tree.get('version'), tree.get('metadata')
    if not isinstance(version, int) or not isinstance(metadata, dict):
        raise ArchiveError(f'{_METADATA} lacks the version or the metadata')
    if version != VERSION:
        raise ArchiveError(f'is of version {version}; this program reads version {VERSION}')
    return metadata


def _decode_array(name: str, data: bytes | bytearray) -> NDArray:
    """See the array in the bytes of an .npy file, without a copy."""
    header = _NPY.match(data, 0, _NPY_HEADER_LIMIT)
    if header is None:
        raise ArchiveError(f'{name!r} is no array of numbers: {bytes(data[:60])!r}')
    length, kind, dimensions = header.groups()
    start = header.end()
    if int.from_bytes(length, 'little') != start - 10 or start % _NPY_ALIGNMENT:
        raise ArchiveError(f'array {name!r} has a header of {start} bytes')
    if kind.decode('ascii', errors='replace') not in _DTYPES:
        raise ArchiveError(f'array {name!r} is of type {kind!r}')
    dtype = np.dtype(kind.decode('ascii'))
    shape = tuple(int(number) for number in dimensions.replace(b',', b' ').split())
    needed = math.prod(shape) * dtype.itemsize
    if needed != len(data) - start:
        raise ArchiveError(
            f'array {name!r} of shape {shape} needs {needed} bytes, not {len(data) - start}'
        )
    try:
        return np.ndarray(shape, dtype, data, start)
    except ValueError as error:  # too many dimensions, or too long ones beside a zero
        raise ArchiveError(f'array {name!r} of shape {shape}: {error}') from None
