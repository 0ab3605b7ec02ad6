# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Compiles the back end's kernels before the first keyframe."""

from __future__ import annotations

import numpy as np

from ..camera import PinholeCamera
from ..config.schema import override
from ..config.stages import Config
from ..tracking.tracker import Tracker
from ..tracking.warmup import EVERY_FRAME, frames
from .alignment import Alignment
from .back_end import BackEnd
from .closure import Closures
from .keyframe_graph import warm_up as warm_up_graph


def warm_up(camera: PinholeCamera) -> None:
    """Run every kernel of the back end with the types it will see, on frames of a plane.

    They do not depend on the settings, with which nothing need be tracked. Takes a fraction of a
    second once the kernels are in the cache on disk.
    """
    config = Config()
    back_end, tracker = BackEnd(camera, config), Tracker(camera, override(config, EVERY_FRAME))
    closures = Closures(camera, config)
    for frame in frames(camera, config.sensor):
        for keyframe in tracker.track(frame).keyframes:
            back_end.add(keyframe)
            closures.add(keyframe)
    back_end.work()
    back_end.optimised()
    back_end.places.recognise(frame)
    last = tracker.keyframes - 1  # of those between, which show the same, nothing is kept
    first = np.arange(min(len(closures.places.features_of(k)) for k in (0, last)))
    closures.verified(0, last, Alignment(np.eye(4), len(first), first, first))
    warm_up_graph()
