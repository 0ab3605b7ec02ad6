# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A keyframe as the messages of `keyframe/*`, joined by one stamp, and the mapper's answer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from ...core import se3
from ...core.frame import RgbdFrame
from ...core.keyframe import Keyframe, MapUpdate
from ...io.ros_images import MessageError, read_camera, read_color, read_depth, stamp_ns
from ..tracking.keyframe_sender import KeyframePacket
from .clouds import KEYFRAME_GAUSSIAN, SHAPE, read_cloud, write_cloud
from .ids import EPOCH, joined_ids, split_ids
from .poses import matrix, pose_stamped
from .standard import header, write_camera, write_color, write_depth_mm

TOPICS: dict[str, type] = {
    'color': Image,
    'depth': Image,
    'camera_info': CameraInfo,
    'pose': PoseStamped,
    'depth_pose': PoseStamped,
    'gaussians': PointCloud2,
}


def write_keyframe(offer: KeyframePacket, world: str, camera_frame: str) -> dict[str, Any]:
    """One message a topic. `pose` is at the colour's instant, `depth_pose` at the depth's."""
    keyframe = offer.keyframe
    frame, T_world_cam = keyframe.frame, keyframe.T_world_cam
    seen, placed = header(frame.stamp_ns, camera_frame), header(frame.stamp_ns, world)
    rows = np.zeros(len(keyframe.ids), KEYFRAME_GAUSSIAN)
    rows['id'] = joined_ids(offer.epoch, keyframe.ids)
    for k, axis in enumerate('xyz'):
        rows[axis] = keyframe.means[:, k]
        rows[f'viewpoint_{axis}'] = T_world_cam[k, 3]
        rows[f'normal_{axis}'] = keyframe.normals[:, k]
    return {
        'color': write_color(frame.color, seen),
        'depth': write_depth_mm(frame.depth_m, seen),
        'camera_info': write_camera(offer.camera, seen),
        'pose': pose_stamped(T_world_cam, placed),
        'depth_pose': pose_stamped(T_world_cam @ keyframe.T_cam_cam_at_depth, placed),
        'gaussians': write_cloud(rows, placed),
    }


def read_keyframe(parts: Mapping[str, Any]) -> KeyframePacket:
    """Make the keyframe of its messages; ids are those between the nodes, epoch 0 if it has none.

    Raises a `DcgsError` where they cannot be one.
    """
    rows = read_cloud(parts['gaussians'], KEYFRAME_GAUSSIAN)
    ids = _ids(rows)
    epochs = np.unique(split_ids(ids)[0])
    if len(epochs) > 1 or (epochs == 0).any():
        raise MessageError(f'Gaussians of a keyframe are of epochs {epochs[:5].tolist()}')
    T_world_cam = matrix(parts['pose'].pose)
    stamp = stamp_ns(parts['color'].header.stamp)
    keyframe = Keyframe(
        RgbdFrame(stamp, stamp, read_color(parts['color']), read_depth(parts['depth'])),
        T_world_cam,
        se3.inverse(T_world_cam) @ matrix(parts['depth_pose'].pose),
        ids,
        np.stack([rows[axis] for axis in 'xyz'], axis=1),
        np.stack([rows[f'normal_{axis}'] for axis in 'xyz'], axis=1),
    )
    epoch = int(epochs[0]) if len(epochs) else 0
    return KeyframePacket(epoch, read_camera(parts['camera_info']), keyframe)


def write_answer(update: MapUpdate, stamp: int, world: str) -> PointCloud2:
    """How the tracker's Gaussians changed, ids being those between the nodes.

    A row of a removed one is NaN but for its id.
    """
    kept = len(update.ids)
    rows = np.full(kept + len(update.removed), np.nan, SHAPE)
    rows['id'] = np.concatenate([update.ids, update.removed])
    for k, axis in enumerate('xyz'):
        rows[f'normal_{axis}'][:kept] = update.normals[:, k]
    rows['flatness'][:kept] = update.flatness
    return write_cloud(rows, header(stamp, world))


def read_answer(cloud: PointCloud2) -> tuple[int, MapUpdate]:
    """Epoch and update, ids being the tracker's; raises `MessageError` where it is of no map."""
    rows = read_cloud(cloud, SHAPE)
    epochs, ids = split_ids(_ids(rows))
    if len(rows) and (epochs.min() != epochs.max() or epochs[0] == 0):
        raise MessageError(f'an answer is of epochs {epochs.min()} to {epochs.max()}')
    normals = np.stack([rows[f'normal_{axis}'] for axis in 'xyz'], axis=1)
    kept = np.isfinite(normals).all(axis=1)
    update = MapUpdate(
        ids[kept], np.empty((0, 3), np.float32), normals[kept], rows['flatness'][kept], ids[~kept]
    )
    return (int(epochs[0]) if len(rows) else 0), update


def _ids(rows: np.ndarray) -> np.ndarray:
    """Whole numbers of the `id` field."""
    ids = rows['id']
    if not ((np.abs(ids) < EPOCH * EPOCH / 2048) & (ids == np.floor(ids))).all():  # also NaN
        raise MessageError('an id is no whole number below 2^53')
    return ids.astype(np.int64)
