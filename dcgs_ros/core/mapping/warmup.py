# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Compiles the mapper's kernels, or loads them, before the first keyframe has to wait for it."""

from __future__ import annotations

from ..camera import PinholeCamera
from ..config.schema import override
from ..config.stages import Config
from ..kernels.workers import Workers
from ..slam import Lockstep
from ..tracking.tracker import Tracker
from ..tracking.warmup import EVERY_FRAME, frames, warm_up_now_and_then
from .mapper import Mapper

# Coarse steps and then full ones, few Gaussians, and what else comes up in a run now and then.
_A_BIT_OF_ALL = {
    'mapping.view_interval': 1,
    'mapping.steps_per_frame': 1.0,
    'mapping.final_steps': 5,
    'mapping.coarse_share': 1.0,
    'mapping.spawn_stride_px': 32,
    'mapping.prune_interval': 4,
    'mapping.image_memory_mb': 1.0,
}


def warm_up_with_mapper(camera: PinholeCamera, config: Config) -> None:
    """Track and map a few frames, so that every kernel of `Mapper` has run as well."""
    config = override(config, EVERY_FRAME | _A_BIT_OF_ALL)
    tracker = Tracker(camera, config)
    mapping = Lockstep(tracker, Mapper(camera, config, workers=Workers(1)))
    for frame in frames(camera, config.sensor):
        mapping.after(frame, tracker.track(frame))
        mapping.advance()
    for _ in mapping.finish():
        pass
    warm_up_now_and_then(tracker)
