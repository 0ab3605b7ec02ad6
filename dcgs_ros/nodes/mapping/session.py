# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A mapper that takes any keyframes that come, and returns what changed; no ROS in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.config.stages import Config
from ...core.errors import DcgsError
from ...core.kernels.workers import Workers
from ...core.keyframe import Correction, MapUpdate
from ...core.mapping.mapper import Mapper, mapper_threads
from ...core.render.renderer import Rendering
from ...io.map_archive import MapFileError, SavedMap, read_map, write_map
from ...io.ply import write_ply
from ...io.sessions import SavedSession
from ...io.snapshot import restore_mapper, saved_map
from ..health import Level, Verdict
from ..messages.ids import EPOCH, epoch_of_file, same_tracker, split_ids
from ..messages.packet import KeyframePacket

_RATE_WINDOW_S = 5.0  # over which steps per second are counted
_FOREIGN_S = 10.0  # that another tracker is spoken of after its last keyframe
_NO_TRACKER = 'no tracker runs in this namespace'
AUTOSAVE = 'autosave.dcgs'
AFTER_RESET = 'the map is empty; keyframes that the tracker keeps come again'
_STAYS = 'node.mode is localization: the map stays as it was loaded'
_CORRECTIONS = 4  # kept of maps that may still begin: the last one of each
_BEHIND = 8  # waiting keyframes that are worth a warning


class MappingSession:
    """One map after the other: the first usable keyframe of a new epoch begins a new one.

    While the tracker of the map lives, keyframes of other trackers are refused.

    All but `judge` and `figures` belongs to one thread.
    """

    def __init__(
        self,
        config: Config,
        warn: Callable[[str], None],
        trackers: Callable[[], int] = lambda: 1,
        localize_only: bool = False,
    ) -> None:
        """Wait for the first keyframe; `warn` gets the lines for the log.

        `trackers` returns how many trackers live. With `localize_only` the map of `load` stays as
        it is: keyframes are ignored.
        """
        self.config, self._warn = config, warn
        self._workers = Workers(mapper_threads(config, online=True))
        self.mapper: Mapper | None = None
        self.epoch = 0
        self.camera_frame = ''  # frame_id of the images, as last received
        self.stamps: set[int] = set()  # of the keyframes in the map
        self.refused = 0
        self.refusal = ''  # why the last keyframe could not be used
        self.foreign = 0  # keyframes of other trackers
        self._localize_only = localize_only
        self._before: tuple[SavedSession, ...] = ()  # sessions of the map that was loaded
        self._corrections: dict[int, Correction] = {}  # the last one by epoch
        self._trackers, self._foreign_s = trackers, -_FOREIGN_S
        self._received_s: float | None = None  # monotonic time of the last keyframe
        self._steps_since_keyframe = 0
        self._counted, self._counted_s, self.steps_per_s = 0, time.monotonic(), 0.0

    def insert(self, packet: KeyframePacket) -> MapUpdate | None:
        """Insert a keyframe or a view; return None where it is here already or is refused.

        Views of a map of which no keyframe has come are ignored.
        """
        if self._localize_only:
            return None
        begins = packet.epoch not in (0, self.epoch)
        mapper = self.mapper
        if begins and (not packet.carries_gaussians or self._holds_against(packet.epoch)):
            return None
        if begins:
            mapper = Mapper(packet.camera, self.config, workers=self._workers)
            if packet.epoch in self._corrections:  # its keyframes may be from before it
                mapper.correct(self._corrections[packet.epoch], others_stay=True)
        if mapper is None or (packet.stamp_ns in self.stamps and not begins):
            return None
        try:
            _check_camera(mapper, packet)
            mapper.insert(packet.posed)
        except DcgsError as error:
            self.refuse(error)
            return None
        if begins:
            self._begin(mapper, packet.epoch)
        self.stamps.add(packet.stamp_ns)
        self.camera_frame = packet.camera_frame
        self._received_s = time.monotonic()
        self._steps_since_keyframe, self.refusal = 0, ''
        return mapper.update()

    def correct(self, correction: Correction, epoch: int) -> bool:
        """Take the poses of all keyframes of a map; return whether the map of now has moved.

        Those of a map that has not begun are kept for it. A keyframe that they do not name was
        made after the correction.
        """
        self._corrections.pop(epoch, None)
        self._corrections[epoch] = correction
        if len(self._corrections) > _CORRECTIONS:
            del self._corrections[next(iter(self._corrections))]
        if self.mapper is None or epoch != self.epoch:
            return False
        moved = self.mapper.correct(correction, others_stay=True) > 0
        if moved:
            self._steps_since_keyframe = 0
        return moved

    def refuse(self, error: DcgsError) -> None:
        """Count a keyframe that cannot be used, and warn."""
        self.refused, self.refusal = self.refused + 1, str(error)
        self._warn(f'keyframe refused: {error}')

    def _holds_against(self, epoch: int) -> bool:
        """Return whether a new map is of another tracker while that of this map lives."""
        if self.mapper is None or same_tracker(epoch, self.epoch) or self._trackers() < 2:
            return False
        self.foreign, self._foreign_s = self.foreign + 1, time.monotonic()
        return True

    def _begin(self, mapper: Mapper, epoch: int) -> None:
        if self.mapper is not None:
            self._warn(f'the tracker began a new map: {len(self.mapper.table)} Gaussians are gone')
        self._drop()
        self.mapper, self.epoch = mapper, epoch

    def load(self, path: Path) -> str:
        """Go on in the map of a file; return its size in words.

        It is optimised no further until a keyframe comes. Raises a `DcgsError` for a file that is
        damaged or no map; the map is then as it was before.
        """
        saved, epoch = read_map(path), epoch_of_file(path)
        mapper = Mapper(saved.camera, self.config, workers=self._workers)
        restore_mapper(mapper, saved, epoch * EPOCH)
        self._drop()
        self.mapper, self.epoch, self._before = mapper, epoch, saved.sessions
        self.stamps.update(view.stamp_ns for view in mapper.views)
        self._steps_since_keyframe = self.config.mapping.final_steps
        return f'{len(saved.splats)} Gaussians, {len(saved.keyframes)} keyframes in {path}'

    def reset(self) -> str:
        """Drop the map, unless it only localises; return what comes of it."""
        if self._localize_only:
            return _STAYS
        self._drop()
        return AFTER_RESET

    def _drop(self) -> None:
        self.mapper, self.epoch, self._before = None, 0, ()
        self.stamps.clear()

    def reconfigure(self, config: Config) -> None:
        """Apply settings that may change at run time."""
        self.config = config
        if self.mapper is not None:
            self.mapper.config = config

    def advance(self) -> bool:
        """Take an optimisation step; return False where the map has had all its steps."""
        self._count()
        mapper = self.mapper
        if mapper is None or not mapper.views or self._localize_only:
            return False
        if self._steps_since_keyframe >= mapper.config.mapping.final_steps:
            return False
        mapper.step()
        self._steps_since_keyframe += 1
        return True

    def _count(self) -> None:
        now = time.monotonic()
        if now - self._counted_s > _RATE_WINDOW_S:
            steps = self.mapper.steps if self.mapper is not None else 0
            self.steps_per_s = max(0, steps - self._counted) / (now - self._counted_s)
            self._counted, self._counted_s = steps, now

    def render(self, stamp_ns: int, T_tracked: NDArray[np.float64]) -> Rendering | None:
        """Render from the tracker's camera pose (4, 4), corrected; return None without a map."""
        mapper = self.mapper
        if mapper is None or not mapper.views:
            return None
        return mapper.render(mapper.corrections().pose(stamp_ns, T_tracked))

    def save(self, folder: Path) -> str:
        """Write map.ply and map.dcgs into a new folder within `folder`; return what was written.

        Raises a `DcgsError` where there is no map or it cannot be written.
        """
        saved = self._saved()
        path = folder / f'map-{datetime.now():%Y%m%d-%H%M%S-%f}'
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise DcgsError(f'{path}: {error.strerror}') from error
        write_ply(path / 'map.ply', saved.splats)
        write_map(path / 'map.dcgs', saved)
        return f'{len(saved.splats)} Gaussians, {len(saved.keyframes)} keyframes in {path}'

    def autosave(self, folder: Path) -> None:
        """Write autosave.dcgs in `folder`, in place of the last one.

        Raises a `DcgsError` where it cannot be written: the last one stays.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DcgsError(f'{folder}: {error.strerror}') from error
        write_map(folder / AUTOSAVE, self._saved())

    def _saved(self) -> SavedMap:
        """Return the map to be saved; raises `DcgsError` where there is none."""
        if self.mapper is None or not len(self.mapper.table):
            raise DcgsError('there is no map yet')
        first_id = int(split_ids(self.mapper.table.ids)[0].max()) * EPOCH
        return saved_map(self.mapper, None, self.camera_frame, self._before, first_id)

    def judge(self, waiting: int) -> Verdict:
        """Return how mapping goes while so many keyframes wait."""
        if self.mapper is None or self._received_s is None:
            what = 'is the tracker running and tracking?' if self._trackers() else _NO_TRACKER
            text = f'no keyframes yet: {what}'
            return Verdict(Level.WARN, text)
        if time.monotonic() - self._foreign_s < _FOREIGN_S:
            text = f'another tracker speaks: its keyframes, {self.foreign} so far, are refused'
            return Verdict(Level.WARN, f'{text}; stop it, or give each robot its own namespace')
        if self.refusal:
            return Verdict(Level.WARN, f'keyframe refused: {self.refusal}', logged=True)
        if waiting > _BEHIND:
            return Verdict(Level.WARN, f'{waiting} keyframes wait: the mapper is behind')
        return Verdict(Level.OK, 'mapping')

    def figures(self) -> dict[str, Any]:
        """Return what diagnostics show of mapping."""
        shown: dict[str, Any] = {
            'refused': self.refused, 'foreign': self.foreign, 'steps_per_s': self.steps_per_s,
        }  # fmt: skip
        mapper = self.mapper
        if mapper is not None:
            shown |= {
                'gaussians': len(mapper.table),
                'keyframes': len(mapper.views),
                'steps': mapper.steps,
                'revision': mapper.revision,
                'poisoned': mapper.poisoned,
            }
        if self._received_s is not None:
            shown['s_since_keyframe'] = time.monotonic() - self._received_s
        return shown

    def close(self) -> None:
        """End the threads."""
        self._workers.close()


def _check_camera(mapper: Mapper, packet: KeyframePacket) -> None:
    """Raise `MapFileError` where a keyframe is of another camera than the map's views."""
    ours, camera = mapper.camera, packet.camera
    if camera != ours:
        raise MapFileError(
            f'it is of a camera of {camera.width}x{camera.height}, fx {camera.fx:g}, the map of '
            f'one of {ours.width}x{ours.height}, fx {ours.fx:g}: this map cannot be extended'
        )
