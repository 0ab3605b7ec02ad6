# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Archives of named arrays, bytes and JSON: zip files that `np.load` opens, too.

Members are stored, not deflated: floats hardly compress, and a stored member cannot expand. The
first is `metadata.json` with the version; arrays are `NAME.npy`. Equal contents give equal bytes.
The zip's comment is the digest of all other bytes, which reading verifies.
"""

from __future__ import annotations

import json
import math
import os
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .digest import SEAL_LENGTH, is_sealed, seal_holds, seal_zip
from .whole_files import replacing
from .zip_members import MEMBER_LIMIT, MEMBERS_LIMIT, ArchiveError, check_name, read_members

# Of the archive and of what the package keeps in one. 1: without a digest; of the tracker's map
# only viewpoints and Sigma_t, and no sessions.
VERSION = 3

_FORMAT = 'dcgs_ros archive'
_METADATA = 'metadata.json'
_METADATA_LIMIT = 1 << 16  # bytes; parsed JSON takes up to thirty times its size
_DTYPES = frozenset(
    ['|b1', '|i1', '|u1', '<i2', '<u2', '<i4', '<u4', '<i8', '<u8', '<f4', '<f8']
)  # fmt: skip

# Exactly the header that numpy writes; `ast.literal_eval`, which numpy uses, accepts more.
_NPY = re.compile(
    rb"\x93NUMPY\x01\x00(..)\{'descr': '([^']{1,20})', 'fortran_order': False, "
    rb"'shape': \((|[0-9]{1,18},|[0-9]{1,18}(?:, [0-9]{1,18})+)\), \} *\n",
    re.DOTALL,
)
_NPY_HEADER_LIMIT = 1024  # bytes
_NPY_ALIGNMENT = 16  # bytes, of the data after the header


@dataclass(frozen=True)
class Archive:
    """The contents of an archive; its arrays are writable."""

    arrays: Mapping[str, NDArray[Any]]
    metadata: Mapping[str, Any]
    blobs: Mapping[str, bytes]
    version: int = VERSION  # of the file that it was read from


def write_archive(
    path: Path | str,
    arrays: Mapping[str, NDArray[Any]],
    metadata: Mapping[str, Any],
    blobs: Mapping[str, bytes],
) -> None:
    """Write an archive, with its members in the order given.

    `metadata` must fit JSON of up to 64 KiB. A blob's name, with its suffix, is its member's. The
    file is written completely or not at all. Raises `ArchiveError` for a member that cannot be
    stored, naming it, or if the file cannot be written.
    """
    path = Path(path)
    try:
        members = _members_to_write(arrays, metadata, blobs)
    except ArchiveError as error:
        raise ArchiveError(f'{path}: not written: {error}') from None
    try:
        with replacing(path) as temporary:
            _write_zip(temporary, members)
            seal_zip(temporary)
    except OSError as error:
        raise ArchiveError(f'{path}: cannot be written: {error.strerror or error}') from error


def _write_zip(path: Path, members: Mapping[str, bytes | NDArray[Any]]) -> None:
    with zipfile.ZipFile(path, 'w') as archive:
        for name, content in members.items():
            # By default ZipInfo's date is 1980 and its method to store.
            with archive.open(zipfile.ZipInfo(name), 'w') as member:
                if isinstance(content, bytes):
                    member.write(content)
                else:
                    np.lib.format.write_array(member, content, (1, 0), allow_pickle=False)


def read_archive(path: Path | str) -> Archive:
    """Read an archive, in no more memory than the file's size and a few MiB.

    Raises `ArchiveError` naming the file and what is wrong with it.
    """
    try:
        with open(path, 'rb') as file:
            return _read(file)
    except OSError as error:
        raise ArchiveError(f'{path}: cannot be read: {error.strerror or error}') from error
    except ArchiveError as error:
        raise ArchiveError(f'{path}: {error}') from None


def _members_to_write(
    arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any], blobs: Mapping[str, bytes]
) -> dict[str, bytes | NDArray[Any]]:
    """Return the members by name, all checked; raises `ArchiveError`."""
    members: dict[str, bytes | NDArray[Any]] = {_METADATA: _encode_metadata(metadata)}
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
        check_name(name)
    if len(members) > MEMBERS_LIMIT:
        raise ArchiveError(f'{len(members)} members are more than {MEMBERS_LIMIT}')
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


def _check_size(name: str, size: int) -> None:
    if size > MEMBER_LIMIT:
        raise ArchiveError(f'{name!r} has {size} bytes, more than {MEMBER_LIMIT}')


def _read(file: BufferedReader) -> Archive:
    members = read_members(file)
    name, data = next(members)
    if name != _METADATA:
        raise ArchiveError(f'begins with {name!r}, not with {_METADATA}')
    version, metadata = _decode_metadata(data)
    arrays: dict[str, NDArray[Any]] = {}
    blobs: dict[str, bytes] = {}
    for name, data in members:
        if name.endswith('.npy'):
            name = name.removesuffix('.npy')
            arrays[name] = _decode_array(name, data)
        else:
            blobs[name] = bytes(data)
    if version > 1:
        _check_seal(file)
    return Archive(arrays, metadata, blobs, version)


def _check_seal(file: BufferedReader) -> None:
    """Check the digest of the whole file; raises `ArchiveError`."""
    if not is_sealed(file):
        raise ArchiveError('has no digest at its end')
    if not seal_holds(file, os.fstat(file.fileno()).st_size - SEAL_LENGTH):
        raise ArchiveError('is damaged: its digest is not that of its contents')


def _decode_metadata(data: bytes | bytearray) -> tuple[int, dict[str, Any]]:
    """Return version and metadata; raises `ArchiveError` if the format or version is another."""
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
    if not 1 <= version <= VERSION:
        raise ArchiveError(f'is of version {version}; this program reads versions 1 to {VERSION}')
    return version, metadata


def _decode_array(name: str, data: bytes | bytearray) -> NDArray[Any]:
    """Return the array in the bytes of an .npy file, without a copy."""
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
