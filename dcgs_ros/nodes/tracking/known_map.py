# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A map file that a tracker goes on in, and where it saves its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Protocol

from ...core.backend.features import Features
from ...core.camera import PinholeCamera
from ...core.errors import DcgsError
from ...core.tracking.tracker import Tracker
from ...io.known_places import KnownView, features_of, keyframes_of, places_of
from ...io.saved_tracker import SavedTracker
from ...io.sessions import SavedSession
from ...io.tracker_map import read_tracker_map, write_tracker_map
from ..messages.ids import EPOCH, epoch_of_file
from .back_end_worker import KnownKeyframes
from .map_mirror import Resumable


class Known(Protocol):
    """A map that a tracker can go on in."""

    @property
    def epoch(self) -> int:
        """Its number, as in ids."""
        ...

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        """The stamps of its keyframes."""
        ...

    def resume(self, tracker: Tracker) -> None:
        """Have a tracker that has tracked nothing yet go on in it."""
        ...

    def keyframes(self, tracker: Tracker) -> KnownKeyframes:
        """Return the keyframes for the back end of a tracker that goes on in it."""
        ...

    def without_images(self) -> Known:
        """Return the same without what only `keyframes` needs."""
        ...


@dataclass(frozen=True)
class KnownMap:
    """The tracker's part of a map file."""

    epoch: int
    camera: PinholeCamera  # that it was made with
    tracker: SavedTracker
    sessions: tuple[SavedSession, ...]
    features: tuple[tuple[int, Features], ...]  # of the keyframes that have images
    views: tuple[KnownView, ...] = ()

    @classmethod
    def read(cls, path: Path) -> KnownMap:
        """Read a file; raises a `DcgsError` that says what is wrong with it."""
        known = read_tracker_map(path)
        features = features_of(known.views, known.camera, known.sensor)
        return cls(
            epoch_of_file(path), known.camera, known.tracker, known.sessions, tuple(features),
            known.views,
        )  # fmt: skip

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        """The stamps of the keyframes."""
        return tuple(self.tracker.stamps_ns.tolist())

    def resume(self, tracker: Tracker) -> None:
        """Have a tracker that has tracked nothing yet go on in the map."""
        self.tracker.resume(tracker, self.camera)
        tracker.recogniser = places_of(self.features, tracker.camera, tracker.config)

    def keyframes(self, tracker: Tracker) -> KnownKeyframes:
        """Return the keyframes for the back end of a tracker that goes on in the map."""
        saved, undistorted = self.tracker, replace(self.camera, distortion=())
        return KnownKeyframes(
            self.stamps_ns, saved.poses, saved.submaps.tolist(),
            keyframes_of(self.views, saved), undistorted, tracker.recogniser,
            dict(self.features),
        )  # fmt: skip

    def without_images(self) -> KnownMap:
        """Return the same without the images, which take some 0.2 MB a keyframe."""
        return replace(self, views=())

    def __str__(self) -> str:
        """Return its size in words."""
        return f'{len(self.tracker.ids)} Gaussians, {len(self.tracker.poses)} keyframes'


def preferred(found: Resumable | None, known: KnownMap | None) -> Resumable | KnownMap | None:
    """Return the map to go on in: that of a living mapper, unless it is the file's and no newer.

    The file tells more of it: viewpoints, sub-maps, and which views are keyframes.
    """
    if found is None or known is None:
        return found or known
    newest = int(found.rows['id'].max()) - found.epoch * EPOCH
    same = found.epoch == known.epoch and newest < known.tracker.next_id
    return known if same else found


def save(tracker: Tracker | None, folder: Path, before: tuple[SavedSession, ...]) -> str:
    """Write a tracker's map into a new folder within `folder`; return what was written.

    Raises a `DcgsError` where there is no map or it cannot be written.
    """
    if tracker is None or not tracker.keyframes:
        raise DcgsError('there is no map yet')
    path = folder / f'map-{datetime.now():%Y%m%d-%H%M%S-%f}'
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise DcgsError(f'{path}: {error.strerror}') from error
    saved = write_tracker_map(path / 'map.dcgs', tracker, 'tracker', before)
    return f'{len(saved.ids)} Gaussians, {len(saved.poses)} keyframes in {path}'
