# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Transforms (4, 4) as Pose, PoseStamped, TransformStamped and Path, and a Pose back."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from std_msgs.msg import Header

from ...core import se3
from ...io.ros_images import MessageError

_SHORTEST = 1e-6  # of a quaternion: below, it is one that nobody filled in
_FARTHEST = 1e9  # metres from the origin; beyond, float32 has no place for a map


def pose_message(T: NDArray) -> Pose:
    """Pose of the frame that `T` maps from."""
    x, y, z = T[:3, 3].tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=_quaternion(T))


def matrix(pose: Pose) -> NDArray[np.float64]:
    """Transform (4, 4) of a pose, its quaternion normalised.

    Raises `MessageError` where a number is not finite or huge, or the quaternion zero.
    """
    p, q = pose.position, pose.orientation
    position, quat_wxyz = (p.x, p.y, p.z), (q.w, q.x, q.y, q.z)
    norm = math.hypot(*quat_wxyz)
    if not math.hypot(*position) < _FARTHEST or not _SHORTEST <= norm < math.inf:
        raise MessageError(f'position {position}, quaternion wxyz {quat_wxyz} is no pose')
    return se3.from_quaternion(np.array(quat_wxyz) / norm, np.array(position))


def pose_stamped(T: NDArray, header: Header) -> PoseStamped:
    """Pose of the frame that `T` maps from, in the header's frame."""
    return PoseStamped(header=header, pose=pose_message(T))


def transform_stamped(T: NDArray, header: Header, child: str) -> TransformStamped:
    """Transform that maps from frame `child` to the header's."""
    message = TransformStamped(header=header, child_frame_id=child)
    x, y, z = T[:3, 3].tolist()
    message.transform.translation = Vector3(x=x, y=y, z=z)
    message.transform.rotation = _quaternion(T)
    return message


def path(poses: Sequence[PoseStamped], header: Header) -> Path:
    """Path through poses that are in the header's frame."""
    return Path(header=header, poses=list(poses))


def _quaternion(T: NDArray) -> Quaternion:
    """Rotation of `T`, w >= 0."""
    w, x, y, z = se3.to_quaternion(T).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)
