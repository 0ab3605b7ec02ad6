# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Small recordings, written by rosbags as rosbag2 would."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dcgs_ros.core.camera import PinholeCamera

COLOR = '/camera/camera/color/image_raw'
DEPTH = '/camera/camera/aligned_depth_to_color/image_raw'
INFO = '/camera/camera/color/camera_info'
OPTICAL = 'camera_color_optical_frame'
CAMERA = PinholeCamera(64, 48, 50.0, 51.0, 31.5, 23.5, (0.1, -0.2, 0.001, 0.002, 0.05))
START_NS = 1_700_000_000_000_000_000
INTERVAL_NS = 33_333_333
DEPTH_LAG_NS = -4_000_000  # of depth's stamps against colour's
DELAY_NS = 20_000_000  # from a stamp to its recording

TYPES = get_typestore(Stores.ROS2_JAZZY)
MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3


class Entry(NamedTuple):
    """A message on its way into a recording."""

    topic: str
    type: str
    recorded_ns: int
    cdr: bytes


def write_bag(path: Path, entries: Iterable[Entry], plugin: StoragePlugin = MCAP) -> Path:
    """Write a recording's folder; an entry's topic appears where its first message does."""
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for entry in entries:
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(
                    entry.topic, entry.type, typestore=TYPES
                )
            writer.write(connections[entry.topic], entry.recorded_ns, entry.cdr)
    return path


def recording(frames: int, color: str = COLOR, depth: str = DEPTH) -> Iterator[Entry]:
    """Record camera_info, colour and depth of `frames` frames: see `color_of`, `depth_of`."""
    info = color.rsplit('/', 1)[0] + '/camera_info'
    for k in range(frames):
        stamp_ns = START_NS + k * INTERVAL_NS
        yield depth_entry(stamp_ns + DEPTH_LAG_NS, depth_of(k), depth)
        yield info_entry(stamp_ns, CAMERA, info)
        yield image_entry(color, stamp_ns, 'rgb8', color_of(k))


def color_of(k: int) -> np.ndarray:
    """Noise, another in each frame (48, 64, 3)."""
    return np.random.default_rng(k).integers(0, 256, (48, 64, 3), np.uint8)


def depth_of(k: int) -> np.ndarray:
    """Millimetres (48, 64), some of them 0."""
    depth = np.random.default_rng(1000 + k).integers(500, 4000, (48, 64)).astype(np.uint16)
    depth[: 4 + k % 8] = 0
    return depth


def image_entry(
    topic: str, stamp_ns: int, encoding: str, pixels: np.ndarray, frame: str = OPTICAL
) -> Entry:
    """Image of these pixels, recorded `DELAY_NS` after its stamp."""
    name = 'sensor_msgs/msg/Image'
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    message = TYPES.types[name](
        _header(stamp_ns, frame), height, width, encoding, 0, len(data) // height, data
    )
    return _entry(topic, name, stamp_ns, message)


def depth_entry(
    stamp_ns: int, depth_mm: np.ndarray, topic: str = DEPTH, frame: str = OPTICAL
) -> Entry:
    """Image in 16UC1."""
    return image_entry(topic, stamp_ns, '16UC1', depth_mm, frame)


def info_entry(stamp_ns: int, camera: PinholeCamera, topic: str = INFO) -> Entry:
    """CameraInfo with K and D."""
    name = 'sensor_msgs/msg/CameraInfo'
    K = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0])
    message = TYPES.types[name](
        header=_header(stamp_ns, OPTICAL),
        height=camera.height,
        width=camera.width,
        distortion_model='plumb_bob',
        d=np.array(camera.distortion),
        k=K,
        r=np.eye(3).ravel(),
        p=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=TYPES.types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False),
    )
    return _entry(topic, name, stamp_ns, message)


def _header(stamp_ns: int, frame: str) -> Any:
    stamp = TYPES.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 1_000_000_000))
    return TYPES.types['std_msgs/msg/Header'](stamp, frame)


def _entry(topic: str, name: str, stamp_ns: int, message: Any) -> Entry:
    return Entry(topic, name, stamp_ns + DELAY_NS, bytes(TYPES.serialize_cdr(message, name)))
