# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Gaussians as PLY files, in the format that 3DGS viewers and trainers share."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError
from ..core.mapping.splats import PLANES, Splats
from .whole_files import replacing

# The reference implementation's order; some readers take properties by position.
_WRITTEN = (
    'x', 'y', 'z', 'nx', 'ny', 'nz', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', 'scale_0', 'scale_1',
    'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3',
)  # fmt: skip
_SCALARS = {
    'char': 'i1', 'int8': 'i1', 'uchar': 'u1', 'uint8': 'u1', 'short': 'i2', 'int16': 'i2',
    'ushort': 'u2', 'uint16': 'u2', 'int': 'i4', 'int32': 'i4', 'uint': 'u4', 'uint32': 'u4',
    'float': 'f4', 'float32': 'f4', 'double': 'f8', 'float64': 'f8',
}  # fmt: skip
_BYTE_ORDERS = {'binary_little_endian': '<', 'binary_big_endian': '>'}
_END_OF_HEADER = re.compile(rb'^end_header[ \t]*\r?\n', re.MULTILINE)
_HEADER_LIMIT = 1 << 16  # bytes; degree 3 has 62 properties in 1.5 kB
_CHUNK = 1 << 15  # vertices: a chunk and its planes stay in the cache


class PlyError(DcgsError):
    """A file is not a PLY of Gaussians, or Gaussians cannot be written as one."""


@dataclass(frozen=True)
class _Header:
    vertices: int
    vertex: np.dtype[np.void]  # structured: all properties, in the file's order


def write_ply(path: Path | str, splats: Splats) -> None:
    """Write float properties in the usual order, little-endian; the normals (nx ny nz) are zeros.

    The file is written completely or not at all. Raises `PlyError` if it cannot be written, or if
    Gaussians are not finite.
    """
    path = Path(path)
    try:
        _check_finite(splats.planes)
    except PlyError as error:
        raise PlyError(f'{path}: not written: {error}') from None
    header = ['ply', 'format binary_little_endian 1.0', f'element vertex {len(splats)}']
    header += [f'property float {name}' for name in _WRITTEN]
    rows = np.zeros((len(splats), len(_WRITTEN)), '<f4')
    for name, plane in zip(PLANES, splats.planes, strict=True):
        rows[:, _WRITTEN.index(name)] = plane
    try:
        with replacing(path) as temporary, open(temporary, 'wb') as file:
            file.write('\n'.join([*header, 'end_header\n']).encode('ascii'))
            file.write(rows.data)
    except OSError as error:
        raise PlyError(f'{path}: cannot be written: {error.strerror or error}') from error


def read_ply(path: Path | str) -> Splats:
    """Read the planes of `Splats`; properties may be in any order and among others.

    Of the spherical harmonics only degree 0 is read (not f_rest_*). Raises `PlyError` naming the
    file and what is wrong with it; no more is allocated than the file holds.
    """
    try:
        with open(path, 'rb') as file:
            return Splats(_read_planes(file, _read_header(file)))
    except OSError as error:
        raise PlyError(f'{path}: cannot be read: {error.strerror or error}') from error
    except PlyError as error:
        raise PlyError(f'{path}: {error}') from None


def _read_header(file: BinaryIO) -> _Header:
    """Read the header and leave the file at the first vertex."""
    head = file.read(_HEADER_LIMIT)
    if not re.match(rb'ply[ \t]*\r?\n', head):
        raise PlyError(f'no PLY: begins with {head[:12]!r}')
    end = _END_OF_HEADER.search(head)
    if end is None:
        raise PlyError(f'no end_header within the first {len(head)} bytes')
    file.seek(end.end())
    lines = head[: end.start()].decode('ascii', errors='replace').split('\n')
    return _parse(lines[1:])


def _parse(lines: list[str]) -> _Header:
    """Parse the lines between `ply` and `end_header`."""
    order, vertices, element = '', -1, ''
    properties: list[tuple[str, str]] = []  # name and scalar type
    for line in lines:
        match line.split():
            case [] | ['comment' | 'obj_info', *_]:
                pass
            case ['format', kind, '1.0'] if kind in _BYTE_ORDERS and not order:
                order = _BYTE_ORDERS[kind]
            case ['format', *_]:
                raise PlyError(f'{line.strip()[:60]!r}: only one binary format 1.0 is read')
            case ['element', 'vertex', count] if not element:
                element, vertices = 'vertex', _parse_count(count)
            case ['element', name, _] if vertices >= 0 and name != 'vertex':
                element = name
            case ['element', name, _] if name != 'vertex':
                raise PlyError(f'element {name[:40]!r} comes before the vertices')
            case ['property', 'list', *_, name] if element == 'vertex':
                raise PlyError(f'property {name[:40]!r} of the vertices is a list')
            case ['property', kind, name] if element == 'vertex' and kind in _SCALARS:
                properties.append((name, _SCALARS[kind]))
            case ['property', _, _, *_] if element not in ('', 'vertex'):
                pass  # of an element after the vertices
            case _:
                raise PlyError(f'header line {line.strip()[:60]!r} is not understood')
    if not order or vertices < 0:
        raise PlyError(f'header has no {"element vertex" if order else "format"}')
    return _Header(vertices, _vertex(properties, order))


def _parse_count(text: str) -> int:
    if not re.fullmatch('[0-9]{1,18}', text):
        raise PlyError(f'{text[:40]!r} is no number of vertices')
    return int(text)


def _vertex(properties: list[tuple[str, str]], order: str) -> np.dtype[np.void]:
    """Return the type of one vertex; raises `PlyError` unless it holds a Gaussian."""
    kinds = dict(properties)
    if len(kinds) < len(properties):
        names = [name for name, _ in properties]
        twice = next(name for name in names if names.count(name) > 1)
        raise PlyError(f'property {twice[:40]!r} of the vertices is there twice')
    missing = [name for name in PLANES if name not in kinds]
    if missing:
        raise PlyError(f'no 3DGS file: vertices lack {", ".join(missing)}')
    integers = [name for name in PLANES if kinds[name] not in ('f4', 'f8')]
    if integers:
        raise PlyError(f'properties {", ".join(integers)} are neither float nor double')
    return np.dtype([(name, order + kind) for name, kind in properties])


def _read_planes(file: BinaryIO, header: _Header) -> NDArray[np.float32]:
    """Read planes (14, N); raises `PlyError` if the file is too short or values are not finite."""
    needed = header.vertices * header.vertex.itemsize
    there = os.fstat(file.fileno()).st_size - file.tell()
    if needed > there:
        raise PlyError(
            f'{header.vertices} vertices of {header.vertex.itemsize} bytes need {needed} bytes, '
            f'but {there} follow the header'
        )
    planes = np.empty((len(PLANES), header.vertices), np.float32)
    for start in range(0, header.vertices, _CHUNK):
        stop = min(start + _CHUNK, header.vertices)
        chunk = np.fromfile(file, header.vertex, stop - start)
        if len(chunk) < stop - start:
            raise PlyError(f'ends after {start + len(chunk)} of {header.vertices} vertices')
        with np.errstate(over='ignore'):  # doubles beyond float32 are reported as not finite below
            for plane, name in zip(planes, PLANES, strict=True):
                plane[start:stop] = chunk[name]
    _check_finite(planes)
    return planes


def _check_finite(planes: NDArray[np.float32]) -> None:
    bad = np.count_nonzero(~np.isfinite(planes).all(axis=0))
    if bad:
        raise PlyError(f'{bad} of {planes.shape[1]} Gaussians are not finite')
