# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper's map and its keyframes as rows of clouds: updates, and what the tracker reads.

`map_rows.py` makes the rows. Nothing of the mapper is imported here, since the tracker reads them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...io.ros_images import MessageError

UPDATES_KEPT = 32  # for late subscribers: more than are sent between two whole maps


def changes(before: NDArray[Any], now: NDArray[Any]) -> NDArray[Any]:
    """Return the update (K,) that leads from one map to another: what changed or was removed.

    Both maps (N,), (M,) are MAP_GAUSSIAN rows in ascending order of id. The row of a removed
    Gaussian is NaN except for its id.
    """
    at = np.searchsorted(before['id'], now['id'])
    at[at == len(before)] = 0
    same = np.zeros(len(now), np.bool_)
    if len(before):
        plain = f'V{now.dtype.itemsize}'
        same = before.view(plain)[at] == now.view(plain)
    gone = np.setdiff1d(before['id'], now['id'], assume_unique=True)
    removed = np.zeros(len(gone), now.dtype)
    for name in now.dtype.names or ():
        if now.dtype[name].kind == 'f':
            removed[name] = np.nan
    removed['id'] = gone
    return np.concatenate([now[~same], removed])


def updated(rows: NDArray[Any], update: NDArray[Any]) -> NDArray[Any]:
    """Return the map (M,) after an update (K,) of `changes` to the map (N,)."""
    left = rows[~np.isin(rows['id'], update['id'])]
    together = np.concatenate([left, update[~np.isnan(update['x'])]])
    return together[np.argsort(together['id'])]


def read_poses(rows: NDArray[Any]) -> list[NDArray[np.float64]]:
    """Return the poses T_world_cam (4, 4) of KEYFRAME_POSE rows (N,).

    Raises `MessageError` where one is not finite or its quaternion is zero.
    """
    quats = np.stack([rows[name] for name in ('qw', 'qx', 'qy', 'qz')], axis=1)
    positions = np.stack([rows[axis] for axis in 'xyz'], axis=1)
    usable = (
        np.isfinite(positions).all(axis=1) & np.isfinite(quats).all(axis=1) & quats.any(axis=1)
    )
    if not usable.all():
        raise MessageError(f'{np.count_nonzero(~usable)} of {len(rows)} keyframes have no pose')
    return list(se3.from_quaternion(quats.astype(np.float64), positions.astype(np.float64)))


def read_stamps(rows: NDArray[Any]) -> list[int]:
    """Return the stamps, nanoseconds, of KEYFRAME_POSE rows (N,)."""
    return (rows['sec'].astype(np.int64) * 1_000_000_000 + rows['nanosec']).tolist()
