# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Gaussians as PLY files, in the format that 3DGS viewers and trainers share."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..core.mapping.splats import PLANES, Splats
from .compressed_ply import is_compressed, read_compressed
from .digest import SEAL_LENGTH, is_mark, seal, seal_holds
from .ply_elements import PlyElement, PlyError, PlyReader
from .whole_files import replacing

# The reference implementation's order; some readers take properties by position.
_WRITTEN = (
    'x', 'y', 'z', 'nx', 'ny', 'nz', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', 'scale_0', 'scale_1',
    'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3',
)  # fmt: skip
_SEALED = b'ply\nformat binary_little_endian 1.0\ncomment '  # then the digest of the other bytes
_FLOATS = ('float', 'float32', 'double', 'float64')


def write_ply(path: Path | str, splats: Splats) -> None:
    """Write float properties in the usual order, little-endian; the normals (nx ny nz) are zeros.

    A comment of the header, which other programs skip, is the digest of the rest. The file is
    written completely or not at all. Raises `PlyError` if it cannot be written, or if Gaussians
    are not finite.
    """
    path = Path(path)
    bad = len(splats) - np.count_nonzero(_finite(splats.planes))
    if bad:
        raise PlyError(f'{path}: not written: {bad} of {len(splats)} Gaussians are not finite')
    header = [_SEALED.decode() + '?' * SEAL_LENGTH, f'element vertex {len(splats)}']
    header += [f'property float {name}' for name in _WRITTEN]
    rows = np.zeros((len(splats), len(_WRITTEN)), '<f4')
    for name, plane in zip(PLANES, splats.planes, strict=True):
        rows[:, _WRITTEN.index(name)] = plane
    try:
        with replacing(path) as temporary, open(temporary, 'w+b') as file:
            file.write('\n'.join([*header, 'end_header\n']).encode('ascii'))
            file.write(rows.data)
            file.write(seal(file, len(_SEALED), len(_SEALED) + SEAL_LENGTH))
    except OSError as error:
        raise PlyError(f'{path}: cannot be written: {error.strerror or error}') from error


def read_ply(path: Path | str, warn: Callable[[str], None] = warnings.warn) -> Splats:
    """Read the planes of `Splats` from a binary, an ascii or SuperSplat's compressed PLY.

    Properties may be in any order and among others. Of the spherical harmonics only degree 0 is
    read (not f_rest_*). A digest that `write_ply` put there must hold. Gaussians that are not
    finite, as trainers write them for an opacity of exactly one, are left out, and `warn` is told
    how many. Raises `PlyError` naming the file and what is wrong with it; no more is allocated
    than a few times what the file holds.
    """
    try:
        with open(path, 'rb') as file:
            _check_seal(file)
            planes = _read_planes(PlyReader(file))
    except OSError as error:
        raise PlyError(f'{path}: cannot be read: {error.strerror or error}') from error
    except PlyError as error:
        raise PlyError(f'{path}: {error}') from None
    finite = _finite(planes)
    if not finite.all():
        count, bad = len(finite), np.count_nonzero(~finite)
        text = f'{path}: {bad} of {count} Gaussians are not finite'
        if bad == count:
            raise PlyError(text)
        warn(f'{text} and are left out')
        planes = np.ascontiguousarray(planes[:, finite])
    return Splats(planes)


def _check_seal(file: BinaryIO) -> None:
    """Check the digest, if there is one; leave the file at its start. Raises `PlyError`."""
    sealed = file.read(len(_SEALED)) == _SEALED and is_mark(file)
    if sealed and not seal_holds(file, len(_SEALED)):
        raise PlyError('is damaged: its digest is not that of its contents')
    file.seek(0)


def _finite(planes: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.logical_and.reduce(np.isfinite(planes))


def _read_planes(reader: PlyReader) -> NDArray[np.float32]:
    vertex = reader.elements.get('vertex')
    if vertex is None:
        raise PlyError('header has no element vertex')
    chunks = read_compressed(reader) if is_compressed(vertex) else _read_plain(reader, vertex)
    planes = np.empty((len(PLANES), vertex.count), np.float32)
    with np.errstate(over='ignore'):  # doubles beyond float32 become infinite
        for start, chunk in chunks:
            for plane, values in zip(planes, chunk, strict=True):
                plane[start : start + len(values)] = values
    return planes


def _read_plain(
    reader: PlyReader, vertex: PlyElement
) -> Iterator[tuple[int, list[NDArray[np.floating]]]]:
    """Return an iterator over the index of a first Gaussian and the planes from there."""
    missing = [name for name in PLANES if name not in vertex.properties]
    if missing:
        raise PlyError(f'no 3DGS file: vertices lack {", ".join(missing)}')
    integers = [name for name in PLANES if vertex.properties[name] not in _FLOATS]
    if integers:
        raise PlyError(f'properties {", ".join(integers)} are neither float nor double')
    rows = reader.rows('vertex')
    return ((start, [chunk[name] for name in PLANES]) for start, chunk in rows)
