# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A whole map in one archive: what tracker and mapper need to resume, or to localise in it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.backend.features import Features
from ..core.camera import PinholeCamera
from ..core.config.schema import flatten
from ..core.config.stages import Config
from ..core.errors import DcgsError
from ..core.mapping.splats import Splats
from .archive import VERSION, Archive, ArchiveError, read_archive, write_archive
from .map_parts import MapFileError as MapFileError
from .map_parts import check, check_finite, check_keyframes, check_unique, part, read_camera
from .saved_features import from_parts as features_from_parts
from .saved_features import parts_of as parts_of_features
from .saved_tracker import SavedTracker
from .sessions import SESSIONS_NAME, SavedSession, read_sessions, write_sessions
from .tracker_map import color_name, depth_name, read_settings, up_to_date

# Fields of `SavedMap` that are arrays of the same name in the file.
_ARRAYS = (
    'ids', 'hosts', 'tracked_means', 'reach_m', 'weights', 'viewpoints', 'track_covariances',
    'landmarks', 'landmark_covariances',
)  # fmt: skip


@dataclass(frozen=True)
class SavedKeyframe:
    """One view of the mapper, a keyframe or between two, its images encoded as JPEG and PNG.

    The images are without distortion; both are empty where the mapper dropped them.
    """

    stamp_ns: int  # of the colour image
    T_tracked: NDArray[np.float64]  # (4, 4) T_world_cam of the tracker
    T_world_cam: NDArray[np.float64]  # (4, 4) of the mapper
    exposure: NDArray[np.float32]  # (2, 3) gain and offset of red, green, blue
    color_jpeg: bytes
    depth_png: bytes
    keyframe: int = -1  # the tracker's number of it; -1 for a view between keyframes
    visits: int = 0  # optimisation steps so far
    features: Features | None = None  # of a keyframe; None in a file from before they were kept

    def __post_init__(self) -> None:
        """Check shapes, types and finiteness."""
        if not -(2**63) <= self.stamp_ns < 2**63:
            raise MapFileError(f'stamp {self.stamp_ns} ns of a keyframe does not fit 64 bits')
        check('T_tracked', self.T_tracked, np.float64, (4, 4))
        check('T_world_cam', self.T_world_cam, np.float64, (4, 4))
        check('exposure', self.exposure, np.float32, (2, 3))
        for name in ('T_tracked', 'T_world_cam', 'exposure'):
            if not np.isfinite(getattr(self, name)).all():
                raise MapFileError(f'{name} of the keyframe at {self.stamp_ns} ns is not finite')


@dataclass(frozen=True)
class SavedMap:
    """N Gaussians with both covariances, L landmarks, and the mapper's views.

    What the tracker has of its own is in `tracker`, with its own Gaussians and keyframes.
    """

    camera: PinholeCamera
    config: Config
    splats: Splats
    ids: NDArray[np.int64]  # (N,) negative for those that the mapper spawned
    hosts: NDArray[np.int32]  # (N,) index in `keyframes` of the view that spawned each
    tracked_means: NDArray[np.float32]  # (N, 3) when they were spawned, in the tracker's world
    reach_m: NDArray[np.float32]  # (N,) that the mapper may move a mean; infinity: any
    weights: NDArray[np.float32]  # (N,) largest sum of blending weights in one image, pixels
    # (N, 3) optical centre of the last observation, metres, world, which gives Sigma_t. NaN for
    # Gaussians that the tracker does not have, or no longer has.
    viewpoints: NDArray[np.float32]
    # (N, 6) Sigma_t: xx xy xz yy yz zz, square metres, world. NaN for the same Gaussians.
    track_covariances: NDArray[np.float32]
    landmarks: NDArray[np.float64]  # (L, 3) metres, world
    landmark_covariances: NDArray[np.float64]  # (L, 3, 3) square metres, world
    keyframes: tuple[SavedKeyframe, ...]
    tracker: SavedTracker
    sessions: tuple[SavedSession, ...]
    version: int = VERSION  # of the file that it was read from

    def __post_init__(self) -> None:
        """Check that the parts fit each other; raises `MapFileError` naming one that does not."""
        n, landmarks = len(self.splats), self.landmarks.size // 3
        check('ids', self.ids, np.int64, (n,))
        check('hosts', self.hosts, np.int32, (n,))
        check('tracked_means', self.tracked_means, np.float32, (n, 3))
        check('reach_m', self.reach_m, np.float32, (n,))
        check('weights', self.weights, np.float32, (n,))
        check('viewpoints', self.viewpoints, np.float32, (n, 3))
        check('track_covariances', self.track_covariances, np.float32, (n, 6))
        check('landmarks', self.landmarks, np.float64, (landmarks, 3))
        check('landmark_covariances', self.landmark_covariances, np.float64, (landmarks, 3, 3))
        self._check_references()
        self._check_numbers()

    def _check_references(self) -> None:
        check_unique(self.ids)
        check_keyframes('hosts', self.hosts, len(self.keyframes), 'keyframes')
        numbers, known = [k.keyframe for k in self.keyframes], len(self.tracker.poses)
        if max(numbers, default=-1) >= known:
            raise MapFileError(f'keyframe {max(numbers)} is none of the {known} of the tracker')
        for what, there in (('keyframes', known), ('views', len(numbers))):
            counted = sum(getattr(session, what) for session in self.sessions)
            if counted != there:
                raise MapFileError(f'sessions have {counted} {what}, the map {there}')

    def _check_numbers(self) -> None:
        check_finite('splats', self.splats.planes.T)
        check_finite('tracked_means', self.tracked_means)
        check_finite('weights', self.weights)
        if np.isnan(self.reach_m).any():
            raise MapFileError('reach_m: some are no numbers')
        check_finite('landmarks', self.landmarks)
        check_finite('landmark_covariances', self.landmark_covariances)
        measured = self.measured
        check_finite('viewpoints', self.viewpoints[measured])
        check_finite('track_covariances', self.track_covariances[measured])
        own = np.count_nonzero(measured & (self.ids < 0))
        if own:
            raise MapFileError(f'{own} Gaussians that the mapper spawned have viewpoints')

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which Gaussians (N,) the tracker has, with a tracking covariance."""
        missing = np.isnan(self.viewpoints).all(axis=1) & np.isnan(self.track_covariances).all(
            axis=1
        )
        return np.asarray(~missing)


def write_map(path: Path | str, saved: SavedMap) -> None:
    """Write a map; the file is written completely or not at all.

    Raises `MapFileError` if it cannot be written.
    """
    keyframes = saved.keyframes
    arrays: dict[str, NDArray[Any]] = {'splats': saved.splats.planes}
    arrays |= {name: getattr(saved, name) for name in _ARRAYS}
    arrays['stamps_ns'] = np.array([k.stamp_ns for k in keyframes], np.int64)
    arrays['tracked'] = np.array([k.T_tracked for k in keyframes]).reshape(-1, 4, 4)
    arrays['poses'] = np.array([k.T_world_cam for k in keyframes]).reshape(-1, 4, 4)
    arrays['keyframe_numbers'] = np.array([k.keyframe for k in keyframes], np.int32)
    arrays['visits'] = np.array([k.visits for k in keyframes], np.int32)
    arrays['exposures'] = np.array([k.exposure for k in keyframes], np.float32).reshape(-1, 2, 3)
    arrays |= saved.tracker.parts
    arrays |= parts_of_features([k.features for k in keyframes])
    blobs = {SESSIONS_NAME: write_sessions(saved.sessions)}
    for index, keyframe in enumerate(keyframes):
        blobs[color_name(index)] = keyframe.color_jpeg
        blobs[depth_name(index)] = keyframe.depth_png
    metadata = {
        'camera': dataclasses.asdict(saved.camera),
        'config': flatten(saved.config),
        'next_id': saved.tracker.next_id,
    }
    try:
        write_archive(path, arrays, metadata, blobs)
    except ArchiveError as error:
        raise MapFileError(str(error)) from error


def read_map(path: Path | str) -> SavedMap:
    """Read a map exactly as it was written.

    Settings that the file does not have get their defaults, and what files of version 1 lack is
    made up from the rest. Raises `MapFileError` naming the file
    and what is wrong with it: not an archive, a part that is missing or does not fit the others, a
    setting that does not exist, numbers that are not finite.
    """
    try:
        return _assemble(read_archive(path))
    except ArchiveError as error:
        raise MapFileError(str(error)) from error
    except DcgsError as error:
        raise MapFileError(f'{path}: {error}') from error


def _assemble(archive: Archive) -> SavedMap:
    version, archive = archive.version, up_to_date(archive)
    return SavedMap(
        camera=read_camera(part(archive.metadata, 'camera')),
        config=read_settings(archive),
        splats=Splats(part(archive.arrays, 'splats')),
        keyframes=_keyframes(archive),
        tracker=SavedTracker.from_parts(archive.arrays, part(archive.metadata, 'next_id')),
        sessions=read_sessions(part(archive.blobs, SESSIONS_NAME)),
        version=version,
        **{name: part(archive.arrays, name) for name in _ARRAYS},
    )


def _keyframes(archive: Archive) -> tuple[SavedKeyframe, ...]:
    stamps, tracked, poses, exposures, numbers, visits = (
        part(archive.arrays, name)
        for name in ('stamps_ns', 'tracked', 'poses', 'exposures', 'keyframe_numbers', 'visits')
    )
    n = stamps.size
    check('stamps_ns', stamps, np.int64, (n,))
    check('tracked', tracked, np.float64, (n, 4, 4))
    check('poses', poses, np.float64, (n, 4, 4))
    check('exposures', exposures, np.float32, (n, 2, 3))
    check('keyframe_numbers', numbers, np.int32, (n,))
    check('visits', visits, np.int32, (n,))
    features = features_from_parts(archive.arrays, n)
    return tuple(
        SavedKeyframe(
            int(stamps[k]), tracked[k], poses[k], exposures[k],
            part(archive.blobs, color_name(k)), part(archive.blobs, depth_name(k)),
            int(numbers[k]), int(visits[k]), features[k],
        )
        for k in range(n)
    )  # fmt: skip
