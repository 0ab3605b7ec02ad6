# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ROS images as arrays: every encoding, layout and buffer, and what is refused."""

from __future__ import annotations

import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.core.camera import CameraError, PinholeCamera
from dcgs_ros.io.images.encodings import COLOR_ENCODINGS
from dcgs_ros.io.ros_images import (
    DEPTH_ENCODINGS,
    MessageError,
    image_size,
    is_rectified,
    read_camera,
    read_color,
    read_depth,
    stamp_ns,
)

BUFFERS: dict[str, Callable[[bytes], Any]] = {
    'bytes': bytes,
    'array of rclpy': lambda data: array.array('B', data),
    'array of rosbags, read-only': lambda data: np.frombuffer(data, np.uint8),
}
LAYOUTS = st.fixed_dictionaries(
    {
        'shape': st.tuples(st.integers(1, 9), st.integers(1, 9)),
        'padding': st.integers(0, 7),  # bytes a row
        'trailer': st.integers(0, 5),  # bytes after the last row
        'big': st.booleans(),
        'buffer': st.sampled_from(sorted(BUFFERS)),
        'seed': st.integers(0, 2**32),
    }
)


def image(
    pixels: NDArray[Any],
    encoding: str,
    big: bool = False,
    padding: int = 0,
    trailer: int = 0,
    buffer: str = 'bytes',
) -> SimpleNamespace:
    wire = pixels.astype(pixels.dtype.newbyteorder('>' if big else '<'))
    rows = [row.tobytes() + b'\xa5' * padding for row in wire]
    return SimpleNamespace(
        height=len(pixels),
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=len(rows[0]),
        data=BUFFERS[buffer](b''.join(rows) + b'\xa5' * trailer),
    )


def drawn(layout: dict[str, Any]) -> tuple[np.random.Generator, tuple[int, int], dict[str, Any]]:
    options = dict(layout)
    return np.random.default_rng(options.pop('seed')), options.pop('shape'), options


@given(LAYOUTS, st.sampled_from(['rgb8', 'bgr8', 'mono8']))
def test_color_is_read_from_any_layout(layout: dict[str, Any], encoding: str) -> None:
    rng, shape, options = drawn(layout)
    full = shape if encoding == 'mono8' else (*shape, 3)
    pixels = rng.integers(0, 256, full, dtype=np.uint8)
    color = read_color(image(pixels, encoding, **options))
    assert color.dtype == np.uint8 and color.flags.c_contiguous
    np.testing.assert_array_equal(color, pixels[..., ::-1] if encoding == 'bgr8' else pixels)


@given(LAYOUTS, st.sampled_from(['16UC1', 'mono16']))
def test_millimetres_are_read_from_any_layout(layout: dict[str, Any], encoding: str) -> None:
    rng, shape, options = drawn(layout)
    millimetres = rng.integers(0, 2**16, shape, dtype=np.uint16)
    depth_m = read_depth(image(millimetres, encoding, **options))
    assert depth_m.dtype == np.float32 and depth_m.flags.c_contiguous
    np.testing.assert_array_equal(depth_m, (millimetres / 1000.0).astype(np.float32))


@given(LAYOUTS)
def test_metres_are_read_from_any_layout(layout: dict[str, Any]) -> None:
    rng, shape, options = drawn(layout)
    metres = rng.random(shape, dtype=np.float32)
    depth_m = read_depth(image(metres, '32FC1', **options))
    assert depth_m.dtype == np.dtype('=f4') and depth_m.flags.c_contiguous
    np.testing.assert_array_equal(depth_m, metres)


@given(LAYOUTS, st.sampled_from([1000.0, 5000.0, 10000.0, 6553.5]))
def test_another_unit_of_depth_is_divided_by(layout: dict[str, Any], per_metre: float) -> None:
    rng, shape, options = drawn(layout)
    raw = rng.integers(0, 2**16, shape, dtype=np.uint16)
    depth_m = read_depth(image(raw, '16UC1', **options), per_metre)
    np.testing.assert_array_equal(depth_m, raw.astype(np.float32) / np.float32(per_metre))


def test_every_millimetre_is_the_nearest_float() -> None:
    millimetres = np.arange(2**16, dtype=np.uint16).reshape(256, 256)
    depth_m = read_depth(image(millimetres, '16UC1'))
    np.testing.assert_array_equal(depth_m, (millimetres / 1000.0).astype(np.float32))


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('bad', [np.nan, -np.nan, np.inf, -np.inf, -1.0, -0.0, -1e-45])
def test_what_is_no_distance_is_none(bad: float, big: bool) -> None:
    metres = np.array([[1.0, bad, 2.0]], np.float32)
    depth_m = read_depth(image(metres, '32FC1', big=big))
    np.testing.assert_array_equal(depth_m, [[1.0, 0.0, 2.0]])
    assert not np.signbit(depth_m).any()


@pytest.mark.parametrize('encoding', ['rgb8', 'mono8'])
def test_plain_color_is_not_copied(encoding: str) -> None:
    pixels = np.zeros((4, 6, 3)[: 3 if encoding == 'rgb8' else 2], np.uint8)
    message = image(pixels, encoding, buffer='array of rclpy')
    assert np.shares_memory(read_color(message), np.frombuffer(message.data, np.uint8))


GOOD: dict[str, Any] = {
    'height': 4,
    'width': 6,
    'encoding': '16UC1',
    'is_bigendian': 0,
    'step': 12,
    'data': bytes(48),
}
BAD_IMAGES: dict[str, tuple[dict[str, Any], str]] = {
    'step too short': ({'step': 11}, '6 pixels of 16UC1 are 12 bytes, but a row has 11'),
    'no step': ({'step': 0}, 'a row has 0'),
    'step longer than the data': ({'step': 13}, '4 rows of 13 bytes are 52, but there are 48'),
    'short data': ({'data': bytes(47)}, '4 rows of 12 bytes are 48, but there are 47'),
    'no data': ({'data': b''}, 'there are 0'),
    'no width': ({'width': 0}, 'image of 0x4 pixels'),
    'no height': ({'height': 0}, 'image of 6x0 pixels'),
    'absurd width': ({'width': 2**32 - 1, 'step': 2**32 - 1}, 'image of 4294967295x4 pixels'),
    'a side too long': ({'height': 16385, 'step': 12}, '6x16385 pixels; a side has 1 to 16384'),
    'two gigabytes claimed': (
        {'width': 16384, 'height': 16384, 'step': 131072},
        '16384 rows of 131072 bytes are 2147483648, but there are 48',
    ),
    'an encoding of colour': ({'encoding': 'rgb8'}, "depth is 'rgb8', not one of 16UC1, mono16"),
    'no encoding': ({'encoding': ''}, "depth is ''"),
    'a long encoding': ({'encoding': 'x' * 10**6}, "depth is 'x{40}', not"),
}


@pytest.mark.parametrize('fault', BAD_IMAGES)
def test_a_broken_image_is_refused_with_its_numbers(fault: str) -> None:
    change, reason = BAD_IMAGES[fault]
    assert read_depth(SimpleNamespace(**GOOD)).shape == (4, 6)
    with pytest.raises(MessageError, match=reason):
        read_depth(SimpleNamespace(**{**GOOD, **change}))


@pytest.mark.parametrize('encoding', ['16UC1', '32FC1', 'RGB8', 'yuv411', 'jpeg'])
def test_what_is_no_color_is_refused(encoding: str) -> None:
    with pytest.raises(MessageError, match=f"colour is '{encoding}', not one of rgb8, bgr8"):
        read_color(SimpleNamespace(**{**GOOD, 'encoding': encoding}))


def info(**changes: Any) -> SimpleNamespace:
    fields: dict[str, Any] = {
        'width': 640,
        'height': 480,
        'distortion_model': 'plumb_bob',
        'k': np.array([525.0, 0, 319.5, 0, 526.0, 239.5, 0, 0, 1]),
        'd': array.array('d', [0.1, -0.2, 0.001, 0.002, 0.05]),
    }
    return SimpleNamespace(**{**fields, **changes})


@pytest.mark.parametrize(
    ('model', 'distortion', 'kept'),
    [
        ('plumb_bob', (0.1, -0.2, 0.001, 0.002, 0.05), 5),
        ('plumb_bob', (0.1, -0.2, 0.001, 0.002), 4),
        ('plumb_bob', (0.0,) * 5, 0),
        ('plumb_bob', (), 0),
        ('', (), 0),
        ('', (0.0,) * 8, 0),
        ('Inverse Brown Conrady', (0.0,) * 5, 0),
        ('None', (0.0,) * 5, 0),
        ('equidistant', (), 0),
        ('rational_polynomial', (0.5, 0.1, 1e-4, 2e-4, 0.01, 0.6, 0.2, 0.03), 8),
    ],
)
def test_the_lens_is_read_where_there_is_one(
    model: str, distortion: tuple[float, ...], kept: int
) -> None:
    expected = PinholeCamera(640, 480, 525.0, 526.0, 319.5, 239.5, distortion[:kept])
    assert read_camera(info(distortion_model=model, d=distortion)) == expected


def test_rectified_images_have_the_projection_and_no_lens() -> None:
    p = np.array([500.0, 0, 310, 0, 0, 501, 250, 0, 0, 0, 1, 0])
    raw = info(p=p)
    assert read_camera(raw) == read_camera(info())
    assert read_camera(raw, rectified=True) == PinholeCamera(640, 480, 500.0, 501.0, 310.0, 250.0)
    assert read_camera(info(p=np.zeros(12)), rectified=True) == read_camera(info())


@pytest.mark.parametrize(
    ('topic', 'expected'),
    [
        ('/camera/rgb/image_rect_color', True),
        ('/kinect2/hd/image_color_rect', True),
        ('/camera/depth/image_rect/compressed', True),
        ('/zed/rgb/rect/image', True),
        ('/camera/color/image_raw', False),
        ('/rectangle/image', False),
    ],
)
def test_rectified_topics_are_known_by_their_names(topic: str, expected: bool) -> None:
    assert is_rectified(topic) == expected


def test_capital_names_of_ros_1_are_read_as_well() -> None:
    new = info()
    old = SimpleNamespace(
        width=640, height=480, distortion_model='plumb_bob', K=new.k, D=np.array(new.d)
    )
    assert read_camera(old) == read_camera(new)


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'distortion_model': 'omni'}, "'omni' is not supported; these are: .*equidistant"),
        ({'distortion_model': 'Inverse Brown Conrady'}, "'Inverse Brown Conrady' is not sup"),
        ({'k': np.array([525.0, 0.1, 319.5, 0, 525, 239.5, 0, 0, 1])}, 'skew of 0.1 pixels'),
        ({'k': np.full(9, np.nan)}, 'skew of nan'),
        ({'width': 0}, 'image of 0x480 pixels'),
        ({'height': 2**31}, 'image of 640x2147483648 pixels'),
        ({'d': [np.nan] * 10**5}, '100000 numbers, at most 14'),
    ],
)
def test_a_broken_camera_is_refused_with_its_numbers(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        read_camera(info(**changes))


@pytest.mark.parametrize(
    'changes',
    [
        {'k': np.zeros(9)},  # not calibrated
        {'k': np.array([np.nan, 0, 319.5, 0, 525, 239.5, 0, 0, 1])},
        {'k': np.array([525.0, 0, np.inf, 0, 525, 239.5, 0, 0, 1])},
        {'k': np.array([-525.0, 0, 319.5, 0, 525, 239.5, 0, 0, 1])},
        {'d': [np.nan] * 5},
        {'d': [0.1] * 3},
        {'width': 8, 'height': 8},
    ],
)
def test_numbers_that_are_no_camera_are_the_cameras_own_error(changes: dict[str, Any]) -> None:
    with pytest.raises(CameraError):
        read_camera(info(**changes))


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1))
def test_a_stamp_is_exact(sec: int, nanosec: int) -> None:
    assert stamp_ns(SimpleNamespace(sec=sec, nanosec=nanosec)) == sec * 10**9 + nanosec


def test_messages_decoded_by_rosbags_are_read() -> None:
    typesys = pytest.importorskip('rosbags.typesys')
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    types = store.types
    stamp = types['builtin_interfaces/msg/Time'](sec=12, nanosec=34)
    header = types['std_msgs/msg/Header'](stamp=stamp, frame_id='camera')
    pixels = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    name = 'sensor_msgs/msg/Image'
    sent = types[name](header, 4, 5, 'bgr8', 0, 15, pixels.reshape(-1))
    got = store.deserialize_cdr(store.serialize_cdr(sent, name), name)
    np.testing.assert_array_equal(read_color(got), pixels[..., ::-1])
    assert stamp_ns(got.header.stamp) == 12_000_000_034


FUZZED = {
    'width': st.integers(0, 2**32 - 1) | st.integers(0, 8),
    'height': st.integers(0, 2**32 - 1) | st.integers(0, 8),
    'step': st.integers(0, 2**32 - 1) | st.integers(0, 40),
    'encoding': st.sampled_from([*COLOR_ENCODINGS, *DEPTH_ENCODINGS]) | st.text(),
    'is_bigendian': st.integers(0, 255),
    'data': st.binary(max_size=300),
}


@settings(max_examples=300)
@given(st.fixed_dictionaries(FUZZED), st.sampled_from([read_color, read_depth]))
def test_any_image_is_read_or_refused(
    fields: dict[str, Any], read: Callable[[Any], NDArray[Any]]
) -> None:
    message = SimpleNamespace(**fields)
    try:
        pixels = read(message)
    except MessageError:
        return
    assert pixels.shape[1::-1] == image_size(message)
    assert pixels.size <= 3 * len(fields['data'])  # three channels of a mosaic's one
