# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Taking a map from a running tracker and mapper, to be saved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.mapping.mapper import Mapper
from ..core.mapping.splats import Splats
from ..core.mapping.views import KeyframeView
from ..core.tracking.tracker import Tracker
from .map_archive import SavedKeyframe, SavedMap

_ROWS, _COLUMNS = np.triu_indices(3)  # xx xy xz yy yz zz


def saved_map(mapper: Mapper, tracker: Tracker | None) -> SavedMap:
    """Return the map after a last pruning, so that all of it is finite.

    Without the tracker, which may be another process, Sigma_t is that of the host keyframes, and
    there are no landmarks.
    """
    mapper.prune()
    table = mapper.table
    if tracker is None:
        viewpoints, covariances = as_hosts_saw(mapper)
        landmarks, landmark_covariances = np.empty((0, 3)), np.empty((0, 3, 3))
    else:
        viewpoints, covariances = _as_tracked(table.ids, tracker)
        landmarks = tracker.landmarks.targets.points.astype(np.float64)
        landmark_covariances = tracker.landmarks.targets.covariances
    return SavedMap(
        camera=mapper.camera,
        config=mapper.config,
        splats=Splats(np.ascontiguousarray(table.splats.planes)),
        ids=table.ids.copy(),
        hosts=table.hosts.copy(),
        viewpoints=viewpoints,
        track_covariances=covariances,
        landmarks=landmarks,
        landmark_covariances=landmark_covariances,
        keyframes=tuple(_saved_keyframe(view) for view in mapper.views),
    )


def as_hosts_saw(mapper: Mapper) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return viewpoints (N, 3) and Sigma_t (N, 6), metres, seen from the host keyframes.

    NaN for Gaussians that the mapper spawned, which were not measured, and for those whose Sigma_t
    is not finite in float32: at the viewpoint itself, or too far away.
    """
    table, config = mapper.table, mapper.config
    rows = np.flatnonzero(table.ids >= 0)
    centres = np.array([view.T_tracked[:3, 3] for view in mapper.views]).reshape(-1, 3)
    viewpoints = np.full((len(table), 3), np.nan, np.float32)
    covariances = np.full((len(table), 6), np.nan, np.float32)
    viewpoints[rows] = centres[table.hosts[rows]]
    rays = table.measured[:, rows].T - centres[table.hosts[rows]]
    ranges = np.linalg.norm(rays, axis=1)
    with np.errstate(invalid='ignore', over='ignore'):
        Sigma_t = config.sensor.covariance(
            rays / ranges[:, None], ranges, config.registration.anchor_px, mapper.camera.focal
        )
        covariances[rows] = Sigma_t[:, _ROWS, _COLUMNS]
    unknown = ~np.isfinite(covariances).all(axis=1)
    viewpoints[unknown] = covariances[unknown] = np.nan
    return viewpoints, covariances


def _as_tracked(
    ids: NDArray[np.int64], tracker: Tracker
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return viewpoints (N, 3) and Sigma_t (N, 6) by id; NaN for those the tracker has not."""
    gaussians, config = tracker.gaussians, tracker.config
    order = np.argsort(gaussians.ids)
    rows = np.flatnonzero(gaussians.alive(ids))
    found = np.searchsorted(gaussians.ids, ids[rows], sorter=order)
    slots = order[found].astype(np.int32)
    viewpoints = np.full((len(ids), 3), np.nan, np.float32)
    covariances = np.full((len(ids), 6), np.nan, np.float32)
    viewpoints[rows] = gaussians.viewpoints[slots]
    Sigma_t = gaussians.tracking_covariances(
        slots, config.sensor, config.registration.anchor_px, tracker.camera.focal
    )
    covariances[rows] = Sigma_t[:, _ROWS, _COLUMNS]
    return viewpoints, covariances


def _saved_keyframe(view: KeyframeView) -> SavedKeyframe:
    color_jpeg, depth_png = view.encoded
    return SavedKeyframe(
        stamp_ns=view.stamp_ns,
        T_world_cam=view.T_world_cam,
        T_tracked=view.T_tracked,
        exposure=np.stack([view.exposure.gain, view.exposure.offset]),
        color_jpeg=color_jpeg,
        depth_png=depth_png,
    )
