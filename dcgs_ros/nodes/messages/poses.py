# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Transforms (4, 4) as Pose, PoseStamped, TransformStamped and Path; a Pose as transform."""

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

_SHORTEST = 1e-6  # quaternion: anything shorter was never filled in
_FARTHEST = 1e9  # metres from the origin: beyond, float32 cannot hold a map


def pose_message(T: NDArray[np.float64]) -> Pose:
    """Return the pose of the frame that `T` maps from."""
    x, y, z = T[:3, 3].tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=_quaternion(T))


def matrix(pose: Pose) -> NDArray[np.float64]:
    """Return the transform (4, 4) of a pose, with its quaternion normalised.

    Raises `MessageError` where a number is not finite or too large, or the quaternion is zero.
    """
    p, q = pose.position, pose.orientation
    position, quat_wxyz = (p.x, p.y, p.z), (q.w, q.x, q.y, q.z)
    norm = math.hypot(*quat_wxyz)
    if not math.hypot(*position) < _FARTHEST or not _SHORTEST <= norm < math.inf:
        raise MessageError(f'position {position}, quaternion wxyz {quat_wxyz} are not a pose')
    return se3.from_quaternion(np.array(quat_wxyz) / norm, np.array(position))


def pose_stamped(T: NDArray[np.float64], header: Header) -> PoseStamped:
    """Return the pose of the frame that `T` maps from, in the header's frame."""
    return PoseStamped(header=header, pose=pose_message(T))


def transform_stamped(T: NDArray[np.float64], header: Header, child: str) -> TransformStamped:
    """Return the transform that maps from frame `child` to the header's."""
    message = TransformStamped(header=header, child_frame_id=child)
    x, y, z = T[:3, 3].tolist()
    message.transform.translation = Vector3(x=x, y=y, z=z)
    message.transform.rotation = _quaternion(T)
    return message


def path(poses: Sequence[PoseStamped], header: Header) -> Path:
    """Return the path through poses, which are in the header's frame."""
    return Path(header=header, poses=list(poses))


def _quaternion(T: NDArray[np.float64]) -> Quaternion:
    """Return the rotation of `T`, with w >= 0."""
    w, x, y, z = se3.to_quaternion(T).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)
