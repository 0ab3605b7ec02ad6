# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Makes the back end of a tracker node, if it is wanted."""

from __future__ import annotations

from collections.abc import Callable

from ...core.camera import PinholeCamera
from ...core.config.stages import Config
from ...core.keyframe import Correction
from .back_end_worker import BackEnd, BackEndWorker, NoLoops


def make_loops(
    config: Config, on_correction: Callable[[Correction, int], object], warn: Callable[[str], None]
) -> BackEndWorker | NoLoops:
    """Return the back end's thread, or its replacement; arguments as of `BackEndWorker`."""
    if not config.backend.loops or not _is_there():
        return NoLoops()
    return BackEndWorker(make_back_end, on_correction, warn)


def make_back_end(camera: PinholeCamera, config: Config) -> BackEnd:
    """Return the back end of a new map."""
    from ...core.backend.back_end import BackEnd as Made  # type: ignore[import-not-found]

    made: BackEnd = Made(camera, config)
    return made


def _is_there() -> bool:
    try:
        from ...core.backend import back_end  # type: ignore[import-not-found]  # noqa: F401
    except ImportError:
        return False
    return True
