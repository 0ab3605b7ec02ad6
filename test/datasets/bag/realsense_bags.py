# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Recordings by realsense2_camera and RealSense Viewer other than registered raw images."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Any

import cv2
import numpy as np
from bags import (  # type: ignore[import-not-found]
    COLOR,
    DEPTH,
    INTERVAL_NS,
    START_NS,
    TYPES,
    Entry,
    color_of,
    depth_entry,
    depth_of,
    entry_of,
    header,
    image_entry,
    info_entry,
)
from numpy.typing import NDArray
from rosbags.typesys import get_types_from_msg

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera

DEPTH_CAMERA = PinholeCamera(64, 48, 40.0, 40.0, 31.0, 23.0)
T_COLORCAM_DEPTHCAM = se3.exp(np.array([0.015, -0.002, 0.001, 0.01, -0.02, 0.03]))
UNALIGNED = '/camera/camera/depth/image_rect_raw'
DEPTH_INFO = '/camera/camera/depth/camera_info'
DEPTH_OPTICAL = 'camera_depth_optical_frame'
EXTRINSICS_TOPIC = '/camera/camera/extrinsics/depth_to_color'
EXTRINSICS = 'realsense2_camera_msgs/msg/Extrinsics'
VIEWER_COLOR = '/device_0/sensor_1/Color_0'
VIEWER_DEPTH = '/device_0/sensor_0/Depth_0'

TYPES.register(get_types_from_msg('float64[9] rotation\nfloat64[3] translation', EXTRINSICS))


def unaligned(frames: int, camera: PinholeCamera = DEPTH_CAMERA) -> Iterator[Entry]:
    """Yield unregistered depth and its camera_info."""
    for k in range(frames):
        stamp_ns = START_NS + k * INTERVAL_NS
        yield info_entry(stamp_ns, camera, DEPTH_INFO)
        yield depth_entry(stamp_ns, depth_of(k), UNALIGNED, DEPTH_OPTICAL)


def extrinsics_entry(T: NDArray[np.float64], topic: str = EXTRINSICS_TOPIC) -> Entry:
    """Return an Extrinsics: rotation by columns, translation."""
    message = TYPES.types[EXTRINSICS](T[:3, :3].T.ravel(), T[:3, 3].copy())
    return entry_of(topic, EXTRINSICS, START_NS, message)


def static_entry(transforms: Iterable[tuple[str, str, NDArray[np.float64]]]) -> Entry:
    """Return a /tf_static of (parent, child, T_parent_child)."""
    stamped = [
        TYPES.types['geometry_msgs/msg/TransformStamped'](
            header(START_NS, parent), child, _transform(T)
        )
        for parent, child, T in transforms
    ]
    name = 'tf2_msgs/msg/TFMessage'
    return entry_of('/tf_static', name, START_NS, TYPES.types[name](stamped))


def imu_entry(
    topic: str,
    stamp_ns: int,
    acceleration: tuple[float, float, float],
    rate: tuple[float, float, float],
    missing: str = '',
) -> Entry:
    """Return an Imu; `missing` is the quantity whose covariance begins with -1."""
    vector = TYPES.types['geometry_msgs/msg/Vector3']
    covariances = {name: np.zeros(9) for name in ('acceleration', 'rate')}
    if missing:
        covariances[missing][0] = -1
    message = TYPES.types['sensor_msgs/msg/Imu'](
        header(stamp_ns, 'camera_imu_optical_frame'),
        TYPES.types['geometry_msgs/msg/Quaternion'](0, 0, 0, 1),
        np.zeros(9),
        vector(*rate),
        covariances['rate'],
        vector(*acceleration),
        covariances['acceleration'],
    )
    return entry_of(topic, 'sensor_msgs/msg/Imu', stamp_ns, message)


def pose_entry(stamp_ns: int, T: NDArray[np.float64], topic: str = '/groundtruth') -> Entry:
    """Return a PoseStamped."""
    transform, name = _transform(T), 'geometry_msgs/msg/PoseStamped'
    place = transform.translation
    point = TYPES.types['geometry_msgs/msg/Point'](place.x, place.y, place.z)
    pose = TYPES.types['geometry_msgs/msg/Pose'](point, transform.rotation)
    return entry_of(topic, name, stamp_ns, TYPES.types[name](header(stamp_ns, 'world'), pose))


def compressed_entry(topic: str, stamp_ns: int, format_: str, data: bytes) -> Entry:
    """Return a CompressedImage."""
    name = 'sensor_msgs/msg/CompressedImage'
    message = TYPES.types[name](
        header(stamp_ns, 'camera_color_optical_frame'), format_, np.frombuffer(data, np.uint8)
    )
    return entry_of(topic, name, stamp_ns, message)


def encoded(extension: str, pixels: NDArray[Any]) -> bytes:
    """Return an image file of RGB or depth."""
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(extension, pixels)[1])


def quantised(
    depth_m: NDArray[np.float32], quantisation: float = 100.0, farthest_m: float = 10.0
) -> bytes:
    """Return inverse depth as compressed_depth_image_transport encodes 32FC1."""
    a = quantisation * (quantisation + 1.0)
    b = 1.0 - a / farthest_m
    inverse = np.zeros(depth_m.shape, np.uint16)
    near = (depth_m > 0) & (depth_m < farthest_m)
    inverse[near] = (a / depth_m[near] + b).astype(np.uint16)
    return struct.pack('<Iff', 0, a, b) + encoded('.png', inverse)


def compressed(frames: int) -> Iterator[Entry]:
    """Yield losslessly compressed colour and depth on image_transport's topics."""
    for k in range(frames):
        stamp_ns = START_NS + k * INTERVAL_NS
        png = encoded('.png', color_of(k))
        yield compressed_entry(f'{COLOR}/compressed', stamp_ns, 'rgb8; png compressed bgr8', png)
        yield compressed_entry(
            f'{DEPTH}/compressedDepth',
            stamp_ns,
            '16UC1; compressedDepth png',
            bytes(12) + encoded('.png', depth_of(k)),
        )


def viewer(
    frames: int, camera: PinholeCamera, T_color_ref: NDArray[np.float64], units_m: float = 0.001
) -> Iterator[Entry]:
    """Yield RealSense Viewer's topics; depth is of `DEPTH_CAMERA`."""
    T_depth_ref = se3.inverse(T_COLORCAM_DEPTHCAM) @ T_color_ref
    for stream, T in ((VIEWER_COLOR, T_color_ref), (VIEWER_DEPTH, T_depth_ref)):
        name = 'geometry_msgs/msg/Transform'
        yield entry_of(f'{stream}/tf/0', name, START_NS, _transform(T))
    unit = TYPES.types['std_msgs/msg/Float32'](units_m)
    name = '/device_0/sensor_0/option/Depth_Units/value'
    yield entry_of(name, 'std_msgs/msg/Float32', START_NS, unit)
    yield info_entry(START_NS, camera, f'{VIEWER_COLOR}/info/camera_info')
    yield info_entry(START_NS, DEPTH_CAMERA, f'{VIEWER_DEPTH}/info/camera_info')
    for k in range(frames):
        stamp_ns = START_NS + k * INTERVAL_NS
        depth = f'{VIEWER_DEPTH}/image/data'
        yield image_entry(depth, stamp_ns, 'mono16', depth_of(k), frame='0')
        yield image_entry(f'{VIEWER_COLOR}/image/data', stamp_ns, 'rgb8', color_of(k), frame='0')


def _transform(T: NDArray[np.float64]) -> Any:
    w, x, y, z = se3.to_quaternion(T)
    return TYPES.types['geometry_msgs/msg/Transform'](
        TYPES.types['geometry_msgs/msg/Vector3'](*T[:3, 3]),
        TYPES.types['geometry_msgs/msg/Quaternion'](x, y, z, w),
    )
