# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Map files of older versions: what they lack is made up from what they have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.camera import PinholeCamera
from ..core.sensor import SensorNoise
from ..core.shape import normals_and_flatness
from ..core.tracking.depth_bias import TERMS
from ..core.tracking.verification import Usual
from .archive import Archive
from .map_parts import check, check_keyframes, part
from .saved_tracker import ID_MARGIN
from .sessions import SESSIONS_NAME, SavedSession, write_sessions

_PLANES = 14  # x y z, three log-scales, four of the rotation, opacity, three of the colour


def with_tracker(archive: Archive, camera: PinholeCamera, sensor: SensorNoise) -> Archive:
    """Return an archive of version 1 as one of the newest.

    Every view counts as a keyframe. Means are as the mapper moved them, and normals are those of
    Sigma_r. Raises `MapFileError` for parts that are missing or do not fit.
    """
    arrays = dict(archive.arrays)
    arrays |= _as_mapped(arrays)
    arrays |= {f'tracker_{name}': array for name, array in _as_tracked(arrays).items()}
    count = len(arrays['stamps_ns'])
    session = SavedSession('', camera, sensor, count, count)
    highest = arrays['tracker_ids'].max() if len(arrays['tracker_ids']) else -1
    return replace(
        archive,
        arrays=arrays,
        metadata={**archive.metadata, 'next_id': int(highest) + ID_MARGIN},
        blobs={**archive.blobs, SESSIONS_NAME: write_sessions([session])},
    )


def with_information(archive: Archive) -> Archive:
    """Return an archive of version 2 as one of the newest.

    It has the shares of a keyframe's matches with each host, which held all directions alike.
    Raises `MapFileError` for parts that are missing or do not fit.
    """
    arrays = dict(archive.arrays)
    shares, edges = arrays.pop('tracker_edge_shares', np.empty(0)), part(arrays, 'tracker_edges')
    covariances = part(arrays, 'tracker_covariances')
    check('tracker_edge_shares', shares, np.float64, (len(edges),))
    check('tracker_edges', edges, np.int32, (len(edges), 2))
    check('tracker_covariances', covariances, np.float64, (len(covariances), 6, 6))
    check_keyframes('tracker_edges', edges.ravel(), len(covariances), 'keyframes')
    with np.errstate(invalid='ignore', over='ignore'):
        whole = np.linalg.pinv(covariances, hermitian=True)[edges[:, 0]]
        arrays['tracker_edge_information'] = shares[:, None, None] * whole
    return replace(archive, arrays=arrays)


def _as_mapped(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return what newer versions have more of the mapper's Gaussians and views."""
    planes, hosts = part(arrays, 'splats'), part(arrays, 'hosts')
    tracked, poses = part(arrays, 'tracked'), part(arrays, 'poses')
    n, views = planes.size // _PLANES, part(arrays, 'stamps_ns').size
    check('splats', planes, np.float32, (_PLANES, n))
    check('hosts', hosts, np.int32, (n,))
    check('stamps_ns', part(arrays, 'stamps_ns'), np.int64, (views,))
    check('tracked', tracked, np.float64, (views, 4, 4))
    check('poses', poses, np.float64, (views, 4, 4))
    check_keyframes('hosts', hosts, views, 'keyframes')
    back = _motions(tracked, poses)[hosts]
    with np.errstate(invalid='ignore', over='ignore'):
        means = np.einsum('nij,jn->ni', back[:, :3, :3], planes[:3]) + back[:, :3, 3]
        means = means.astype(np.float32)
    return {
        'tracked_means': means,
        'reach_m': np.full(n, np.inf, np.float32),
        'weights': np.zeros(n, np.float32),
        'keyframe_numbers': np.arange(views, dtype=np.int32),
        'visits': np.zeros(views, np.int32),
    }


def _as_tracked(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the tracker's part: the Gaussians that were measured."""
    planes, ids, hosts = arrays['splats'], part(arrays, 'ids'), arrays['hosts']
    viewpoints, tracked = part(arrays, 'viewpoints'), arrays['tracked']
    n, views = planes.shape[1], len(tracked)
    check('ids', ids, np.int64, (n,))
    check('viewpoints', viewpoints, np.float32, (n, 3))
    lengths = np.linalg.norm(planes[6:10], axis=0)
    usable = (ids >= 0) & np.isfinite(viewpoints).all(axis=1) & np.isfinite(planes).all(axis=0)
    rows = np.flatnonzero(usable & (lengths > 0))
    rows = rows[np.argsort(ids[rows], kind='stable')]
    normals, flatness = normals_and_flatness(planes[3:6, rows], planes[6:10, rows])
    back = _motions(tracked, arrays['poses'])[hosts[rows]]
    with np.errstate(invalid='ignore', over='ignore'):
        normals = np.einsum('nij,nj->ni', back[:, :3, :3], normals).astype(np.float32)
    means, seen_from = arrays['tracked_means'][rows], viewpoints[rows]
    away = np.einsum('ij,ij->i', normals, means - seen_from) > 0
    normals[away] *= -1.0  # towards the viewpoint
    return {
        'ids': ids[rows], 'means': means, 'normals': normals,
        'flatness': flatness.astype(np.float32), 'viewpoints': seen_from, 'hosts': hosts[rows],
        'observers': hosts[rows], 'stamps_ns': arrays['stamps_ns'], 'poses': tracked,
        'submaps': np.zeros(views, np.int32), 'covariances': np.zeros((views, 6, 6)),
        'edges': np.empty((0, 2), np.int32), 'edge_poses': np.empty((0, 4, 4)),
        'edge_information': np.empty((0, 6, 6)), 'usual': np.array(astuple(Usual()), np.float64),
        'depth_bias': np.zeros(TERMS),
    }  # fmt: skip


def _motions(tracked: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (K, 4, 4), for each view, from the mapper's world to the tracker's."""
    with np.errstate(invalid='ignore', over='ignore'):
        pairs = zip(tracked, poses, strict=True)
        return np.array([T @ se3.inverse(P) for T, P in pairs]).reshape(-1, 4, 4)
