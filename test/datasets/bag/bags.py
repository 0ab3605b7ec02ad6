# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Small recordings, written by rosbags as rosbag2 would, by mcap, and as ROS 1 would."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.lens_camera import LensCamera

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
TYPES1 = get_typestore(Stores.ROS1_NOETIC)
TYPES1.register(
    get_types_from_msg('geometry_msgs/TransformStamped[] transforms', 'tf2_msgs/msg/TFMessage')
)
MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3


class Entry(NamedTuple):
    """A message to be recorded."""

    topic: str
    type: str
    recorded_ns: int
    cdr: bytes


def write_bag(
    path: Path,
    entries: Iterable[Entry],
    plugin: StoragePlugin = MCAP,
    writer: Writer | None = None,  # for this path, where more is to be set
) -> Path:
    """Write a recording's folder; an entry's topic appears where its first message does."""
    with writer or Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for entry in entries:
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(
                    entry.topic, entry.type, typestore=TYPES
                )
            writer.write(connections[entry.topic], entry.recorded_ns, entry.cdr)
    return path


def write_mcap(path: Path, entries: Iterable[Entry], **options: Any) -> Path:
    """Write an .mcap alone, in the order of the entries; `options` are the mcap library's."""
    with path.open('wb') as file:
        writer = McapWriter(file, **options)
        writer.start('ros2')
        channels: dict[str, int] = {}
        for entry in entries:
            if entry.topic not in channels:
                text = TYPES.generate_msgdef(entry.type, ros_version=2)[0]
                schema = writer.register_schema(entry.type, 'ros2msg', text.encode())
                channels[entry.topic] = writer.register_channel(entry.topic, 'cdr', schema)
            writer.add_message(
                channels[entry.topic], entry.recorded_ns, entry.cdr, entry.recorded_ns
            )
        writer.finish()
    return path


def write_ros1(
    path: Path, entries: Iterable[Entry], compression: Writer1.CompressionFormat | None = None
) -> Path:
    """Write a .bag of ROS 1, its messages converted from the entries'."""
    writer = Writer1(path)
    writer.chunk_threshold = 10_000  # bytes, for more than one chunk
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for entry in entries:
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(
                    entry.topic, entry.type, typestore=TYPES1
                )
            data = TYPES.cdr_to_ros1(entry.cdr, entry.type)
            writer.write(connections[entry.topic], entry.recorded_ns, data)
    return path


def various() -> Iterator[Entry]:
    """Yield messages of various types that cameras and recorders send."""
    kinds = TYPES.types
    vector = kinds['geometry_msgs/msg/Vector3'](0.1, -0.2, 9.81)
    quaternion = kinds['geometry_msgs/msg/Quaternion'](0.0, 0.6, 0.0, 0.8)
    point = kinds['geometry_msgs/msg/Point'](1.0, 2.0, 3.0)
    transform = kinds['geometry_msgs/msg/Transform'](vector, quaternion)
    pose = kinds['geometry_msgs/msg/Pose'](point, quaternion)
    covariance = np.arange(9.0)
    jpeg = np.arange(101, dtype=np.uint8)  # of an odd length, as jpegs are
    head = header(START_NS, 'somewhere')
    tf = kinds['geometry_msgs/msg/TransformStamped'](head, 'there', transform)
    for k, (topic, name, fields) in enumerate(
        [
            (
                '/imu',
                'sensor_msgs/msg/Imu',
                (head, quaternion, *(covariance, vector) * 2, covariance),
            ),
            ('/jpeg', 'sensor_msgs/msg/CompressedImage', (head, 'jpeg', jpeg)),
            ('/tf_static', 'tf2_msgs/msg/TFMessage', ([tf, tf],)),
            ('/tf/0', 'geometry_msgs/msg/Transform', (vector, quaternion)),
            ('/groundtruth', 'geometry_msgs/msg/PoseStamped', (head, pose)),
            ('/units', 'std_msgs/msg/Float32', (0.001,)),
        ]
    ):
        yield entry_of(topic, name, START_NS + k * INTERVAL_NS, kinds[name](*fields))


def recording(frames: int, color: str = COLOR, depth: str = DEPTH) -> Iterator[Entry]:
    """Record camera_info, colour and depth of `frames` frames: see `color_of`, `depth_of`."""
    info = color.rsplit('/', 1)[0] + '/camera_info'
    for k in range(frames):
        stamp_ns = START_NS + k * INTERVAL_NS
        yield depth_entry(stamp_ns + DEPTH_LAG_NS, depth_of(k), depth)
        yield info_entry(stamp_ns, CAMERA, info)
        yield image_entry(color, stamp_ns, 'rgb8', color_of(k))


def color_of(k: int) -> NDArray[np.uint8]:
    """Return noise (48, 64, 3) that differs from frame to frame."""
    return np.random.default_rng(k).integers(0, 256, (48, 64, 3), np.uint8)


def depth_of(k: int) -> NDArray[np.uint16]:
    """Return millimetres (48, 64), some of them 0."""
    depth = np.random.default_rng(1000 + k).integers(500, 4000, (48, 64)).astype(np.uint16)
    depth[: 4 + k % 8] = 0
    return depth


def image_entry(
    topic: str, stamp_ns: int, encoding: str, pixels: NDArray[Any], frame: str = OPTICAL
) -> Entry:
    """Return an Image of these pixels, recorded `DELAY_NS` after its stamp."""
    name = 'sensor_msgs/msg/Image'
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    message = TYPES.types[name](
        header(stamp_ns, frame), height, width, encoding, 0, len(data) // height, data
    )
    return entry_of(topic, name, stamp_ns, message)


def depth_entry(
    stamp_ns: int, depth_mm: NDArray[np.uint16], topic: str = DEPTH, frame: str = OPTICAL
) -> Entry:
    """Return an Image in 16UC1."""
    return image_entry(topic, stamp_ns, '16UC1', depth_mm, frame)


def info_entry(
    stamp_ns: int,
    camera: PinholeCamera | LensCamera,
    topic: str = INFO,
    zoom: float = 1.0,
    projection: PinholeCamera | None = None,
) -> Entry:
    """Return a CameraInfo with K, whose focal lengths are multiplied by `zoom`, D, and P."""
    name = 'sensor_msgs/msg/CameraInfo'
    K = np.array([zoom * camera.fx, 0, camera.cx, 0, zoom * camera.fy, camera.cy, 0, 0, 1.0])
    model = 'plumb_bob' if len(camera.distortion) <= 5 else 'rational_polynomial'
    if isinstance(camera, LensCamera) and camera.fisheye:
        model = 'equidistant'
    message = TYPES.types[name](
        header=header(stamp_ns, OPTICAL),
        height=camera.height,
        width=camera.width,
        distortion_model=model,
        d=np.array(camera.distortion),
        k=K,
        r=np.eye(3).ravel(),
        p=np.zeros(12) if projection is None else _projection(projection),
        binning_x=0,
        binning_y=0,
        roi=TYPES.types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False),
    )
    return entry_of(topic, name, stamp_ns, message)


def _projection(camera: PinholeCamera) -> NDArray[np.float64]:
    return np.array([camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1.0, 0])


def header(stamp_ns: int, frame: str) -> Any:
    """Return a header."""
    stamp = TYPES.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 1_000_000_000))
    return TYPES.types['std_msgs/msg/Header'](stamp, frame)


def entry_of(topic: str, name: str, stamp_ns: int, message: Any) -> Entry:
    """Return a message on its topic, recorded `DELAY_NS` after its stamp."""
    return Entry(topic, name, stamp_ns + DELAY_NS, bytes(TYPES.serialize_cdr(message, name)))
