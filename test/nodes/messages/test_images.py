# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Stamps, images and cameras as messages: what is written is what the readers read."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.io.ros_images import MessageError, read_camera, read_color, read_depth, stamp_ns
from dcgs_ros.nodes.messages.images import (
    array_of,
    header,
    time_message,
    write_camera,
    write_color,
    write_depth,
    write_depth_mm,
)

EARLIEST_NS = -(2**31) * 10**9
LATEST_NS = 2**31 * 10**9 - 1
HEADER = header(1_700_000_000_123_456_789, 'camera')
HALF_MM = 0.5e-3 * (1 + 1e-6)  # with the rounding of metres to float32
SHAPES = st.tuples(st.integers(1, 8), st.integers(1, 8))
SEEDS = st.integers(0, 2**32)
PIXELS = st.floats(1.0, 5000.0)
COEFFICIENTS = st.sampled_from([0, 4, 5, 8]).flatmap(
    lambda count: st.tuples(*[st.floats(-1.0, 1.0)] * count)
)
FOCAL = st.floats(1e5, 1e6)  # so narrow a view can be undistorted whatever the coefficients are
CAMERAS = st.builds(
    PinholeCamera,
    st.integers(16, 8192),
    st.integers(16, 8192),
    FOCAL,
    FOCAL,
    PIXELS,
    PIXELS,
    COEFFICIENTS,
)


@given(st.integers(EARLIEST_NS, LATEST_NS) | st.sampled_from([EARLIEST_NS, -1, 0, LATEST_NS]))
def test_a_stamp_survives_the_wire(ns: int) -> None:
    sent = header(ns, 'camera')
    got = deserialize_message(serialize_message(sent), Header)
    assert stamp_ns(got.stamp) == ns
    assert 0 <= got.stamp.nanosec < 10**9
    assert got.frame_id == 'camera'


@pytest.mark.parametrize('ns', [EARLIEST_NS - 1, LATEST_NS + 1, 2**62])
def test_a_stamp_beyond_32_bits_of_seconds_is_refused(ns: int) -> None:
    with pytest.raises(MessageError, match=f'{ns // 10**9} s does not fit'):
        time_message(ns)


def over_the_wire(message: Image) -> Image:
    return deserialize_message(serialize_message(message), Image)


@settings(max_examples=50)
@given(SHAPES, SEEDS, st.booleans())
def test_color_survives_exactly(shape: tuple[int, int], seed: int, grey: bool) -> None:
    full = shape if grey else (*shape, 3)
    color = np.random.default_rng(seed).integers(0, 256, full, dtype=np.uint8)
    message = over_the_wire(write_color(color, HEADER))
    np.testing.assert_array_equal(read_color(message), color)
    assert message.encoding == ('mono8' if grey else 'rgb8')
    assert (message.height, message.width) == shape
    assert message.step * message.height == len(message.data) == color.size
    assert stamp_ns(message.header.stamp) == 1_700_000_000_123_456_789


def test_color_that_is_a_view_is_written_as_it_looks() -> None:
    color = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    for view in (color[::2, 1:5], color[..., ::-1], color.transpose(1, 0, 2), color[..., 0]):
        np.testing.assert_array_equal(read_color(write_color(view, HEADER)), view)


@pytest.mark.parametrize(
    ('shape', 'kind'), [((4, 4), np.float32), ((4, 4, 4), np.uint8), ((4,), np.uint8)]
)
def test_what_is_no_color_is_refused(shape: tuple[int, ...], kind: type) -> None:
    with pytest.raises(MessageError, match=rf'colour is {np.dtype(kind)} \(4,'):
        write_color(np.zeros(shape, kind), HEADER)


def test_every_millimetre_survives_exactly() -> None:
    depth_m = (np.arange(2**16).reshape(256, 256) / 1000.0).astype(np.float32)
    message = over_the_wire(write_depth_mm(depth_m, HEADER))
    assert message.encoding == '16UC1' and message.step == 512
    np.testing.assert_array_equal(read_depth(message), depth_m)


@settings(max_examples=50)
@given(SHAPES, SEEDS)
def test_depth_is_rounded_to_the_nearest_millimetre(shape: tuple[int, int], seed: int) -> None:
    depth_m = np.random.default_rng(seed).uniform(0, 65.5, shape).astype(np.float32)
    read = read_depth(write_depth_mm(depth_m, HEADER))
    tolerance_m = HALF_MM + np.spacing(np.float32(65.5))
    np.testing.assert_allclose(read, depth_m, rtol=0, atol=tolerance_m)


def test_what_millimetres_cannot_say_is_none() -> None:
    bad = [np.nan, np.inf, -np.inf, -1.0, 0.0, 65.54, 65.6, 131.072, 1e30]
    depth_m = np.array([bad], np.float32)
    assert not read_depth(write_depth_mm(depth_m, HEADER)).any()


@settings(max_examples=50)
@given(SHAPES, SEEDS)
def test_metres_survive_exactly_and_none_is_nan(shape: tuple[int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth_m = rng.uniform(0.1, 100.0, shape).astype(np.float32)
    depth_m[rng.random(shape) < 0.3] = 0.0
    message = over_the_wire(write_depth(depth_m, HEADER))
    np.testing.assert_array_equal(read_depth(message), depth_m)
    raw = np.frombuffer(message.data, '<f4').reshape(shape)
    np.testing.assert_array_equal(np.isnan(raw), depth_m == 0)


def test_bytes_are_those_of_the_array_in_c_order() -> None:
    values = np.arange(24, dtype='>u2').reshape(4, 6)
    rows = np.zeros(3, [('a', '<f8'), ('b', '>i4')])
    for array in (values, values.T, values[::2, ::3], values[:0], rows, rows[:0]):
        assert array_of(array).tobytes() == array.tobytes()
    for raw in (b'ab', bytearray(b'ab'), memoryview(b'ab'), b''):
        assert array_of(raw).tobytes() == bytes(raw)


@settings(max_examples=100)
@given(CAMERAS)
def test_a_camera_survives_exactly(camera: PinholeCamera) -> None:
    message = deserialize_message(serialize_message(write_camera(camera, HEADER)), CameraInfo)
    again = read_camera(message)
    assert isinstance(again, PinholeCamera)
    assert (again.width, again.height) == (camera.width, camera.height)
    np.testing.assert_array_equal(again.parameters, camera.parameters)
    assert read_camera(write_camera(again, HEADER)) == again


@pytest.mark.parametrize(
    ('count', 'model', 'written'),
    [(0, 'plumb_bob', 5), (4, 'plumb_bob', 5), (5, 'plumb_bob', 5), (8, 'rational_polynomial', 8)],
)
def test_a_lens_has_the_numbers_that_ros_gives_its_model(
    count: int, model: str, written: int
) -> None:
    camera = PinholeCamera(640, 480, 525.0, 526.0, 319.5, 239.5, (0.01,) * count)
    message = write_camera(camera, HEADER)
    assert message.distortion_model == model
    assert list(message.d) == [0.01] * count + [0.0] * (written - count)


def test_the_projection_is_the_cameras_own() -> None:
    message = write_camera(PinholeCamera(640, 480, 525.0, 526.0, 319.5, 239.5), HEADER)
    assert list(message.k) == [525.0, 0, 319.5, 0, 526.0, 239.5, 0, 0, 1]
    assert list(message.p) == [525.0, 0, 319.5, 0, 0, 526.0, 239.5, 0, 0, 0, 1, 0]
    np.testing.assert_array_equal(message.r.reshape(3, 3), np.eye(3))
