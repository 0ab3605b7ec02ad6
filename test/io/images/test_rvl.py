# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""RVL gives the pixels that were coded, or is refused."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packing import rvl  # type: ignore[import-not-found]

from dcgs_ros.core.errors import FrameError
from dcgs_ros.io.images.rvl import decode_rvl, rvl_size

SIDES = st.integers(1, 40)


def test_the_words_are_those_of_the_definition() -> None:
    # Two zeros, two others: 1 and 1 + 1, then one zero, and one other, 2 - 2 + 0xFFFF - 2.
    depth = np.array([[0, 0, 1, 2, 0, 0xFFFF]], np.uint16)
    nibbles = '222211AFFFF30000'  # 2 * 0xFFFD is 0o377772
    data = struct.pack('<IIII', 6, 1, int(nibbles[:8], 16), int(nibbles[8:], 16))
    np.testing.assert_array_equal(decode_rvl(data, 'depth'), depth)
    assert rvl(depth) == data


@settings(max_examples=60, deadline=None)
@given(SIDES, SIDES, st.floats(0, 1), st.integers(0, 2**32))
def test_any_image_survives(width: int, height: int, holes: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.integers(0, 2**16, (height, width)).astype(np.uint16)
    depth[rng.random(depth.shape) < holes] = 0
    data = rvl(depth)
    assert rvl_size(data, 'depth') == (width, height)
    np.testing.assert_array_equal(decode_rvl(data, 'depth'), depth)


def test_every_cut_is_noticed() -> None:
    depth = np.random.default_rng(0).integers(1, 5000, (6, 8)).astype(np.uint16)
    data = rvl(depth)
    for length in range(0, len(data) - 4):
        with pytest.raises(FrameError, match=f'depth is cut off after {length} bytes'):
            decode_rvl(data[:length], 'depth')


@pytest.mark.parametrize('nibbles', ['20000000', '02220000'])
def test_a_run_beyond_the_image_is_refused(nibbles: str) -> None:
    data = struct.pack('<III', 1, 1, int(nibbles, 16))
    with pytest.raises(FrameError, match='or damaged'):
        decode_rvl(data, 'depth')


@pytest.mark.parametrize('size', [(0, 8), (8, 0), (2**16, 2**16), (2**31, 2**32 - 1)])
def test_an_implausible_size_is_refused_before_anything_is_allocated(
    size: tuple[int, int],
) -> None:
    with pytest.raises(FrameError, match=f'{size[0]}x{size[1]} pixels is not a plausible'):
        decode_rvl(struct.pack('<III', *size, 0), 'depth')


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_any_words_are_an_image_or_refused(words: bytes) -> None:
    try:
        assert decode_rvl(struct.pack('<II', 9, 7) + words, 'depth').shape == (7, 9)
    except FrameError:
        pass
