# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Encoding ROS 2 messages without ROS: poses, IMU samples, odometry, static transforms.

Topics and frames are those of realsense2_camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....core import se3
from ....core.errors import DcgsError
from ....core.trajectory import Trajectory
from ....io.trajectory import format_stamp_ns
from ...mounts import Mount
from ...source import ImuSample, OdometrySample
from ..messages import RawMessage, message_types
from ..topics import GROUNDTRUTH_TOPIC, ODOMETRY_TOPIC, STATIC_TOPIC

CAMERA = '/camera/camera'
OPTICAL_FRAME = 'camera_color_optical_frame'
LINK_FRAME = 'camera_link'

_NS_PER_S = 1_000_000_000
_UNKNOWN = np.array([-1.0, *[0.0] * 8])  # a covariance that declares the value unknown


class EncodingError(DcgsError):
    """A value that no message can hold."""


def make(name: str, *values: Any, **named: Any) -> Any:
    """Return a message, or a part of one, with these fields; `name` is package/Name."""
    return message_types().types[name.replace('/', '/msg/')](*values, **named)


def header(stamp_ns: int, frame: str) -> Any:
    """Return a header; raises `EncodingError` if the seconds do not fit its 32 bits."""
    if not 0 <= stamp_ns < 2**31 * _NS_PER_S:
        raise EncodingError(
            f'stamp {format_stamp_ns(stamp_ns)} s: a message has 0 to {2**31 - 1} seconds'
        )
    return make(
        'std_msgs/Header', make('builtin_interfaces/Time', *divmod(stamp_ns, _NS_PER_S)), frame
    )


def on_topic(topic: str, stamp_ns: int, message: Any) -> RawMessage:
    """Return the serialised message, recorded at its stamp."""
    name = message.__msgtype__
    return RawMessage(topic, name, stamp_ns, bytes(message_types().serialize_cdr(message, name)))


def encode_mounts(mounts: Sequence[Mount], stamp_ns: int) -> RawMessage:
    """Return the static transforms between frames."""
    stamped = []
    for parent, child, T in mounts:
        rotation = _quaternion(se3.to_quaternion(T))
        transform = make('geometry_msgs/Transform', _vector('Vector3', T[:3, 3]), rotation)
        stamped.append(
            make('geometry_msgs/TransformStamped', header(stamp_ns, parent), child, transform)
        )
    return on_topic(STATIC_TOPIC, stamp_ns, make('tf2_msgs/TFMessage', stamped))


def encode_truth(truth: Trajectory, start_ns: int) -> Iterator[RawMessage]:
    """Encode the poses of the optical frame since `start_ns`, as PoseStamped in frame 'world'."""
    since = truth.stamps_ns >= start_ns
    T_world_cam = truth.T_world_cam[since]
    rotations = se3.to_quaternion(T_world_cam)
    for stamp_ns, T, rotation in zip(
        truth.stamps_ns[since].tolist(), T_world_cam, rotations, strict=True
    ):
        pose = make('geometry_msgs/Pose', _vector('Point', T[:3, 3]), _quaternion(rotation))
        stamped = make('geometry_msgs/PoseStamped', header(stamp_ns, 'world'), pose)
        yield on_topic(GROUNDTRUTH_TOPIC, stamp_ns, stamped)


def encode_imu(sample: ImuSample) -> RawMessage:
    """Return an Imu on topic imu, or with one quantity on accel/sample or gyro/sample."""
    rate, acceleration = sample.angular_velocity, sample.acceleration
    topic = 'imu' if rate and acceleration else 'gyro/sample' if rate else 'accel/sample'
    values = [_quaternion((1.0, 0.0, 0.0, 0.0)), _UNKNOWN]
    for value in (rate, acceleration):
        values += [_vector('Vector3', value or (0.0, 0.0, 0.0)), np.zeros(9)]
        if value is None:
            values[-1] = _UNKNOWN
    message = make('sensor_msgs/Imu', header(sample.stamp_ns, sample.frame), *values)
    return on_topic(f'{CAMERA}/{topic}', sample.stamp_ns, message)


def encode_odometry(sample: OdometrySample) -> RawMessage:
    """Return an Odometry, without covariances."""
    x, y, heading = sample.pose
    forward, left, turning = sample.velocity
    upright = math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading)
    place = make('geometry_msgs/Pose', _vector('Point', (x, y, 0.0)), _quaternion(upright))
    velocity = (_vector('Vector3', xyz) for xyz in ((forward, left, 0.0), (0.0, 0.0, turning)))
    message = make(
        'nav_msgs/Odometry', header(sample.stamp_ns, sample.frame), sample.base_frame,
        make('geometry_msgs/PoseWithCovariance', place, np.zeros(36)),
        make(
            'geometry_msgs/TwistWithCovariance', make('geometry_msgs/Twist', *velocity),
            np.zeros(36),
        ),
    )  # fmt: skip
    return on_topic(ODOMETRY_TOPIC, sample.stamp_ns, message)


def _vector(name: str, xyz: NDArray[np.float64] | tuple[float, float, float]) -> Any:
    return make(f'geometry_msgs/{name}', *(float(value) for value in xyz))


def _quaternion(quat_wxyz: NDArray[np.float64] | tuple[float, float, float, float]) -> Any:
    w, x, y, z = (float(value) for value in quat_wxyz)
    return make('geometry_msgs/Quaternion', x, y, z, w)
