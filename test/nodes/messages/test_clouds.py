# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Structured arrays as PointCloud2: all row types, any layout, and what is refused."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from dcgs_ros.io.ros_images import MessageError
from dcgs_ros.nodes.messages.clouds import (
    KEYFRAME_GAUSSIAN,
    KEYFRAME_POSE,
    MAP_GAUSSIAN,
    SHAPE,
    pack_rgb,
    read_cloud,
    unpack_rgb,
    write_cloud,
)
from dcgs_ros.nodes.messages.images import header

HEADER = header(7, 'odom')
TYPES = {
    'keyframe': KEYFRAME_GAUSSIAN,
    'map': MAP_GAUSSIAN,
    'pose': KEYFRAME_POSE,
    'shape': SHAPE,
}
# PointField's numbers, as the message's definition has them.
STRUCT = {5: 'i', 6: 'I', 7: 'f', 8: 'd'}


def random_rows(dtype: np.dtype[Any], count: int, seed: int) -> NDArray[Any]:
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, dtype)
    for name in dtype.names or ():
        kind = dtype[name].kind
        rows[name] = rng.normal(size=count) if kind == 'f' else rng.integers(0, 2**31, count)
    return rows


def laid_out(
    rows: NDArray[Any], seed: int, height: int, gaps: int, pitch_gap: int, big: bool
) -> PointCloud2:
    """Write rows as another program might: fields in any order, with gaps and others between."""
    rng = np.random.default_rng(seed)
    order = '>' if big else '<'
    names = rng.permutation(rows.dtype.names or ()).tolist()
    formats = {
        name: number
        for name in names
        for number, code in STRUCT.items()
        if rows.dtype[name] == np.dtype(f'<{code}')
    }
    offsets, end = {}, int(rng.integers(0, gaps + 1))
    for name in names:
        offsets[name] = end
        end += rows.dtype[name].itemsize + int(rng.integers(0, gaps + 1))
    width = len(rows) // height
    pitch = width * end + pitch_gap
    data = bytearray(rng.bytes(pitch * height))
    for k, row in enumerate(rows):
        start = k // width * pitch + k % width * end
        for name in names:
            code = order + STRUCT[formats[name]]
            struct.pack_into(code, data, start + offsets[name], row[name].item())
    fields = [
        PointField(name=name, offset=offsets[name], datatype=formats[name], count=1)
        for name in names
    ]
    fields.append(PointField(name='other', offset=end, datatype=PointField.UINT8, count=9))
    return PointCloud2(
        height=height, width=width, fields=fields, is_bigendian=big, point_step=end,
        row_step=pitch, data=bytes(data),
    )  # fmt: skip


@settings(max_examples=40)
@given(st.sampled_from(sorted(TYPES)), st.integers(0, 20), st.integers(0, 2**32))
def test_rows_survive_the_wire_exactly(kind: str, count: int, seed: int) -> None:
    rows = random_rows(TYPES[kind], count, seed)
    message = deserialize_message(serialize_message(write_cloud(rows, HEADER)), PointCloud2)
    np.testing.assert_array_equal(read_cloud(message, TYPES[kind]), rows)
    assert (message.height, message.width) == (1, count)
    assert message.row_step == message.width * message.point_step == len(message.data)
    assert message.header == HEADER
    assert not message.is_bigendian and not message.is_dense


@settings(max_examples=60)
@given(
    st.sampled_from(sorted(TYPES)),
    st.integers(1, 4),
    st.integers(1, 4),
    st.integers(0, 5),
    st.integers(0, 9),
    st.booleans(),
    st.integers(0, 2**32),
)
def test_rows_are_read_from_any_layout(
    kind: str, height: int, width: int, gaps: int, pitch_gap: int, big: bool, seed: int
) -> None:
    rows = random_rows(TYPES[kind], height * width, seed)
    cloud = laid_out(rows, seed, height, gaps, pitch_gap, big)
    np.testing.assert_array_equal(read_cloud(cloud, TYPES[kind]), rows)


@pytest.mark.parametrize('kind', sorted(TYPES))
def test_each_field_stands_where_the_message_says(kind: str) -> None:
    rows = random_rows(TYPES[kind], 3, seed=1)
    cloud = write_cloud(rows, HEADER)
    assert [field.name for field in cloud.fields] == list(TYPES[kind].names or ())
    for field in cloud.fields:
        for k in range(3):
            start = k * cloud.point_step + field.offset
            (value,) = struct.unpack_from('<' + STRUCT[field.datatype], cloud.data, start)
            assert value == rows[field.name][k]


@pytest.mark.parametrize('kind', ['keyframe', 'map', 'shape'])
def test_ids_come_first_and_there_is_no_padding(kind: str) -> None:
    """Padding would carry arbitrary bytes, and make equal rows differ."""
    dtype = TYPES[kind]
    layout = dtype.fields
    assert layout is not None and layout['id'][1] == 0
    assert dtype.itemsize == sum(field.itemsize for field, *_ in layout.values())


@given(st.integers(1, 2**20 - 1), st.integers(0, 2**32 - 1), st.integers(-(2**53), -1))
def test_ids_are_exact_as_floating_point(epoch: int, index: int, own: int) -> None:
    ids = np.array([epoch * 2**32 + index, own], np.int64)
    rows = np.zeros(2, KEYFRAME_GAUSSIAN)
    rows['id'] = ids
    read = read_cloud(write_cloud(rows, HEADER), KEYFRAME_GAUSSIAN)
    np.testing.assert_array_equal(read['id'].astype(np.int64), ids)


def test_a_removed_gaussian_is_nan_except_for_its_id() -> None:
    names = (MAP_GAUSSIAN.names or ())[1:-1]
    removed = np.zeros(1, MAP_GAUSSIAN)
    for name in names:
        removed[name] = np.nan
    removed['id'] = -3
    read = read_cloud(write_cloud(removed, HEADER), MAP_GAUSSIAN)
    assert read['id'] == -3
    assert all(np.isnan(read[name]).all() for name in names)


@given(st.integers(0, 30), st.integers(0, 2**32))
def test_colors_survive_packing(count: int, seed: int) -> None:
    colors = np.random.default_rng(seed).integers(0, 256, (count, 3), dtype=np.uint8)
    packed = pack_rgb(colors)
    assert packed.dtype == np.float32 and packed.shape == (count,)
    np.testing.assert_array_equal(unpack_rgb(packed), colors)


def test_a_packed_color_has_the_bits_that_rviz_reads() -> None:
    packed = pack_rgb(np.array([[0x12, 0x34, 0x56]], np.uint8))
    assert struct.pack('>f', packed[0]).hex() == '00123456'


def test_colors_are_unpacked_from_a_column_of_rows() -> None:
    colors = np.random.default_rng(0).integers(0, 256, (10, 3), dtype=np.uint8)
    rows = np.zeros(10, MAP_GAUSSIAN)
    rows['rgb'] = pack_rgb(colors)
    read = read_cloud(write_cloud(rows, HEADER), MAP_GAUSSIAN)
    np.testing.assert_array_equal(unpack_rgb(read['rgb']), colors)


def test_a_cloud_without_points_needs_no_fields() -> None:
    assert read_cloud(PointCloud2(), MAP_GAUSSIAN).shape == (0,)
    assert read_cloud(PointCloud2(), MAP_GAUSSIAN).dtype == MAP_GAUSSIAN


def good() -> PointCloud2:
    return write_cloud(random_rows(KEYFRAME_POSE, 5, seed=0), HEADER)


BAD_CLOUDS: dict[str, tuple[dict[str, Any], str]] = {
    'short data': (
        {'data': bytes(199)},
        '5x1 points of 40 bytes in rows of 200 bytes do not match',
    ),
    'no data': ({'data': b''}, 'do not match 0 bytes'),
    'short rows': ({'row_step': 199}, 'in rows of 199 bytes'),
    'no rows': ({'row_step': 0}, 'in rows of 0 bytes'),
    'short points': ({'point_step': 39}, "'submap' ends at byte 40 of a point of 39"),
    'no points': ({'point_step': 0}, 'of a point of 0'),
    'many points': ({'width': 2**32 - 1}, '4294967295x1 points'),
    'many rows': ({'height': 2**32 - 1}, '5x4294967295 points'),
    'two gigabytes': ({'width': 2**26, 'row_step': 40 * 2**26}, 'rows of 2684354560 bytes'),
    'no fields': ({'fields': []}, "no field 'sec'; it has none"),
}


@pytest.mark.parametrize('fault', BAD_CLOUDS)
def test_a_broken_cloud_is_refused_with_its_numbers(fault: str) -> None:
    changes, reason = BAD_CLOUDS[fault]
    cloud = good()
    for name, value in changes.items():
        setattr(cloud, name, value)
    with pytest.raises(MessageError, match=reason):
        read_cloud(cloud, KEYFRAME_POSE)


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'name': 'why'}, "no field 'y'; it has sec, nanosec, x, why, z"),
        ({'datatype': PointField.FLOAT64}, r"'y' is 1 of type 8, not 1 of 7 \(float32\)"),
        ({'datatype': 200}, "'y' is 1 of type 200"),
        ({'count': 2}, "'y' is 2 of type 7"),
        ({'count': 0}, "'y' is 0 of type 7"),
        ({'offset': 37}, "'y' ends at byte 41 of a point of 40"),
        ({'offset': 2**32 - 1}, "'y' ends at byte 4294967299"),
    ],
)
def test_a_broken_field_is_refused_with_its_numbers(changes: dict[str, Any], reason: str) -> None:
    cloud = good()
    for name, value in changes.items():
        setattr(cloud.fields[3], name, value)
    with pytest.raises(MessageError, match=reason):
        read_cloud(cloud, KEYFRAME_POSE)


def test_fields_that_share_bytes_cannot_claim_more_than_was_sent() -> None:
    cloud = good()
    for field in cloud.fields:
        field.offset = 0
    cloud.point_step, cloud.width, cloud.row_step = 4, 50, 200
    with pytest.raises(MessageError, match='a point has 4 bytes, its fields 40'):
        read_cloud(cloud, KEYFRAME_POSE)
