# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker's health and figures, as /diagnostics shows them; no ROS in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.tracking.result import TrackingState, TrackResult
from ..health import Level, Verdict

_SILENT_S = 2.0  # without images: the camera is gone
_FEW = 4  # images since the last report of which none need form a pair
_DROPPING = 0.05  # share of the pairs since the last report that is worth a warning
_AXES = ('x', 'y', 'z', 'turning about x', 'turning about y', 'turning about z')


@dataclass(frozen=True)
class Streams:
    """Images and pairs since the last report, and how long nothing has come."""

    color: int
    depth: int
    pairs: int
    dropped: int  # pairs that newer ones pushed out
    has_camera: bool
    silent_s: float


def judge(streams: Streams, result: TrackResult | None, searching: bool) -> Verdict:
    """Return how tracking goes, and what to check where it does not."""
    alone = not streams.pairs and streams.color + streams.depth > _FEW
    if streams.silent_s > _SILENT_S or alone or result is None:
        return Verdict(Level.ERROR, _what_is_missing(streams))
    if result.state is TrackingState.LOST:
        where = 'looking for the camera in the map' if searching else 'lost'
        return Verdict(Level.ERROR, f'{where}: move back to where it was tracked, or call ~/reset')
    if result.state is TrackingState.RELOCALISED:
        return Verdict(Level.WARN, 'found again in the map, to be confirmed by the next frames')
    if result.state is TrackingState.DEGENERATE:
        assert result.observability is not None
        axis = weakest_axis(result.observability.weakest)
        return Verdict(Level.WARN, f'degenerate: hardly anything in view fixes {axis}')
    if streams.dropped > _DROPPING * max(streams.pairs, 1):
        return Verdict(Level.WARN, f'{streams.dropped} of {streams.pairs} pairs dropped: too slow')
    return Verdict(Level.OK, 'tracking')


def _what_is_missing(streams: Streams) -> str:
    """Return which topic is silent, and what to check."""
    if not streams.has_camera:
        return 'no camera_info: is the camera running, and are the topics remapped?'
    if not streams.color and not streams.depth:
        return f'no images for {streams.silent_s:.1f} s: is the camera running?'
    if not streams.color:
        return 'depth comes, but no colour: check the colour topic and its reliability'
    if not streams.depth:
        return 'colour comes, but no depth: is align_depth.enable set?'
    if not streams.pairs:
        return 'colour and depth come, but no two within node.sync_slop_s'
    return 'images come, but none could be used: see the log'


def weakest_axis(direction: NDArray[np.floating]) -> str:
    """Return the name of the camera's axis nearest to a direction (6,), translation first."""
    return f"the camera's {_AXES[int(np.argmax(np.abs(direction)))]}"


def numbers(result: TrackResult) -> dict[str, Any]:
    """Return the figures of one frame."""
    shown: dict[str, Any] = {
        'state': result.state.value,
        'inliers': result.inliers,
        'points': result.points,
        'landmarks': result.landmarks,
        'colour_depth_offset_ms': float(result.colour_depth_offset_ms),
    }
    if result.observability is not None:
        shown['kappa'] = float(result.observability.kappa)
        shown['kappa_without_radius'] = float(result.observability.kappa_without_radius)
        shown['weakest'] = weakest_axis(result.observability.weakest)
    return shown
