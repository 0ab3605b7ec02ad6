# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A tracker in a synthetic room, before its next frame; rendered and tracked once a process."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.synthetic.source import SyntheticSource

SEEN = 5  # frames that the tracker has seen
SOURCE = SyntheticSource.from_address('synthetic:room?frames=8&sensor=kinect')


@cache
def frames() -> tuple[RgbdFrame, ...]:
    return tuple(SOURCE)


@cache
def tracker() -> Tracker:
    """Return a tracker that has seen the first frames; no test lets it see another."""
    made = Tracker(SOURCE.camera, replace(Config(), sensor=SOURCE.sensor))
    for frame in frames()[:SEEN]:
        made.track(frame)
    return made
