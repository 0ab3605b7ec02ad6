# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Every encoding of colour gives the colours that were packed into it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from packing import pack  # type: ignore[import-not-found]

from dcgs_ros.io.images.encodings import COLOR_ENCODINGS
from dcgs_ros.io.ros_images import MessageError, image_size, read_color

WIDTH, HEIGHT = 64, 48
CHROMA_LEVELS = 3.0  # what rounding of brightness and chroma to 8 bits costs
BAYER_LEVELS = 10.0  # mean, of interpolating a smooth image
EXACT = [name for name in COLOR_ENCODINGS if not name.startswith(('bayer', 'yu', 'uy', 'nv'))]
PLANAR = {'nv12': 1.5, 'nv21': 1.5, 'nv24': 3.0}


def noise() -> NDArray[np.uint8]:
    return np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def smooth() -> NDArray[np.uint8]:
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return np.stack([40 + 3 * u, 220 - 4 * v, 30 + u + 2 * v], axis=-1).astype(np.uint8)


def blocks() -> NDArray[np.uint8]:
    """Colours that each fill 2x2 pixels, so that sharing chroma costs nothing."""
    colors = np.random.default_rng(6).integers(0, 256, (HEIGHT // 2, WIDTH // 2, 3), np.uint8)
    return colors.repeat(2, axis=0).repeat(2, axis=1)


def image(pixels: NDArray[Any], encoding: str, **changes: Any) -> SimpleNamespace:
    rows = len(pixels)
    fields = {
        'width': pixels.shape[1], 'height': int(rows / PLANAR.get(encoding, 1.0)),
        'encoding': encoding, 'is_bigendian': 0, 'step': pixels.nbytes // rows,
        'data': pixels.tobytes(),
    }  # fmt: skip
    return SimpleNamespace(**{**fields, **changes})


def error_levels(color: NDArray[np.uint8], rgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    assert color.shape == rgb.shape and color.dtype == np.uint8 and color.flags.c_contiguous
    return np.abs(color.astype(float) - rgb)


@pytest.mark.parametrize('encoding', EXACT)
def test_plain_channels_are_exact(encoding: str) -> None:
    rgb = noise()
    color = read_color(image(pack(rgb, encoding), encoding))
    grey = encoding in ('mono8', 'mono16', '8UC1')
    np.testing.assert_array_equal(color, rgb[..., 1] if grey else rgb)
    assert color.dtype == np.uint8 and color.flags.c_contiguous


@pytest.mark.parametrize('encoding', [name for name in EXACT if '16' in name])
def test_wide_channels_may_be_of_the_other_byte_order(encoding: str) -> None:
    pixels = pack(noise(), encoding)
    swapped = image(pixels.byteswap(), encoding, is_bigendian=1)
    np.testing.assert_array_equal(read_color(swapped), read_color(image(pixels, encoding)))


def test_twelve_bits_in_sixteen_are_not_black() -> None:
    grey = noise()[..., 1]
    pixels = grey.astype(np.uint16) << 4 | 7
    np.testing.assert_array_equal(read_color(image(pixels, 'mono16')), grey)


@pytest.mark.parametrize(
    'encoding', ['uyvy', 'yuv422', 'yuyv', 'yuv422_yuy2', 'nv12', 'nv21', 'nv24']
)
def test_brightness_and_chroma_are_those_of_bt601(encoding: str) -> None:
    rgb = blocks()
    error = error_levels(read_color(image(pack(rgb, encoding), encoding)), rgb)
    assert error.max() <= CHROMA_LEVELS


@pytest.mark.parametrize('encoding', [name for name in COLOR_ENCODINGS if 'bayer' in name])
def test_a_mosaic_is_interpolated_from_its_own_pattern(encoding: str) -> None:
    flat = np.full((HEIGHT, WIDTH, 3), (200, 90, 20), np.uint8)
    error = error_levels(read_color(image(pack(flat, encoding), encoding)), flat)
    assert not error.any()
    error = error_levels(read_color(image(pack(smooth(), encoding), encoding)), smooth())
    assert error.mean() < BAYER_LEVELS and error[2:-2, 2:-2].max() <= BAYER_LEVELS


@pytest.mark.parametrize('encoding', PLANAR)
def test_planes_are_found_however_a_driver_counts_their_rows(encoding: str) -> None:
    pixels = pack(blocks(), encoding)
    expected = read_color(image(pixels, encoding))
    rows = PLANAR[encoding]
    padded = np.pad(pixels, ((0, 0), (0, 8))) if encoding != 'nv24' else pixels
    for message in (
        image(pixels, encoding, height=len(pixels)),  # of all planes
        image(pixels, encoding, step=int(rows * WIDTH)),  # of a pixel's share of all planes
        image(pixels, encoding, step=2 * WIDTH),
        image(padded, encoding, width=WIDTH),
        image(pixels, encoding, data=pixels.tobytes() + b'trailer'),
    ):
        assert image_size(message) == (WIDTH, HEIGHT)
        np.testing.assert_array_equal(read_color(message), expected)


@pytest.mark.parametrize('encoding', PLANAR)
def test_planes_that_are_cut_off_are_refused(encoding: str) -> None:
    pixels = pack(blocks(), encoding)
    short = image(pixels, encoding, data=pixels.tobytes()[:-1])
    with pytest.raises(MessageError, match=rf'{len(pixels)} rows of {WIDTH} bytes are'):
        read_color(short)


@pytest.mark.parametrize(
    ('encoding', 'size', 'block'),
    [('yuyv', (15, 4), '2x1'), ('uyvy', (17, 4), '2x1'), ('nv12', (16, 5), '2x2'),
     ('nv24', (15, 4), '2x2')],
)  # fmt: skip
def test_half_a_block_is_refused(encoding: str, size: tuple[int, int], block: str) -> None:
    width, height = size
    pixels = np.zeros((3 * height, 2 * width), np.uint8)
    message = image(pixels, encoding, width=width, height=height)
    reason = f'{encoding} of {width}x{height} pixels is not whole blocks of {block}'
    with pytest.raises(MessageError, match=reason):
        read_color(message)
