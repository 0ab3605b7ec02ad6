# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Compressed images of a recording decode to the originals, or are refused."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    CAMERA,
    COLOR,
    INTERVAL_NS,
    START_NS,
    color_of,
    depth_of,
    info_entry,
    recording,
    write_bag,
)
from realsense_bags import (  # type: ignore[import-not-found]
    compressed,
    compressed_entry,
    encoded,
    quantised,
)

from dcgs_ros.core.errors import FrameError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.bag import images as bag_images
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.source import BadFrame
from dcgs_ros.io.images.transports import image_size
from dcgs_ros.io.ros_images import MessageError

MM = 1000.0
MUTATIONS = 2000
MOST_BYTES = 4_000_000  # of Python's and NumPy's, over all mutations of images of 64x48 pixels
JPEG_LEVELS = 3.0  # mean error in grey levels of a smooth image at quality 95
BAD = (FrameError, MessageError)


def message(format_: str, data: bytes) -> SimpleNamespace:
    return SimpleNamespace(format=format_, data=np.frombuffer(data, np.uint8))


def smooth() -> NDArray[np.uint8]:
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    return np.stack([4 * u, 5 * v, 2 * u + 2 * v], axis=-1).astype(np.uint8)


DEPTH16 = '16UC1; compressedDepth png'
PNG16 = encoded('.png', depth_of(0))


def test_a_recording_of_compressed_images_is_read_like_a_raw_one(tmp_path: Path) -> None:
    entries = [info_entry(START_NS, CAMERA), *compressed(3)]
    small = list(BagSource(write_bag(tmp_path / 'small', entries)))
    raw = list(BagSource(write_bag(tmp_path / 'raw', recording(3))))
    for one, other in zip(small, raw, strict=True):
        assert isinstance(one, RgbdFrame) and isinstance(other, RgbdFrame)
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)


def test_the_size_of_compressed_images_is_that_of_given_intrinsics(tmp_path: Path) -> None:
    jpeg = compressed_entry(f'{COLOR}/compressed', START_NS, 'jpeg', encoded('.jpg', smooth()))
    entries = [jpeg, *(entry for entry in compressed(1) if 'depth' in entry.topic)]
    source = BagSource(write_bag(tmp_path / 'bag', entries), '60,61,32,24')
    assert (source.camera.width, source.camera.height) == (64, 48)


@pytest.mark.parametrize(
    'format_', ['rgb8; jpeg compressed bgr8', 'bgr8; jpeg compressed', 'jpeg']
)
def test_jpeg_is_read_as_rgb(format_: str) -> None:
    color = bag_images.color_of(message(format_, encoded('.jpg', smooth())), CAMERA)
    assert np.abs(color.astype(int) - smooth()).mean() < JPEG_LEVELS


@pytest.mark.parametrize('options', [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]])
def test_jpegs_of_any_kind_tell_their_size(options: list[int]) -> None:
    data = bytes(cv2.imencode('.jpg', smooth(), options)[1])
    comment = data[:2] + b'\xff\xfe\x00\x06abcd' + b'\xff' + data[2:]  # and a padded mark
    for jpeg in (data, comment):
        assert image_size(message('jpeg', jpeg)) == (64, 48)


@pytest.mark.parametrize(
    ('format_', 'header'),
    [(DEPTH16, bytes(12)), ('16UC1; compressedDepth', b'\xff' * 12), ('16UC1; png', b'')],
)
def test_depth_of_16_bits_comes_with_and_without_a_header(format_: str, header: bytes) -> None:
    depth_m = bag_images.depth_of(message(format_, header + PNG16), CAMERA, MM)
    np.testing.assert_array_equal(depth_m, depth_of(0) / np.float32(1000))
    finer = bag_images.depth_of(message(format_, header + PNG16), CAMERA, 5000.0)
    np.testing.assert_array_equal(finer, depth_of(0) / np.float32(5000))


def test_inverse_depth_is_right_to_its_quantum() -> None:
    exact_m = np.linspace(0.3, 9.0, 48 * 64, dtype=np.float32).reshape(48, 64)
    exact_m[0] = 0.0
    data = quantised(exact_m)
    _, a, b = struct.unpack('<Iff', data[:12])
    depth_m = bag_images.depth_of(message('32FC1; compressedDepth png', data), CAMERA, 1.0)
    assert depth_m.dtype == np.float32 and not depth_m[0].any()
    inverse = a / depth_m[1:] + b  # what was rounded down, from the same law
    error = (a / exact_m[1:] + b) - inverse
    assert -0.01 < error.min() and error.max() < 1.01
    finer = bag_images.depth_of(message('32FC1; compressedDepth png', data), CAMERA, 4.0)
    np.testing.assert_array_equal(finer, depth_m / 4)
    assert (depth_m[1:] >= exact_m[1:] * (1 - 1e-5)).all()


@pytest.mark.parametrize('a', [0.0, -1.0, np.nan, np.inf, 3e38])
@pytest.mark.parametrize('b', [0.0, 500.0, np.nan, -np.inf])
def test_damaged_parameters_of_inverse_depth_leave_only_distances(a: float, b: float) -> None:
    data = struct.pack('<Iff', 0, a, b) + PNG16
    depth_m = bag_images.depth_of(message('32FC1; compressedDepth png', data), CAMERA, 1.0)
    assert np.isfinite(depth_m).all() and (depth_m >= 0).all()


@pytest.mark.parametrize(
    ('data', 'reason'),
    [
        (b'', r'\(0 bytes\) is neither PNG nor JPEG'),
        (PNG16[:12], 'cut off after 12 bytes'),
        (PNG16[:-9], 'cut off'),
        (encoded('.png', depth_of(0)[:24]), '64x24 pixels, but'),
        (encoded('.png', (depth_of(0) >> 8).astype(np.uint8)), 'of 8 bits, not one of 16'),
        (encoded('.jpg', smooth()), 'of 8 bits, not one of 16'),
        (bytes(12) + b'rvl' * 100, 'neither'),
    ],
)
def test_what_is_no_depth_is_refused(data: bytes, reason: str) -> None:
    with pytest.raises(BAD, match=reason):
        bag_images.depth_of(message(DEPTH16, data), CAMERA, MM)


def test_a_lying_size_is_refused_before_anything_is_decoded() -> None:
    png = bytearray(encoded('.png', color_of(0)))
    png[16:24] = struct.pack('>II', 30_000, 30_000)
    jpeg = bytearray(encoded('.jpg', smooth()))
    at = jpeg.index(b'\xff\xc0') + 5
    jpeg[at : at + 4] = struct.pack('>HH', 60_000, 60_000)
    claims = bytearray(PNG16)
    claims[33:37] = b'\x7f\xff\xff\xff'  # the length of the chunk behind the header's
    with pytest.raises(FrameError, match='or damaged'):
        bag_images.depth_of(message(DEPTH16, bytes(claims)), CAMERA, MM)
    tracemalloc.start()
    for data, side in ((png, 30_000), (jpeg, 60_000)):
        with pytest.raises(FrameError, match=f'{side}x{side} pixels, but'):
            bag_images.color_of(message('', bytes(data)), CAMERA)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MOST_BYTES


def test_a_truncated_image_is_a_bad_frame_among_good_ones(tmp_path: Path) -> None:
    entries = [info_entry(START_NS, CAMERA), *compressed(3)]
    half = encoded('.png', color_of(1))[:-9]
    entries[3] = compressed_entry(entries[3].topic, START_NS + INTERVAL_NS, 'png', half)
    items = list(BagSource(write_bag(tmp_path / 'bag', entries)))
    assert [type(item) for item in items] == [RgbdFrame, BadFrame, RgbdFrame]
    assert isinstance(items[1], BadFrame) and 'cut off' in items[1].reason


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip bytes, cut, repeat a piece, or all of it."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        kind, at = rng.integers(4), int(rng.integers(len(out) + 1))
        if kind == 0:
            out = out[:at]
        elif kind == 1:
            out[at:at] = out[: rng.integers(64)]
        else:  # half of them in the headers, which decoders trust
            at = at % 64 if kind == 2 else at
            out[at : at + 1] = rng.bytes(1)
    return bytes(out)


@pytest.mark.parametrize('what', ['color png', 'color jpeg', 'depth png', 'depth 32FC1'])
def test_any_bytes_are_an_image_of_the_cameras_size_or_refused(what: str) -> None:
    rng = np.random.default_rng(7)
    payload, format_ = {
        'color png': (encoded('.png', smooth()), 'rgb8; png compressed bgr8'),
        'color jpeg': (encoded('.jpg', smooth()), 'rgb8; jpeg compressed bgr8'),
        'depth png': (bytes(12) + PNG16, DEPTH16),
        'depth 32FC1': (quantised(depth_of(0) / np.float32(1000)), '32FC1; compressedDepth png'),
    }[what]
    read = 0
    tracemalloc.start()
    for _ in range(MUTATIONS // 4):
        hostile = message(format_, mutated(payload, rng))
        try:
            if what.startswith('color'):
                color = bag_images.color_of(hostile, CAMERA)
                assert color.shape == (48, 64, 3) and color.dtype == np.uint8
            else:
                depth_m = bag_images.depth_of(hostile, CAMERA, MM)
                assert depth_m.shape == (48, 64) and depth_m.dtype == np.float32
                assert np.isfinite(depth_m).all() and (depth_m >= 0).all()
            read += 1
        except BAD:
            pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MOST_BYTES
    assert 0 < read < MUTATIONS // 4
