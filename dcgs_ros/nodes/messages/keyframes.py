# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A keyframe as the messages of `keyframe/*`, joined by one stamp, and the mapper's answer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from ...core import se3
from ...core.camera import PinholeCamera
from ...core.frame import RgbdFrame
from ...core.keyframe import Keyframe, KeyframePose, MapUpdate, PosedFrame
from ...io.ros_images import MessageError, read_camera, read_color, read_depth, stamp_ns
from .clouds import KEYFRAME_GAUSSIAN, SHAPE, read_cloud, write_cloud
from .ids import EPOCH, is_epoch, joined_ids, split_ids
from .images import header, write_camera, write_color, write_depth_mm
from .packet import KeyframePacket
from .poses import matrix, path, pose_stamped

_NEWEST = np.iinfo(np.uint32).max  # revision of an answer that says nothing
TOPICS: dict[str, type] = {
    'color': Image,
    'depth': Image,
    'camera_info': CameraInfo,
    'pose': PoseStamped,
    'depth_pose': PoseStamped,
    'reference': Path,
    'gaussians': PointCloud2,
}


def write_keyframe(packet: KeyframePacket, world: str) -> dict[str, Any]:
    """Return a message for each of `TOPICS`; a view has an empty `gaussians` cloud.

    The height of an empty cloud, which means nothing, is the number of the map, as in ids.
    `pose` is the camera's at the instant of colour, `depth_pose` at that of depth, both in the
    frame `world`. `reference` is a pose of the keyframe that a view was placed relative to, with
    its stamp, or empty.
    """
    posed = packet.posed
    frame, T_world_cam = posed.frame, posed.T_world_cam
    in_camera = header(frame.stamp_ns, packet.camera_frame)
    in_world = header(frame.stamp_ns, world)
    gaussians = write_cloud(_gaussian_rows(packet), in_world)
    if not gaussians.width:
        gaussians.height = packet.epoch
    return {
        'color': write_color(frame.color, in_camera),
        'depth': write_depth_mm(frame.depth_m, in_camera),
        'camera_info': write_camera(packet.camera, in_camera),
        'pose': pose_stamped(T_world_cam, in_world),
        'depth_pose': pose_stamped(T_world_cam @ posed.T_cam_cam_at_depth, in_world),
        'reference': path(_reference_poses(posed, world), in_world),
        'gaussians': gaussians,
    }


def _reference_poses(posed: PosedFrame, world: str) -> list[PoseStamped]:
    reference = posed.reference
    if reference is None:
        return []
    return [pose_stamped(reference.T_world_cam, header(reference.stamp_ns, world))]


def _read_reference(message: Path) -> KeyframePose | None:
    """Return the keyframe of `reference`; raises `MessageError` where its pose is unusable."""
    if not message.poses:
        return None
    pose = message.poses[0]
    return KeyframePose(stamp_ns(pose.header.stamp), matrix(pose.pose))


def _gaussian_rows(packet: KeyframePacket) -> NDArray[Any]:
    """Return KEYFRAME_GAUSSIAN rows (N,)."""
    keyframe = packet.posed
    if not isinstance(keyframe, Keyframe):
        return np.zeros(0, KEYFRAME_GAUSSIAN)
    rows = np.zeros(len(keyframe.ids), KEYFRAME_GAUSSIAN)
    rows['id'] = joined_ids(packet.epoch, keyframe.ids)
    rows['submap'] = keyframe.submap
    for k, axis in enumerate('xyz'):
        rows[axis] = keyframe.means[:, k]
        rows[f'viewpoint_{axis}'] = keyframe.T_world_cam[k, 3]
        rows[f'normal_{axis}'] = keyframe.normals[:, k]
    return rows


def read_keyframe(parts: Mapping[str, Any]) -> KeyframePacket:
    """Return the keyframe, or the view where there are no Gaussians, of a message per topic.

    Ids are those between the nodes; the epoch of a view that does not tell it is 0. Raises a
    `DcgsError` where the messages cannot be used.
    """
    rows = read_cloud(parts['gaussians'], KEYFRAME_GAUSSIAN)
    ids = whole_ids(rows)
    epochs = np.unique(split_ids(ids)[0])
    if len(epochs) > 1 or (epochs == 0).any():
        raise MessageError(f'Gaussians of a keyframe are of epochs {epochs[:5].tolist()}, not one')
    submaps = np.unique(rows['submap'])
    if len(submaps) > 1 or (submaps < 0).any():
        raise MessageError(f'a keyframe is in sub-maps {submaps[:5].tolist()}, not one')
    T_world_cam = matrix(parts['pose'].pose)
    color = parts['color']
    stamp = stamp_ns(color.header.stamp)
    posed = PosedFrame(
        RgbdFrame(stamp, stamp, read_color(color), read_depth(parts['depth'])),
        T_world_cam,
        se3.inverse(T_world_cam) @ matrix(parts['depth_pose'].pose),
        reference=_read_reference(parts['reference']),
    )
    camera = read_camera(parts['camera_info'])
    if not isinstance(camera, PinholeCamera):
        raise MessageError("a keyframe's camera_info has a lens that its images need not have")
    if not len(ids):
        height = parts['gaussians'].height
        epoch = height if is_epoch(height) else 0
        return KeyframePacket(epoch, camera, posed, color.header.frame_id)
    keyframe = Keyframe(
        posed.frame,
        posed.T_world_cam,
        posed.T_cam_cam_at_depth,
        ids,
        np.stack([rows[axis] for axis in 'xyz'], axis=1),
        np.stack([rows[f'normal_{axis}'] for axis in 'xyz'], axis=1),
        reference=posed.reference,
        submap=int(submaps[0]),
    )
    return KeyframePacket(int(epochs[0]), camera, keyframe, color.header.frame_id)


def write_answer(update: MapUpdate, stamp: int, world: str) -> PointCloud2:
    """Return how the tracker's Gaussians changed; ids are those between the nodes.

    The row of a removed Gaussian is NaN except for its id.
    """
    kept = len(update.ids)
    rows = np.zeros(kept + len(update.removed), SHAPE)
    for name in ('normal_x', 'normal_y', 'normal_z', 'flatness'):
        rows[name] = np.nan
    rows['id'] = np.concatenate([update.ids, update.removed])
    for k, axis in enumerate('xyz'):
        rows[f'normal_{axis}'][:kept] = update.normals[:, k]
    rows['flatness'][:kept] = update.flatness
    rows['revision'] = update.revision
    return write_cloud(rows, header(stamp, world))


def read_answer(cloud: PointCloud2) -> tuple[int, MapUpdate]:
    """Return epoch and update, with the tracker's ids.

    Raises `MessageError` where the Gaussians are not all of one map.
    """
    rows = read_cloud(cloud, SHAPE)
    epochs, ids = split_ids(whole_ids(rows))
    if len(rows) and (epochs.min() != epochs.max() or epochs[0] == 0):
        raise MessageError(f'an answer is of epochs {epochs.min()} to {epochs.max()}, not one')
    normals = np.stack([rows[f'normal_{axis}'] for axis in 'xyz'], axis=1)
    kept = np.isfinite(normals).all(axis=1)
    update = MapUpdate(
        ids[kept], np.empty((0, 3), np.float32), normals[kept], rows['flatness'][kept],
        ids[~kept], int(rows['revision'].min(initial=_NEWEST)),
    )  # fmt: skip
    return (int(epochs[0]) if len(rows) else 0), update


def whole_ids(rows: NDArray[Any]) -> NDArray[np.int64]:
    """Return the `id` field (N,) as integers; raise `MessageError` where one is not whole."""
    ids = rows['id']
    if not ((np.abs(ids) < EPOCH * EPOCH / 2048) & (ids == np.floor(ids))).all():  # also NaN
        raise MessageError('an id is not a whole number below 2^53')
    return ids.astype(np.int64)
