# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""SuperSplat's compressed PLY: 16 bytes a Gaussian, within the bounds of each 256 of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.mapping.splats import SH_C0
from .ply_elements import PlyElement, PlyError, PlyReader
from .quantized import Floats, opacity_logits, smallest_three, unit_quaternions

_BLOCK = 256  # Gaussians with common bounds
_WORDS = tuple(f'packed_{name}' for name in ('position', 'rotation', 'scale', 'color'))
_BOUNDED = ('x', 'y', 'z', 'scale_x', 'scale_y', 'scale_z')
_COLORS = ('r', 'g', 'b')  # bounded since format 2
_SQRT_2 = 2**0.5


def is_compressed(vertex: PlyElement) -> bool:
    """Return whether vertices are packed."""
    return _WORDS[0] in vertex.properties


def read_compressed(reader: PlyReader) -> Iterator[tuple[int, Floats]]:
    """Return an iterator over the index of a first Gaussian and planes (14, n) from there."""
    vertex, block = reader.elements['vertex'], reader.elements.get('chunk')
    if block is None:
        raise PlyError("vertices are packed, but there is no element 'chunk' with their bounds")
    _check(vertex, _WORDS, ('uint', 'uint32'))
    sides = [f'{side}_{name}' for name in _BOUNDED for side in ('min', 'max')]
    _check(block, sides, ('float', 'float32'))
    if block.count * _BLOCK < vertex.count:
        raise PlyError(f'{block.count} chunks are too few for {vertex.count} vertices')
    bounds = np.concatenate([rows for _, rows in reader.rows('chunk')] or [np.empty(0, 'V1')])
    return (
        (start, _unpack(rows, bounds[np.arange(start, start + len(rows)) // _BLOCK]))
        for start, rows in reader.rows('vertex')
    )


def _check(element: PlyElement, names: Sequence[str], kinds: Sequence[str]) -> None:
    wrong = [name for name in names if element.properties.get(name) not in kinds]
    if wrong:
        what = f'the {element.rows} lack {", ".join(wrong)} of type {kinds[0]}'
        raise PlyError(f'no compressed 3DGS file: {what}')


def _unpack(rows: NDArray[np.void], bounds: NDArray[np.void]) -> Floats:
    """Return planes (14, n) of packed rows (n,), each with the bounds of its block."""

    def within(name: str, share: Floats) -> Floats:
        low, high = (bounds[f'{side}_{name}'].astype(np.float64) for side in ('min', 'max'))
        return low + share * (high - low)

    position, rotation, scale, color = (rows[name].astype(np.uint32) for name in _WORDS)
    shares = [*_shares(position), *_shares(scale)]
    with np.errstate(invalid='ignore', over='ignore'):  # of infinite bounds
        x, y, z, *scales = (within(*pair) for pair in zip(_BOUNDED, shares, strict=True))
        rgb, opacity = [(color >> shift & 255) / 255 for shift in (24, 16, 8)], color & 255
        if f'min_{_COLORS[0]}' in (bounds.dtype.names or ()):
            rgb = [within(*pair) for pair in zip(_COLORS, rgb, strict=True)]
    largest, codes = smallest_three(rotation)
    quats_wxyz = unit_quaternions(largest, (codes / 1023 - 0.5) * _SQRT_2)
    sh_dc = [(channel - 0.5) / SH_C0 for channel in rgb]
    return np.stack([x, y, z, *scales, *quats_wxyz, opacity_logits(opacity / 255), *sh_dc])


def _shares(words: NDArray[np.uint32]) -> tuple[Floats, Floats, Floats]:
    """Return three numbers within 0 to 1, of 11, 10 and 11 bits."""
    return (words >> 21) / 2047, (words >> 11 & 1023) / 1023, (words & 2047) / 2047
