# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""SuperSplat's compressed PLY is read as its bits say."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.mapping.splats import SH_C0, Splats
from dcgs_ros.io.ply import PlyError, read_ply

SIDES = [
    f'{side}_{name}'
    for name in ('x', 'y', 'z', 'scale_x', 'scale_y', 'scale_z', 'r', 'g', 'b')
    for side in ('min', 'max')
]
WORDS = ['packed_position', 'packed_rotation', 'packed_scale', 'packed_color']
TINY = 1e-6  # of float32


def compressed(
    bounds: NDArray[Any], words: NDArray[Any], kinds: tuple[str, str] = ('float', 'uint')
) -> bytes:
    """Return a file of blocks (C, 18 or 12) and packed vertices (N, 4)."""
    lines = ['ply', 'format binary_little_endian 1.0', f'element chunk {len(bounds)}']
    lines += [f'property {kinds[0]} {name}' for name in SIDES[: bounds.shape[1]]]
    lines += [f'element vertex {len(words)}']
    lines += [f'property {kinds[1]} {name}' for name in WORDS]
    lines += [f'element sh {len(words)}', 'property uchar f_rest_0', 'end_header', '']
    data = bounds.astype('<f4').tobytes() + words.astype('<u4').tobytes() + bytes(len(words))
    return '\n'.join(lines).encode() + data


def read(path: Path, content: bytes) -> Splats:
    path.write_bytes(content)
    return read_ply(path)


def test_the_corners_of_the_bounds_are_the_bounds(tmp_path: Path) -> None:
    """All bits clear are the lower ones, all set the upper ones; here of one quaternion each."""
    bounds = np.arange(18.0)[None]
    words = np.array([[0, 0, 0, 0], [2**32 - 1] * 4], np.uint32)
    planes = read(tmp_path / 'a.ply', compressed(bounds, words)).planes
    for k, side in enumerate((bounds[0, 0::2], bounds[0, 1::2])):
        assert planes[:6, k] == pytest.approx(side[:6])
        assert planes[11:, k] == pytest.approx((side[6:] - 0.5) / SH_C0)
    assert planes[6:10, 0] == pytest.approx([0, *[-math.sqrt(0.5)] * 3])  # w is the largest
    assert planes[6:10, 1] == pytest.approx([*[math.sqrt(0.5)] * 3, 0])  # z is
    logit = math.log((1 - 1e-6) / 1e-6)
    assert planes[10] == pytest.approx([-logit, logit], rel=1e-2)


@pytest.mark.parametrize('largest', range(4))
def test_fields_are_where_the_format_has_them(tmp_path: Path, largest: int) -> None:
    bounds = np.array([[0, 2047, 0, 1023, 0, 2047] * 2], float)
    position, scale = (1 << 21 | 2 << 11 | 3), (2047 << 21 | 1022 << 11 | 4)
    rotation = largest << 30 | 511 << 20 | 512 << 10 | 800
    words = np.array([[position, rotation, scale, 0x33_66_99_80]], np.uint32)
    planes = read(tmp_path / 'a.ply', compressed(bounds, words)).planes[:, 0]
    assert planes[:6] == pytest.approx([1, 2, 3, 2047, 1022, 4], abs=2047 * TINY)
    others = [(code / 1023 - 0.5) * math.sqrt(2) for code in (511, 512, 800)]
    assert np.delete(planes[6:10], largest) == pytest.approx(others, abs=TINY)
    assert np.linalg.norm(planes[6:10]) == pytest.approx(1)
    assert planes[6 + largest] > 0
    assert 1 / (1 + math.exp(-planes[10])) == pytest.approx(0x80 / 255)
    rgb = 0.5 + SH_C0 * planes[11:]  # without bounds colours are shares of one
    assert rgb == pytest.approx([0x33 / 255, 0x66 / 255, 0x99 / 255])


def test_each_block_of_256_has_its_own_bounds(tmp_path: Path) -> None:
    count = 40_000  # more than are read at once
    blocks = -(-count // 256)
    bounds = np.repeat(np.arange(blocks, dtype=float)[:, None], 18, axis=1)
    words = np.random.default_rng(0).integers(2**32, size=(count, 4))
    splats = read(tmp_path / 'a.ply', compressed(bounds, words))
    assert np.array_equal(splats.means, np.tile(np.arange(count) // 256, (3, 1)))


def test_infinite_bounds_spoil_their_block_only(tmp_path: Path) -> None:
    bounds = np.zeros((2, 18))
    bounds[1, 7] = np.inf
    path, warnings = tmp_path / 'a.ply', list[str]()
    path.write_bytes(compressed(bounds, np.full((300, 4), 5)))
    assert len(read_ply(path, warnings.append)) == 256
    assert '44 of 300 Gaussians are not finite' in warnings[0]


def test_what_is_no_compressed_file_is_refused_with_the_reason(tmp_path: Path) -> None:
    words, path = np.zeros((257, 4)), tmp_path / 'a.ply'
    good = compressed(np.zeros((2, 18)), words)
    for content, reason in (
        (compressed(np.zeros((1, 18)), words), '1 chunks are too few for 257 vertices'),
        (
            compressed(np.zeros((2, 6)), words),
            "rows of 'chunk' lack min_scale_x, .* of type float",
        ),
        (compressed(np.zeros((2, 18)), words, ('float', 'int')), 'lack packed_position, .* uint'),
        (compressed(np.zeros((2, 18)), words, ('half', 'uint')), "'chunk' lack min_x, .* float"),
        (good.replace(b'element chunk 2', b'element other 2'), "there is no element 'chunk'"),
        (good.replace(b'vertex 257', b'vertex 999'), 'too few'),
        (good[:-600], '257 vertices of 16 bytes need 4112 bytes, but 3769 follow'),
        (good[: -257 * 17 - 8], '257 vertices of 16 bytes|need 144 bytes, but 136 follow'),
    ):
        with pytest.raises(PlyError, match=rf'a\.ply: .*({reason})'):
            read(path, content)
