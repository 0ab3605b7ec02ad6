# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Map files for a tracker alone: nothing of the mapper is imported here."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.camera import PinholeCamera
from ..core.config.schema import flatten, override
from ..core.config.stages import Config
from ..core.errors import DcgsError
from ..core.sensor import SensorNoise
from ..core.tracking.tracker import Tracker
from .archive import Archive, ArchiveError, read_archive, write_archive
from .known_places import KnownView
from .map_parts import MapFileError, part, read_camera
from .older_maps import with_information, with_tracker
from .saved_features import from_parts
from .saved_tracker import SavedTracker
from .sessions import SESSIONS_NAME, SavedSession, extended, read_sessions, write_sessions

# Of a map without a mapper's Gaussians and views.
_REMOVED = {'landmarks.min_start'}  # settings that older files have
_EMPTY: dict[str, NDArray[Any]] = {
    'splats': np.empty((14, 0), np.float32),
    'ids': np.empty(0, np.int64),
    'hosts': np.empty(0, np.int32),
    'tracked_means': np.empty((0, 3), np.float32),
    'reach_m': np.empty(0, np.float32),
    'weights': np.empty(0, np.float32),
    'viewpoints': np.empty((0, 3), np.float32),
    'track_covariances': np.empty((0, 6), np.float32),
    'landmarks': np.empty((0, 3)),
    'landmark_covariances': np.empty((0, 3, 3)),
    'stamps_ns': np.empty(0, np.int64),
    'tracked': np.empty((0, 4, 4)),
    'poses': np.empty((0, 4, 4)),
    'keyframe_numbers': np.empty(0, np.int32),
    'visits': np.empty(0, np.int32),
    'exposures': np.empty((0, 2, 3), np.float32),
}


@dataclass(frozen=True)
class TrackerMap:
    """What a tracker needs of a map file."""

    camera: PinholeCamera
    tracker: SavedTracker
    sessions: tuple[SavedSession, ...]
    sensor: SensorNoise  # of the last session
    views: tuple[KnownView, ...]  # the keyframes among the mapper's


def write_tracker_map(
    path: Path | str, tracker: Tracker, name: str, before: tuple[SavedSession, ...] = ()
) -> SavedTracker:
    """Write what a tracker has as a map in which a camera can be localised; return it.

    `name` is that of this session, which follows those `before`. A mapper that extends this map
    begins with an empty one of its own. Raises `MapFileError` if it cannot be written.
    """
    known, camera = SavedTracker.of(tracker), tracker.camera
    before = tuple(dataclasses.replace(session, views=0) for session in before)
    now = SavedSession(name, camera, tracker.config.sensor, 0, 0)
    sessions = extended(before, now, len(known.poses), 0)
    metadata = {
        'camera': dataclasses.asdict(camera),
        'config': flatten(tracker.config),
        'next_id': known.next_id,
    }
    blobs = {SESSIONS_NAME: write_sessions(sessions)}
    try:
        write_archive(path, _EMPTY | known.parts, metadata, blobs)
    except ArchiveError as error:
        raise MapFileError(str(error)) from error
    return known


def read_tracker_map(path: Path | str) -> TrackerMap:
    """Read the tracker's part of a map file; raises `MapFileError` as `read_map` does."""
    try:
        archive = up_to_date(read_archive(path))
        return TrackerMap(
            read_camera(part(archive.metadata, 'camera')),
            SavedTracker.from_parts(archive.arrays, part(archive.metadata, 'next_id')),
            read_sessions(part(archive.blobs, SESSIONS_NAME)),
            read_settings(archive).sensor,
            tuple(_views(archive)),
        )
    except ArchiveError as error:
        raise MapFileError(str(error)) from error
    except DcgsError as error:
        raise MapFileError(f'{path}: {error}') from error


def _views(archive: Archive) -> Iterator[KnownView]:
    numbers = part(archive.arrays, 'keyframe_numbers').ravel().tolist()
    features = from_parts(archive.arrays, len(numbers))
    for view, keyframe in enumerate(numbers):
        if keyframe >= 0:
            names = color_name(view), depth_name(view)
            color, depth = (part(archive.blobs, name) for name in names)
            yield KnownView(keyframe, color, depth, features[view])


def color_name(view: int) -> str:
    """Return the name of the colour image of one of the mapper's views."""
    return f'color_{view:06d}.jpg'


def depth_name(view: int) -> str:
    """Return the name of the depth image of one of the mapper's views."""
    return f'depth_{view:06d}.png'


def read_settings(archive: Archive) -> Config:
    """Return the settings of an archive; raises a `DcgsError`."""
    config = part(archive.metadata, 'config')
    if not isinstance(config, dict):
        raise MapFileError(f'config is a {type(config).__name__}, not settings')
    return override(Config(), {key: config[key] for key in config if key not in _REMOVED})


def up_to_date(archive: Archive) -> Archive:
    """Return an archive of any version as one of the newest; raises a `DcgsError`."""
    if archive.version == 1:
        camera = read_camera(part(archive.metadata, 'camera'))
        return with_tracker(archive, camera, read_settings(archive).sensor)
    return with_information(archive) if archive.version == 2 else archive
