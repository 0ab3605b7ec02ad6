# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracker and mapper as a run wants them: in lockstep, online, or the tracker alone."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from ..core.camera import PinholeCamera
from ..core.config import Config
from ..core.frame import RgbdFrame
from ..core.mapper import Mapper
from ..core.render import make_renderer
from ..core.slam import Lockstep, Mapping, Online
from ..core.tracker import Tracker, TrackResult
from ..core.warmup import warm_up, warm_up_with_mapper
from ..core.workers import Workers, cores

_SLOW_S = 2.0  # a start that takes longer is explained


@dataclass(frozen=True)
class Slam:
    """What follows the frames."""

    tracker: Tracker
    mapping: Mapping
    mapper: Mapper | None  # None: the run only tracks
    online: bool  # the clock counts


class NoMapping:
    """A `Mapping` for runs that only track."""

    def after(self, frame: RgbdFrame, result: TrackResult) -> None:
        """Hand nothing over."""

    def advance(self) -> None:
        """Do nothing."""

    def finish(self) -> Iterator[int]:
        """Leave nothing to do."""
        return iter(())


def threads_of_mapper(config: Config, online: bool) -> int:
    """Count the mapper's threads: as configured, else all cores, by turns with the tracker.

    Online both work at once, and the tracker has a core for itself.
    """
    return config.threads or max(1, cores() - online)


def start(
    camera: PinholeCamera, config: Config, mapping: bool, online: bool, workers: Workers
) -> Slam:
    """Make them, with all their kernels compiled."""
    with _explained_if_slow('dcgs: compiling kernels (once)'):
        (warm_up_with_mapper if mapping else warm_up)(camera, config)
    tracker = Tracker(camera, config)
    if not mapping:
        return Slam(tracker, NoMapping(), None, online)
    mapper = Mapper(camera, config, make_renderer(workers), workers)
    return Slam(tracker, (Online if online else Lockstep)(tracker, mapper), mapper, online)


@contextmanager
def _explained_if_slow(text: str) -> Iterator[None]:
    timer = threading.Timer(_SLOW_S, print, (text,), {'file': sys.stderr, 'flush': True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
