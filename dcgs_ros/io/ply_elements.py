# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The elements of a PLY file, ascii or binary, as rows of named numbers."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError

_SCALARS = {
    'char': 'i1', 'int8': 'i1', 'uchar': 'u1', 'uint8': 'u1', 'short': 'i2', 'int16': 'i2',
    'ushort': 'u2', 'uint16': 'u2', 'int': 'i4', 'int32': 'i4', 'uint': 'u4', 'uint32': 'u4',
    'float': 'f4', 'float32': 'f4', 'double': 'f8', 'float64': 'f8',
}  # fmt: skip
_ASCII = 'ascii'
_BYTE_ORDERS = {'binary_little_endian': '<', 'binary_big_endian': '>', _ASCII: '<'}
_END_OF_HEADER = re.compile(rb'^end_header[ \t]*\r?\n', re.MULTILINE)
_HEADER_LIMIT = 1 << 16  # bytes; degree 3 has 62 properties in 1.5 kB
_CHUNK = 1 << 15  # rows: a chunk and its planes stay in the cache


class PlyError(DcgsError):
    """A file is not a PLY of Gaussians, or Gaussians cannot be written as one."""


@dataclass(frozen=True)
class PlyElement:
    """An element of the header; its properties are names and types as they stand there."""

    name: str
    count: int
    properties: dict[str, str]

    @property
    def rows(self) -> str:
        """What its rows are called in messages."""
        return 'vertices' if self.name == 'vertex' else f'rows of {self.name[:40]!r}'

    def row(self, order: str) -> np.dtype[np.void]:
        """Return the type of a row; raises `PlyError` where rows have no fixed size."""
        for name, kind in self.properties.items():
            if kind == 'list':
                raise PlyError(f'property {name[:40]!r} of the {self.rows} is a list')
            if kind not in _SCALARS:
                raise PlyError(f"'property {kind[:40]} {name[:40]}' is not understood")
        kinds = self.properties.items()
        return np.dtype([(name, order + _SCALARS[kind]) for name, kind in kinds])


class PlyReader:
    """Reads the elements of an open file."""

    def __init__(self, file: BinaryIO) -> None:
        """Read the header; raises `PlyError`."""
        head = file.read(_HEADER_LIMIT)
        if not re.match(rb'ply[ \t]*\r?\n', head):
            raise PlyError(f'no PLY: begins with {head[:12]!r}')
        end = _END_OF_HEADER.search(head)
        if end is None:
            raise PlyError(f'no end_header within the first {len(head)} bytes')
        self._file, self._start = file, end.end()
        lines = head[: end.start()].decode('ascii', errors='replace').split('\n')
        self._format, self.elements = _parse(lines[1:])

    def rows(self, name: str) -> Iterator[tuple[int, NDArray[np.void]]]:
        """Return an iterator over chunks of an element's rows, each with its first row's index.

        Raises `PlyError` at once if the file is too short for the element and those before it.
        """
        self._file.seek(self._start)
        for element in self.elements.values():
            row = element.row(_BYTE_ORDERS[self._format])
            self._check_size(element, row)
            if element.name == name:
                return self._chunks(element, row)
            if self._format == _ASCII:
                next(islice(self._lines(), element.count, element.count), None)
            else:
                self._file.seek(element.count * row.itemsize, os.SEEK_CUR)
        raise PlyError(f'header has no element {name}')

    def _check_size(self, element: PlyElement, row: np.dtype[np.void]) -> None:
        there = os.fstat(self._file.fileno()).st_size - self._file.tell()
        # As text, a number takes a digit and a space or newline, which the last one may lack.
        size = 2 * len(element.properties) if self._format == _ASCII else row.itemsize
        needed = element.count * size - (self._format == _ASCII)
        if needed > there:
            raise PlyError(
                f'{element.count} {element.rows} of {size} bytes need {needed} bytes, '
                f'but {there} follow the header'
            )

    def _chunks(
        self, element: PlyElement, row: np.dtype[np.void]
    ) -> Iterator[tuple[int, NDArray[np.void]]]:
        lines = self._lines()
        for start in range(0, element.count, _CHUNK):
            size = min(_CHUNK, element.count - start)
            if self._format == _ASCII:
                chunk = _parse_rows(list(islice(lines, size)), row, start)
            else:
                chunk = np.fromfile(self._file, row, size)
            if len(chunk) < size:
                done = start + len(chunk)
                raise PlyError(f'ends after {done} of {element.count} {element.rows}')
            yield start, chunk

    def _lines(self) -> Iterator[bytes]:
        return (line for line in iter(self._file.readline, b'') if not line.isspace())


def _parse_rows(lines: list[bytes], row: np.dtype[np.void], start: int) -> NDArray[Any]:
    if not lines:
        return np.empty(0, row)
    try:
        with np.errstate(over='ignore'):  # a number beyond float32 is infinite
            return np.loadtxt(lines, row, comments=None, encoding='latin-1', ndmin=1)
    except ValueError as error:
        reason = str(error).partition(';')[0]
        raise PlyError(f'numbers after row {start} are no PLY: {reason}') from None


def _parse(lines: list[str]) -> tuple[str, dict[str, PlyElement]]:
    """Parse the lines between `ply` and `end_header`: the format, and the elements by name."""
    encoding, element = '', PlyElement('', 0, {})
    elements: dict[str, PlyElement] = {}
    for line in lines:
        match line.split():
            case [] | ['comment' | 'obj_info', *_]:
                pass
            case ['format', kind, '1.0'] if kind in _BYTE_ORDERS and not encoding:
                encoding = kind
            case ['format', *_]:
                raise PlyError(f'{line.strip()[:60]!r}: only one format 1.0 is read')
            case ['element', name, count] if name not in elements:
                element = elements[name] = PlyElement(name, _parse_count(count, name), {})
            case ['property', kind, *_, name] if elements and name not in element.properties:
                element.properties[name] = kind
            case ['property', _, *_, name] if name in element.properties:
                raise PlyError(f'property {name[:40]!r} of the {element.rows} is there twice')
            case _:
                raise PlyError(f'header line {line.strip()[:60]!r} is not understood')
    if not encoding:
        raise PlyError('header has no format')
    return encoding, elements


def _parse_count(text: str, name: str) -> int:
    if not re.fullmatch('[0-9]{1,18}', text):
        raise PlyError(f'{text[:40]!r} is no number of {PlyElement(name, 0, {}).rows}')
    return int(text)
