# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A mapper that takes whatever keyframes come, and tells what changed; no ROS in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.config.stages import Config
from ...core.errors import DcgsError
from ...core.kernels.workers import Workers, cores
from ...core.keyframe import MapUpdate
from ...core.mapping.mapper import Mapper
from ...core.render import make_renderer
from ...core.render.renderer import Rendering
from ...io.map_archive import write_map
from ...io.ply import write_ply
from ...io.snapshot import saved_map
from ..tracking.keyframe_sender import KeyframePacket

_RATE_MEMORY_S = 5.0  # over which steps a second are counted


class Mapping:
    """One map after the other: the first usable keyframe of a new epoch begins a new one.

    All of it belongs to one thread.
    """

    def __init__(self, config: Config, say: Callable[[str], None]) -> None:
        """Wait for the first keyframe; `say` is told what a user should know."""
        self.config, self._say = config, say
        self._workers = Workers(config.threads or max(1, cores() - 1))
        self.mapper: Mapper | None = None
        self.epoch = 0
        self.stamps: set[int] = set()  # of the keyframes taken
        self.refused = 0
        self._rested = 0  # steps since the last keyframe
        self._counted, self._counted_s, self.steps_per_s = 0, time.monotonic(), 0.0

    def take(self, offer: KeyframePacket) -> MapUpdate | None:
        """Insert a keyframe; None where it is here already or cannot be used.

        Views without Gaussians do not tell whose they are: before the first keyframe they wait in
        vain.
        """
        stamp_ns = offer.keyframe.frame.stamp_ns
        begins = offer.epoch not in (0, self.epoch)
        mapper = self._another(offer) if begins else self.mapper
        if mapper is None or (stamp_ns in self.stamps and not begins):
            return None
        try:
            mapper.insert(offer.keyframe)
        except DcgsError as error:
            self.refused += 1
            self._say(f'keyframe refused: {error}')
            return None
        if begins:
            self._begin(mapper, offer.epoch)
        self.stamps.add(stamp_ns)
        self._rested = 0
        return mapper.update()

    def _another(self, offer: KeyframePacket) -> Mapper:
        renderer = make_renderer(self._workers)
        return Mapper(offer.camera, self.config, renderer, self._workers)

    def _begin(self, mapper: Mapper, epoch: int) -> None:
        if self.mapper is not None:
            self._say(f'the tracker began a new map: {len(self.mapper.table)} Gaussians are gone')
        self.reset()
        self.mapper, self.epoch = mapper, epoch

    def reset(self) -> None:
        """Drop the map; what keyframes the tracker has it may offer again."""
        self.mapper, self.epoch = None, 0
        self.stamps.clear()

    def reconfigure(self, config: Config) -> None:
        """Take other settings over, those that may change at run time."""
        self.config = config
        if self.mapper is not None:
            self.mapper.config = config

    def advance(self) -> bool:
        """Take an optimisation step, unless there is nothing to do: a map can be finished."""
        self._count()
        mapper = self.mapper
        if mapper is None or not mapper.views:
            return False
        if self._rested >= mapper.config.mapping.final_steps:
            return False
        mapper.step()
        self._rested += 1
        return True

    def _count(self) -> None:
        now = time.monotonic()
        if now - self._counted_s > _RATE_MEMORY_S:
            steps = self.mapper.steps if self.mapper is not None else 0
            self.steps_per_s = max(0, steps - self._counted) / (now - self._counted_s)
            self._counted, self._counted_s = steps, now

    def view(self, stamp_ns: int, T_tracked: NDArray[np.float64]) -> Rendering | None:
        """Render from where the tracker says the camera is; None without a map."""
        mapper = self.mapper
        if mapper is None or not mapper.views:
            return None
        return mapper.render(mapper.corrections().pose(stamp_ns, T_tracked))

    def save(self, folder: Path) -> str:
        """Write map.ply and map.dcgs into a new folder of `folder`; returns what was written.

        Raises a `DcgsError` where there is no map or it cannot be written.
        """
        if self.mapper is None or not len(self.mapper.table):
            raise DcgsError('there is no map yet')
        saved = saved_map(self.mapper, None)
        path = folder / f'map-{datetime.now():%Y%m%d-%H%M%S-%f}'
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise DcgsError(f'{path}: {error.strerror}') from error
        write_ply(path / 'map.ply', saved.splats)
        write_map(path / 'map.dcgs', saved)
        return f'{len(saved.splats)} Gaussians, {len(saved.keyframes)} keyframes in {path}'

    def close(self) -> None:
        """End the threads."""
        self._workers.close()
