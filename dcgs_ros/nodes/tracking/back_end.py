# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Makes the back end of a tracker node, if it is wanted."""

from __future__ import annotations

from collections.abc import Callable

from ...core.backend.back_end import BackEnd
from ...core.config.stages import Config
from ...core.keyframe import Correction
from .back_end_worker import BackEndWorker, NoLoops


def make_loops(
    config: Config, on_correction: Callable[[Correction, int], object], warn: Callable[[str], None]
) -> BackEndWorker | NoLoops:
    """Return the back end's thread, or its replacement; arguments as of `BackEndWorker`."""
    if not config.backend.loops:
        return NoLoops()
    return BackEndWorker(BackEnd, on_correction, warn)
