# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Structured arrays as PointCloud2 and back, and the types of their rows.

A Gaussian's `id` is a float64, exact below 2^53, since PointField has no 64-bit integer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from ...io.ros_images import MessageError
from .images import array_of

_TYPES = {
    'i4': PointField.INT32,
    'u4': PointField.UINT32,
    'f4': PointField.FLOAT32,
    'f8': PointField.FLOAT64,
}


def _row(floats: str, *others: tuple[str, str]) -> np.dtype[Any]:
    """Return the type of a row: its id, named floats, then other fields, without padding."""
    return np.dtype([('id', '<f8'), *((name, '<f4') for name in floats.split()), *others])


# What a keyframe spawned: mean, the viewpoint it was seen from, and normal; world, metres.
# The sub-map is the same in all rows: that in which the keyframe was made.
KEYFRAME_GAUSSIAN = _row(
    'x y z viewpoint_x viewpoint_y viewpoint_z normal_x normal_y normal_z', ('submap', '<i4')
)
# Sigma_r in the mapper's answer: its thinnest axis, unit, world, and lambda3 / lambda2; the last
# correction that the mapper had taken.
SHAPE = _row('normal_x normal_y normal_z flatness', ('revision', '<u4'))
# x y z in metres, world; rgb packed as in PCL and RViz; opacity 0..1; scale: standard deviations,
# metres; rot: wxyz; track_cov in m^2, NaN for the mapper's own; keyframe: a row (KEYFRAME_POSE) of
# keyframe/received.
MAP_GAUSSIAN = _row(
    'x y z rgb opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3'
    ' track_cov_xx track_cov_xy track_cov_xz track_cov_yy track_cov_yz track_cov_zz',
    ('keyframe', '<i4'),
)
KEYFRAME_POSE = np.dtype(
    [
        ('sec', '<i4'), ('nanosec', '<u4'),
        *((name, '<f4') for name in 'x y z qx qy qz qw'.split()), ('submap', '<i4'),
    ]
)  # fmt: skip
# Where the tracker's keyframes are after a correction, in the order of their index, which `id`
# holds with the epoch as a Gaussian's does; stamp of the colour image, the number of the
# correction, the sub-map; T_world_cam as x y z in metres and a unit quaternion.
CORRECTED_POSE = np.dtype(
    [
        ('id', '<f8'), ('sec', '<i4'), ('nanosec', '<u4'), ('revision', '<u4'), ('submap', '<i4'),
        *((name, '<f8') for name in 'x y z qx qy qz qw'.split()),
    ]
)  # fmt: skip


# A point of a surface, metres.
POINT = np.dtype([(axis, '<f4') for axis in 'xyz'])


def point_rows(points: NDArray[np.float32]) -> NDArray[Any]:
    """Return points (N, 3) as POINT rows (N,), without copying them."""
    return np.ascontiguousarray(points, np.float32).view(POINT).reshape(-1)


def write_cloud(rows: NDArray[Any], header: Header) -> PointCloud2:
    """Return rows (N,) of any of these types as a cloud, not dense since a row may be NaN."""
    cloud = PointCloud2(header=header, height=1, width=len(rows), is_dense=False)
    cloud.fields = [
        PointField(name=name, offset=offset, datatype=_datatype(kind), count=1)
        for name, (kind, offset, *_) in (rows.dtype.fields or {}).items()
    ]
    cloud.point_step = rows.dtype.itemsize
    cloud.row_step = rows.nbytes
    cloud.data = array_of(rows)
    return cloud


def read_cloud(cloud: PointCloud2, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return rows (N,) of `dtype`; fields are found by name, at any offset of a point.

    Raises `MessageError` where a field is absent or of another type, or where the sizes
    contradict each other or the data.
    """
    width, height, step, pitch = cloud.width, cloud.height, cloud.point_step, cloud.row_step
    if width * height == 0:
        return np.zeros(0, dtype)
    offsets = _offsets(cloud, dtype)
    # Fields that share bytes would let a small message claim a large array.
    needed = sum(dtype[name].itemsize for name in offsets)
    if step < needed:
        raise MessageError(f'a point has {step} bytes, its fields {needed}')
    if pitch < width * step or len(cloud.data) < height * pitch:
        raise MessageError(
            f'{width}x{height} points of {step} bytes in rows of {pitch} bytes do not '
            f'match {len(cloud.data)} bytes of data'
        )
    data = np.frombuffer(cloud.data, np.uint8)
    rows = np.zeros(width * height, dtype)
    for name, offset in offsets.items():
        kind = dtype[name].newbyteorder('>' if cloud.is_bigendian else '<')
        values = np.ndarray((height, width), kind, data, offset, (pitch, step))
        rows[name] = values.reshape(-1)
    return rows


def pack_rgb(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return colours (N, 3) RGB as float32 (N,) with the bits 0x00RRGGBB."""
    red, green, blue = colors.astype(np.uint32).T
    return (red << 16 | green << 8 | blue).view(np.float32)


def unpack_rgb(packed: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the colours (N, 3) RGB that `pack_rgb` packed into float32 (N,)."""
    bits = np.ascontiguousarray(packed, np.float32).view(np.uint32)
    return np.stack([bits >> 16, bits >> 8, bits], axis=-1).astype(np.uint8)


def _datatype(kind: np.dtype[Any]) -> int:
    """Return PointField's number of a type."""
    return _TYPES[kind.str[1:]]


def _offsets(cloud: PointCloud2, dtype: np.dtype[Any]) -> dict[str, int]:
    """Return the byte at which each field of `dtype` begins in a point."""
    fields = {field.name: field for field in cloud.fields}
    offsets = {}
    for name in dtype.names or ():
        field = fields.get(name)
        if field is None:
            raise MessageError(f'cloud has no field {name!r}; it has {_listed(fields)}')
        kind = dtype[name]
        if (field.datatype, field.count) != (_datatype(kind), 1):
            raise MessageError(
                f'field {name!r} is {field.count} of type {field.datatype}, not 1 of '
                f'{_datatype(kind)} ({kind.name})'
            )
        if field.offset + kind.itemsize > cloud.point_step:
            raise MessageError(
                f'field {name!r} ends at byte {field.offset + kind.itemsize} of a point of '
                f'{cloud.point_step}'
            )
        offsets[name] = field.offset
    return offsets


def _listed(fields: dict[str, PointField]) -> str:
    """Return the names of a message's fields, cut to fit one line."""
    return (', '.join(fields) or 'none')[:200]
