# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What every plugin of image_transport sends is read as the raw image would be."""

from __future__ import annotations

import struct
import sys
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from packing import pack, rvl, zstd  # type: ignore[import-not-found]

from dcgs_ros.core.errors import DcgsError, FrameError
from dcgs_ros.io.images.encodings import COLOR_ENCODINGS
from dcgs_ros.io.images.transports import image_size, read_color, read_depth
from dcgs_ros.io.ros_images import MessageError, UnknownEncodingError

WIDTH, HEIGHT = 64, 48
MM = 1000.0
JPEG_LEVELS = 3.0  # mean error in grey levels of a smooth image at quality 95
BAYER_JPEG_LEVELS = 8.0  # of a mosaic, which no JPEG holds well
A, B = 10100.0, -1009.0  # of inverse depth: quantisation 100, farthest 10 m


def compressed(format_: str, data: bytes) -> SimpleNamespace:
    return SimpleNamespace(format=format_, data=np.frombuffer(data, np.uint8))


def smooth() -> NDArray[np.uint8]:
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return np.stack([40 + 3 * u, 220 - 4 * v, 30 + u + 2 * v], axis=-1).astype(np.uint8)


def millimetres() -> NDArray[np.uint16]:
    rng = np.random.default_rng(8)
    depth = rng.integers(300, 9000, (HEIGHT, WIDTH)).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.3] = 0
    return depth


def encoded(suffix: str, pixels: NDArray[Any]) -> bytes:
    """Return an image file of RGB, or of one channel."""
    if pixels.ndim == 3:
        pixels = pixels[..., ::-1]
    return bytes(cv2.imencode(suffix, np.ascontiguousarray(pixels))[1])


@pytest.mark.parametrize(
    'format_',
    [
        'bgr8; jpeg compressed bgr8', 'rgb8; jpeg compressed bgr8', 'bgra8; jpeg compressed bgr8',
        'rgba8; jpeg compressed bgr8', 'rgb8; jpeg compressed rgb8', 'bgr8; jpeg compressed',
        'rgb8;jpeg compressed bgr8', 'yuv422_yuy2; jpeg compressed bgr8', 'nv12; jpeg compressed ',
        'bayer_rggb8; jpeg compressed bgr8', '8UC3; jpeg compressed ', 'jpeg', 'jpg', 'JPEG',
        '.jpg', 'mjpeg', 'image/jpeg', 'jpeg compressed bgr8', '',
    ],
)  # fmt: skip
def test_a_jpeg_has_its_own_colours_whatever_the_format_says(format_: str) -> None:
    message = compressed(format_, encoded('.jpg', smooth()))
    assert image_size(message) == (WIDTH, HEIGHT)
    assert np.abs(read_color(message).astype(int) - smooth()).mean() < JPEG_LEVELS


@pytest.mark.parametrize(
    'format_', ['rgb8; png compressed bgr8', 'bgra8; png compressed bgr8', 'png', 'image/png', '']
)
def test_a_png_is_exact(format_: str) -> None:
    message = compressed(format_, encoded('.png', smooth()))
    np.testing.assert_array_equal(read_color(message), smooth())


def test_a_png_of_16_bits_or_with_opacity_is_colour_too() -> None:
    wide = smooth().astype(np.uint16) << 8
    message = compressed('rgb16; png compressed bgr16', encoded('.png', wide))
    np.testing.assert_array_equal(read_color(message), smooth())
    opaque = cv2.cvtColor(smooth(), cv2.COLOR_RGB2BGRA)
    message = compressed('rgba8; png compressed', bytes(cv2.imencode('.png', opaque)[1]))
    np.testing.assert_array_equal(read_color(message), smooth())
    grey = smooth()[..., 1]
    twelve = compressed('mono16; png compressed ', encoded('.png', grey.astype(np.uint16) << 4))
    np.testing.assert_array_equal(read_color(twelve)[..., 0], grey)


@pytest.mark.parametrize('encoding', [name for name in COLOR_ENCODINGS if 'bayer' in name])
@pytest.mark.parametrize('suffix', ['.jpg', '.png'])
def test_a_compressed_mosaic_is_interpolated(encoding: str, suffix: str) -> None:
    mosaic = pack(smooth(), encoding if suffix == '.png' else encoding.replace('16', '8'))
    codec = 'png' if suffix == '.png' else 'jpeg'
    message = compressed(f'{encoding}; {codec} compressed ', encoded(suffix, mosaic))
    error = np.abs(read_color(message).astype(int) - smooth())[2:-2, 2:-2]
    assert error.mean() < BAYER_JPEG_LEVELS


@pytest.mark.parametrize('format_', ['16UC1; compressedDepth rvl', 'mono16; compressedDepth rvl'])
def test_rvl_is_exact(format_: str) -> None:
    message = compressed(format_, bytes(12) + rvl(millimetres()))
    assert image_size(message) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(read_depth(message), millimetres() / np.float32(MM))
    np.testing.assert_array_equal(read_depth(message, 5000.0), millimetres() / np.float32(5000))


def test_inverse_depth_in_rvl_is_that_in_png() -> None:
    header = struct.pack('<Iff', 0, A, B)
    by_rvl = compressed(' 32FC1 ; compressedDepth rvl', header + rvl(millimetres()))
    by_png = compressed('32FC1; compressedDepth png', header + encoded('.png', millimetres()))
    expected = np.float32(A) / (millimetres() - np.float32(B))
    expected[millimetres() == 0] = 0
    np.testing.assert_allclose(read_depth(by_rvl), expected, rtol=1e-6)
    np.testing.assert_array_equal(read_depth(by_rvl), read_depth(by_png))


@pytest.mark.parametrize('format_', ['16UC1; png compressed ', 'png', '16UC1; compressedDepth'])
def test_depth_may_be_a_png_alone(format_: str) -> None:
    message = compressed(format_, encoded('.png', millimetres()))
    np.testing.assert_array_equal(read_depth(message), millimetres() / np.float32(MM))


@pytest.mark.parametrize('really', [False, True])
@pytest.mark.parametrize('encoding', ['rgb8', 'bgra8', 'mono8', 'nv12', 'nv24', 'bayer_rggb8'])
def test_zstd_holds_an_image_as_it_is(encoding: str, really: bool) -> None:
    pixels = pack(smooth(), encoding)
    message = compressed('zstd', zstd(pixels, HEIGHT, encoding, really))
    raw = SimpleNamespace(
        width=WIDTH, height=HEIGHT, encoding=encoding, is_bigendian=0,
        step=pixels.nbytes // len(pixels), data=pixels.tobytes(),
    )  # fmt: skip
    assert image_size(message) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(read_color(message), read_color(raw))


@pytest.mark.parametrize('really', [False, True])
def test_zstd_holds_depth_in_either_unit(really: bool) -> None:
    depth_m = millimetres() / np.float32(MM)
    for pixels, encoding in ((millimetres(), '16UC1'), (depth_m, '32FC1')):
        message = compressed('zstd', zstd(pixels, HEIGHT, encoding, really))
        np.testing.assert_array_equal(read_depth(message), depth_m)


def test_zstd_without_its_package_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    message = compressed('zstd', zstd(millimetres(), HEIGHT, '16UC1', really=True))
    monkeypatch.setitem(sys.modules, 'zstandard', None)
    with pytest.raises(MessageError, match='pip install zstandard'):
        read_depth(message)


@pytest.mark.parametrize('really', [False, True])
def test_zstd_that_claims_or_holds_too_much_is_refused(really: bool) -> None:
    head = struct.pack('<IIBII', HEIGHT, WIDTH, 0, 2**31, 5) + b'16UC1'
    with pytest.raises(MessageError, match='48 rows of 2147483648 bytes are no plausible image'):
        read_depth(compressed('zstd', head + b'more'))
    bomb = zstd(np.zeros((64, 2**18), np.uint8), HEIGHT, 'mono8', really)
    bomb = struct.pack('<IIBII', HEIGHT, WIDTH, 0, WIDTH, 5) + bomb[17:]
    try:
        assert read_color(compressed('zstd', bomb)).shape == (HEIGHT, WIDTH)
    except MessageError as error:
        assert 'are compressed where at most' in str(error)


@pytest.mark.parametrize('format_', ['h264', 'bgr8; qoi compressed bgr8', 'theora', 'webp'])
def test_a_codec_that_nobody_reads_is_named_with_those_that_are(format_: str) -> None:
    message = compressed(format_, b'\x00\x00\x00\x01\x67' * 30)
    with pytest.raises(UnknownEncodingError, match=f"'{format_}', not as one of png, jpeg, zstd"):
        read_color(message)
    with pytest.raises(UnknownEncodingError, match='not as one of png, rvl, zstd'):
        read_depth(message)


FORMATS = st.sampled_from(
    ['zstd', '16UC1; compressedDepth rvl', '32FC1; compressedDepth rvl', 'png', 'bayer_rggb8; png',
     '32FC1; compressedDepth png']
)  # fmt: skip
PAYLOADS = [
    bytes(12) + rvl(millimetres()[:8, :9]),
    struct.pack('<Iff', 0, A, B) + encoded('.png', millimetres()[:8, :9]),
    zstd(millimetres()[:8, :9], 8, '16UC1', really=True),
    zstd(pack(smooth()[:8, :8], 'nv12'), 8, 'nv12', really=False),
    encoded('.png', pack(smooth()[:8, :8], 'bayer_rggb8')),
]


@settings(max_examples=100, deadline=None)
@given(FORMATS, st.sampled_from(PAYLOADS), st.data())
def test_any_bytes_are_an_image_or_refused(
    format_: str, payload: bytes, data: st.DataObject
) -> None:
    cut = data.draw(st.integers(0, len(payload)))
    hostile = bytearray(payload[:cut])
    for _ in range(data.draw(st.integers(0, 3))):
        if hostile:
            hostile[data.draw(st.integers(0, len(hostile) - 1))] = data.draw(st.integers(0, 255))
    for read in (read_color, read_depth):
        try:
            pixels = read(compressed(format_, bytes(hostile)))
            assert pixels.ndim in (2, 3)
        except DcgsError as error:
            assert isinstance(error, FrameError | MessageError)
