# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Makes the back end of a tracker node, if it is wanted."""

from __future__ import annotations

from collections.abc import Callable

from ...core.backend.back_end import BackEnd
from ...core.backend.warmup import warm_up
from ...core.config.stages import Config
from ...core.keyframe import Correction
from ...core.tracking.warmup import ANY_CAMERA
from .back_end_worker import BackEndWorker, NoLoops


def make_loops(
    config: Config, on_correction: Callable[[Correction, int], object], warn: Callable[[str], None]
) -> BackEndWorker | NoLoops:
    """Return the back end's thread, or its replacement; arguments as of `BackEndWorker`."""
    if not config.backend.loops:
        return NoLoops()
    return BackEndWorker(BackEnd, on_correction, warn)


def warm_up_loops(config: Config) -> None:
    """Load the kernels of the back end: compiling them later would hold up tracking."""
    if config.backend.loops:
        warm_up(ANY_CAMERA)
