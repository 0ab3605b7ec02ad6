# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Taking a map from a running tracker and mapper, to be saved, and putting it back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, replace

import numpy as np
from numpy.typing import NDArray

from ..core.camera import PinholeCamera
from ..core.mapping.exposure import Exposure
from ..core.mapping.mapper import Mapper
from ..core.mapping.splats import Splats
from ..core.mapping.views import KeyframeView
from ..core.tracking.depth_bias import TERMS
from ..core.tracking.tracker import Tracker
from ..core.tracking.verification import Usual
from .known_places import extracted
from .map_archive import MapFileError, SavedKeyframe, SavedMap
from .saved_tracker import ID_MARGIN, SavedTracker
from .sessions import SavedSession, extended

_AGREEING_VIEWS = 5  # that tell how well frames usually agree with a map
_ROWS, _COLUMNS = np.triu_indices(3)  # xx xy xz yy yz zz


def saved_map(
    mapper: Mapper,
    tracker: Tracker | None,
    name: str = '',
    before: Sequence[SavedSession] = (),
    first_id: int = 0,
) -> SavedMap:
    """Return the map after a last pruning, so that all of it is finite.

    Without the tracker, which may be another process, what it has is derived from the mapper:
    Sigma_t is that of the host keyframes, and there are no landmarks. `name` is that of this
    session, which follows those `before`. `first_id` is subtracted from the tracker's ids.
    """
    mapper.prune()
    table = mapper.table
    ids = np.where(table.ids < 0, table.ids, table.ids - first_id)
    numbers = _keyframe_numbers(mapper, tracker)
    if tracker is None:
        viewpoints, covariances = as_hosts_saw(mapper)
        landmarks, landmark_covariances = np.empty((0, 3)), np.empty((0, 3, 3))
        known = _with_usual(_tracker_of(mapper, ids, numbers, viewpoints), mapper)
    else:
        viewpoints, covariances = _as_tracked(table.ids, tracker)
        landmarks = tracker.landmarks.targets.points.astype(np.float64)
        landmark_covariances = tracker.landmarks.targets.covariances
        known = SavedTracker.of(tracker)
    now = SavedSession(name, mapper.camera, mapper.config.sensor, 0, 0)
    return SavedMap(
        camera=mapper.camera,
        config=mapper.config,
        splats=Splats(np.ascontiguousarray(table.splats.planes)),
        ids=ids,
        hosts=table.hosts.copy(),
        tracked_means=np.ascontiguousarray(table.measured.T),
        reach_m=table.reach_m.copy(),
        weights=table.weights.copy(),
        viewpoints=viewpoints,
        track_covariances=covariances,
        landmarks=landmarks,
        landmark_covariances=landmark_covariances,
        keyframes=tuple(
            _saved_keyframe(view, number, mapper)
            for view, number in zip(mapper.views, numbers.tolist(), strict=True)
        ),
        tracker=known,
        sessions=extended(before, now, len(known.poses), len(mapper.views)),
    )


def restore_mapper(mapper: Mapper, saved: SavedMap, first_id: int = 0) -> None:
    """Fill an empty mapper with a saved map; `first_id` is added to the tracker's ids.

    Raises `MapFileError` where its views are of another camera.
    """
    check_camera(saved, mapper.camera)
    views = [
        KeyframeView.restored(
            index, known.stamp_ns, (known.T_tracked, known.T_world_cam),
            Exposure(*known.exposure.copy()), known.visits, known.keyframe,
            (known.color_jpeg, known.depth_png), known.features,
        )
        for index, known in enumerate(saved.keyframes)
    ]  # fmt: skip
    ids = np.where(saved.ids < 0, saved.ids, saved.ids + first_id)
    mapper.restore(
        saved.splats, ids, saved.hosts, saved.tracked_means, saved.reach_m, saved.weights, views,
        saved.tracker.submaps.tolist(),
    )  # fmt: skip


def check_camera(saved: SavedMap, camera: PinholeCamera) -> None:
    """Raise `MapFileError` unless a map is of this camera, whose views it can be joined by."""
    if camera != saved.camera:
        raise MapFileError(
            f'the map is of another camera: {_described(saved.camera)}, not '
            f'{_described(camera)}; it cannot be extended, but the camera can be localised in it'
        )


def _described(camera: PinholeCamera) -> str:
    lens = ' '.join(f'{k:g}' for k in camera.distortion)
    return (
        f'{camera.width}x{camera.height}, fx {camera.fx:g} fy {camera.fy:g} cx {camera.cx:g} '
        f'cy {camera.cy:g}, ' + (f'distortion {lens}' if lens else 'no distortion')
    )


def _keyframe_numbers(mapper: Mapper, tracker: Tracker | None) -> NDArray[np.int32]:
    """Return the tracker's number (V,) of each view; -1 for those between keyframes.

    Without a tracker, all views with Gaussians of it are numbered in their order.
    """
    numbers = np.array([view.keyframe for view in mapper.views], np.int32)
    if tracker is not None:
        return numbers
    table, is_keyframe = mapper.table, numbers >= 0
    is_keyframe[table.hosts[table.ids >= 0]] = True
    return np.where(is_keyframe, np.cumsum(is_keyframe) - 1, -1).astype(np.int32)


def _tracker_of(
    mapper: Mapper,
    ids: NDArray[np.int64],
    numbers: NDArray[np.int32],
    viewpoints: NDArray[np.float32],
) -> SavedTracker:
    """Return the tracker's part as far as the mapper knows it."""
    table = mapper.table
    rows = np.flatnonzero((ids >= 0) & np.isfinite(viewpoints).all(axis=1))
    rows = rows[np.argsort(ids[rows])]
    hosts = table.hosts[rows]
    normals, flatness = table.splats.shape(rows)
    turns = [v.T_tracked[:3, :3] @ v.T_world_cam[:3, :3].T for v in mapper.views]
    normals = np.einsum('nij,nj->ni', np.array(turns).reshape(-1, 3, 3)[hosts], normals)
    means = np.ascontiguousarray(table.measured[:, rows].T)
    normals[np.einsum('ij,ij->i', normals, means - viewpoints[rows]) > 0] *= -1.0  # towards it
    keyframes = [view for view, n in zip(mapper.views, numbers, strict=True) if n >= 0]
    count = len(keyframes)
    return SavedTracker(
        ids[rows], means, normals.astype(np.float32), flatness.astype(np.float32),
        viewpoints[rows], numbers[hosts], numbers[hosts],
        int(ids.max(initial=-1)) + ID_MARGIN,
        np.array([view.stamp_ns for view in keyframes], np.int64),
        np.array([view.T_tracked for view in keyframes]).reshape(-1, 4, 4),
        np.array(mapper.submaps, np.int32)[numbers >= 0], np.zeros((count, 6, 6)),
        np.empty((0, 2), np.int32), np.empty((0, 4, 4)), np.empty((0, 6, 6)),
        np.array(astuple(Usual()), np.float64), np.zeros(TERMS),
    )  # fmt: skip


def _with_usual(known: SavedTracker, mapper: Mapper) -> SavedTracker:
    """Return the tracker's part with how well its newest keyframes agree with it."""
    gaussians, config = known.gaussians(mapper.config), mapper.config
    undistorted = replace(mapper.camera, distortion=())
    newest = [view for view in mapper.views if view.active][-_AGREEING_VIEWS:]
    agreements = [
        gaussians.agreement(view.T_tracked, view.images.depth_m, undistorted, config.sensor)
        for view in newest
    ]
    if not agreements:
        return known
    usual = Usual(agreement=float(np.mean(agreements)))
    return replace(known, usual=np.array(astuple(usual), np.float64))


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


def _saved_keyframe(view: KeyframeView, keyframe: int, mapper: Mapper) -> SavedKeyframe:
    """Return a view with the features that its images have once they are encoded."""
    color_jpeg, depth_png = view.encoded
    if keyframe >= 0 and view.features is None:
        view.features = extracted(color_jpeg, depth_png, mapper.camera, mapper.config.sensor)
    return SavedKeyframe(
        stamp_ns=view.stamp_ns,
        T_world_cam=view.T_world_cam,
        T_tracked=view.T_tracked,
        exposure=np.stack([view.exposure.gain, view.exposure.offset]),
        color_jpeg=color_jpeg,
        depth_png=depth_png,
        keyframe=keyframe,
        visits=view.visits,
        features=view.features,
    )
