# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A correction as the cloud of `keyframe_poses`: where all keyframes of the tracker are now."""

from __future__ import annotations

import numpy as np
from sensor_msgs.msg import PointCloud2

from ...core import se3
from ...core.keyframe import Correction
from ...io.ros_images import MessageError
from .clouds import CORRECTED_POSE, read_cloud, write_cloud
from .ids import is_epoch, joined_ids, split_ids
from .images import header
from .keyframes import whole_ids
from .maps import read_poses, read_stamps

_SECOND = 1_000_000_000


def write_correction(correction: Correction, epoch: int, world: str) -> PointCloud2:
    """Return a correction of the map `epoch`, in the frame `world`, without its covariances.

    Its stamp is that of the newest keyframe.
    """
    stamps = correction.stamps_ns
    rows = np.zeros(len(stamps), CORRECTED_POSE)
    rows['id'] = joined_ids(epoch, np.arange(len(stamps)))
    rows['sec'], rows['nanosec'] = stamps // _SECOND, stamps % _SECOND
    rows['revision'], rows['submap'] = correction.revision, correction.submaps
    for k, axis in enumerate('xyz'):
        rows[axis] = correction.T_world_cam[:, k, 3]
    quats = se3.to_quaternion(correction.T_world_cam)
    for k, name in enumerate(('qw', 'qx', 'qy', 'qz')):
        rows[name] = quats[:, k]
    return write_cloud(rows, header(int(stamps.max(initial=0)), world))


def read_correction(cloud: PointCloud2) -> tuple[int, Correction]:
    """Return epoch and correction; its covariances, which are not sent, are NaN.

    Raises `MessageError` where it is not of one map and one revision, or a pose is unusable.
    """
    rows = read_cloud(cloud, CORRECTED_POSE)
    if not len(rows):
        raise MessageError('a correction without keyframes')
    epochs, _ = split_ids(whole_ids(rows))
    if epochs.min() != epochs.max() or not is_epoch(int(epochs[0])):
        raise MessageError(f'a correction is of epochs {epochs.min()} to {epochs.max()}, not one')
    revisions = rows['revision']
    if revisions.min() != revisions.max():
        raise MessageError(
            f'a correction has revisions {revisions.min()} to {revisions.max()}, not one'
        )
    stamps = np.array(read_stamps(rows), np.int64)
    if len(np.unique(stamps)) != len(stamps):
        raise MessageError(f'{len(stamps)} keyframes of a correction have not as many stamps')
    covariances = np.full((len(rows), 6, 6), np.nan)
    poses = np.array(read_poses(rows))
    return int(epochs[0]), Correction(
        int(revisions[0]), stamps, poses, covariances, rows['submap'].astype(np.int32)
    )
