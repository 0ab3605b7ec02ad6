# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Extrinsics between the depth camera and the colour camera of a recording."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...io.ros_images import MessageError
from ...io.trajectory import QUATERNION_NORM_TOLERANCE
from .messages import decode
from .recording import first_messages, raw_messages
from .recovery.losses import DamagedError
from .streams import stream_of
from .topics import STATIC_TOPIC, CameraTopics, viewer_stream

_FARTHEST_M = 1e9  # from the origin; a larger number is corrupt
_ROTATION_TOLERANCE = 1e-3  # of R^T R against the identity; devices use 32-bit floats

Transforms = dict[str, tuple[str, NDArray[np.float64]]]  # child frame: parent, T_parent_child


def find_T_colorcam_depthcam(
    path: Path | str, topics: CameraTopics, frames: tuple[str, str]
) -> NDArray[np.float64] | None:
    """Return the transform (4, 4) from the depth camera's frame to colour's, metres, or None.

    It is found in realsense2_camera's extrinsics, else between `frames` (colour's and depth's) in
    /tf_static; RealSense Viewer records a transform beside each stream instead. None if nothing is
    recorded. Raises `MessageError` for numbers that are no rigid transform.
    """
    viewer = viewer_stream(topics.color), viewer_stream(topics.depth)
    if viewer[0] is not None or viewer[1] is not None:
        names = [f'{stream}/tf/0' for stream in viewer]
        found = first_messages(path, names)
        if len(found) < len(names):
            return None
        # Each maps points of the reference stream to those of its own.
        T_color_ref, T_depth_ref = (
            read_transform(found[name].translation, found[name].rotation) for name in names
        )
        return T_color_ref @ se3.inverse(T_depth_ref)
    name = f'{stream_of(topics.depth).rsplit("/", 2)[0]}/extrinsics/depth_to_color'
    if message := first_messages(path, [name]).get(name):
        return _from_columns(message.rotation, message.translation)
    return transform_between(static_transforms(path), *(frame.lstrip('/') for frame in frames))


def read_transform(translation: Any, rotation: Any) -> NDArray[np.float64]:
    """Return the transform (4, 4) of a message's vector and quaternion, which is normalised.

    Raises `MessageError` if a number is not finite or huge, or the quaternion not of unit length.
    """
    position = translation.x, translation.y, translation.z
    quat_wxyz = rotation.w, rotation.x, rotation.y, rotation.z
    norm = math.hypot(*quat_wxyz)
    if not (math.hypot(*position) < _FARTHEST_M and abs(norm - 1) <= QUATERNION_NORM_TOLERANCE):
        raise MessageError(f'position {position}, quaternion wxyz {quat_wxyz} is no transform')
    return se3.from_quaternion(np.array(quat_wxyz) / norm, np.array(position))


def transform_between(
    transforms: Transforms, target: str, source: str
) -> NDArray[np.float64] | None:
    """Return T_target_source (4, 4) through a tree of frames; None if they are not connected."""
    target_root, T_target = _from_root(transforms, target)
    source_root, T_source = _from_root(transforms, source)
    return se3.inverse(T_target) @ T_source if target_root == source_root else None


def _from_root(transforms: Transforms, frame: str) -> tuple[str, NDArray[np.float64]]:
    """Return the root above a frame, and T_root_frame."""
    T, seen = np.eye(4), {frame}
    while frame in transforms:
        frame, T_parent = transforms[frame]
        T = T_parent @ T
        if frame in seen:
            raise MessageError(f'{STATIC_TOPIC}: frame {frame!r} is above itself')
        seen.add(frame)
    return frame, T


def static_transforms(path: Path | str) -> Transforms:
    """Return the recorded static transforms; raises `MessageError` for one that is none."""
    found: Transforms = {}
    with suppress(DamagedError):
        for message in raw_messages(path, [STATIC_TOPIC]):
            for stamped in decode(message.cdr, message.type).transforms:
                T = read_transform(stamped.transform.translation, stamped.transform.rotation)
                found[stamped.child_frame_id.lstrip('/')] = stamped.header.frame_id.lstrip('/'), T
    return found


def _from_columns(
    rotation: NDArray[np.float64], translation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the transform (4, 4) of librealsense's extrinsics: rotation (9,) by columns."""
    T = np.eye(4)
    T[:3, :3] = np.reshape(rotation, (3, 3)).T
    T[:3, 3] = translation
    R = T[:3, :3]
    error = np.abs(R.T @ R - np.eye(3)).max()
    rigid = error < _ROTATION_TOLERANCE and np.linalg.det(R) > 0
    if not (rigid and np.linalg.norm(translation) < _FARTHEST_M):
        raise MessageError(f'extrinsics {T[:3].tolist()} are no transform')
    return se3.orthonormalised(T)
