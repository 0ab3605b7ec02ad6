# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker's health and figures, as /diagnostics shows them; no ROS in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.tracking.result import TrackingState, TrackResult
from ..health import Level, Verdict

_SILENT_S = 2.0  # without images: the camera is gone
_FEW = 4  # images since the last report of which none need form a pair
_DROPPING = 0.05  # share of the pairs since the last report that is worth a warning
_OTHER_CLOCK_S = 1.0  # between stamps: no camera is that late
_AXES = ('x', 'y', 'z', 'turning about x', 'turning about y', 'turning about z')


@dataclass(frozen=True)
class Topic:
    """A topic of the camera, and who publishes it."""

    name: str
    publishers: int
    incompatible: bool = False  # published best effort, but subscribed to as reliable

    def why_silent(self) -> str:
        """Return why nothing comes, and what to do about it."""
        if not self.publishers:
            return f'nobody publishes {self.name}: is the camera running, and the topic remapped?'
        if self.incompatible:
            return f'{self.name} is published best effort: set node.reliability to best_effort'
        return f'{self.name} has a publisher that sends nothing: is the camera running?'


@dataclass(frozen=True)
class Streams:
    """Images and pairs since the last report, and how long nothing has come."""

    color: int
    depth: int
    pairs: int
    dropped: int  # pairs that newer ones pushed out
    has_camera: bool
    silent_s: float
    unstamped: int = 0  # images with a stamp of zero
    apart_s: float = 0.0  # the newest stamp of colour after that of depth
    refused_camera: str = ''  # why the last camera_info could not be used
    topics: Mapping[str, Topic] = field(default_factory=dict)  # by 'color', 'depth', 'camera_info'

    def why(self, stream: str, otherwise: str) -> str:
        """Return why nothing comes on a topic, where its publishers are known."""
        topic = self.topics.get(stream)
        return otherwise if topic is None else topic.why_silent()


def judge(
    streams: Streams,
    result: TrackResult | None,
    searching: bool,
    *,
    ever_tracked: bool = True,
    refusal: str = '',
    doubt: str | None = None,
    priors: Mapping[str, str] | None = None,
) -> Verdict:
    """Return how tracking goes, and what to check where it does not.

    `refusal` says why the last frame was refused, `doubt` what is not known of the frames, such as
    where the camera is on the base, `priors` of each sensor that is asked for whether it is used,
    or why not.
    """
    alone = not streams.pairs and streams.color + streams.depth > _FEW
    if streams.silent_s > _SILENT_S or alone or result is None:
        missing = _what_is_missing(streams)
        if missing is not None:
            return missing
    if result is None:
        text = doubt or f'images come, but none could be used: {refusal or "see the log"}'
        return Verdict(Level.WARN if doubt else Level.ERROR, text, logged=True)
    if result.state is TrackingState.LOST:
        return _lost(searching, ever_tracked)
    if result.state is TrackingState.RELOCALISED:
        return Verdict(Level.WARN, 'found again in the map, to be confirmed by the next frames')
    if result.state is TrackingState.DEGENERATE:
        if result.observability is None:
            return Verdict(
                Level.WARN, 'degenerate: the images show nothing new, or nothing at all'
            )
        axis = weakest_axis(result.observability.weakest)
        return Verdict(Level.WARN, f'degenerate: hardly anything in view fixes {axis}')
    if result.submap:
        text = 'tracking in new surroundings, of which the place in the map is not known yet'
        return Verdict(Level.WARN, f'{text}: move to where the map is for ~/pose to go on')
    if streams.dropped > _DROPPING * max(streams.pairs, 1):
        text = f'{streams.dropped} of {streams.pairs} pairs dropped: too slow for this camera'
        return Verdict(Level.WARN, f'{text}; lower its rate or resolution')
    if doubt:
        return Verdict(Level.WARN, f'tracking, but {doubt}', logged=True)
    unused = [f'{name}: {why}' for name, why in (priors or {}).items() if why != 'used']
    if unused:
        return Verdict(Level.WARN, f'tracking, but without {"; without ".join(unused)}')
    return Verdict(Level.OK, 'tracking')


def _lost(searching: bool, ever_tracked: bool) -> Verdict:
    """Return what to do about a camera whose place is not known."""
    if ever_tracked:
        where = 'looking for the camera in the map' if searching else 'lost'
        text = f'{where}: move back to where it was tracked, or call ~/reset'
        return Verdict(Level.ERROR, text, logged=True)
    if searching:
        return Verdict(
            Level.ERROR,
            "looking for the camera in the mapper's map, where it has not been tracked yet: move "
            'to a place of that map, or call ~/reset to begin a new one',
        )
    return Verdict(
        Level.ERROR,
        'no map can begin, for want of depth: uncover the camera, point it at surfaces within '
        'sensor.depth_min_m and depth_max_m, and check the unit of depth',
    )


def _what_is_missing(streams: Streams) -> Verdict | None:
    """Return which topic is silent or useless, and what to check; None where all is there."""
    if not streams.has_camera and streams.refused_camera:
        text = f'camera_info refused: {streams.refused_camera}; correct the calibration'
        return Verdict(Level.ERROR, text, logged=True)
    if not streams.has_camera:
        why = streams.why('camera_info', 'is the camera running, and are the topics remapped?')
        return Verdict(Level.ERROR, f'no camera_info: {why}')
    if not streams.color and not streams.depth:
        why = streams.why('color', 'is the camera running?')
        return Verdict(Level.ERROR, f'no images for {streams.silent_s:.1f} s: {why}')
    if not streams.color:
        why = streams.why('color', 'check the colour topic and its reliability')
        return Verdict(Level.ERROR, f'depth comes, but no colour: {why}')
    if not streams.depth:
        why = streams.why('depth', 'is align_depth.enable set?')
        return Verdict(Level.ERROR, f'colour comes, but no depth: {why}')
    return None if streams.pairs else Verdict(Level.ERROR, _why_unpaired(streams))


def _why_unpaired(streams: Streams) -> str:
    """Return why no image has a partner, and what to do about it."""
    if streams.unstamped:
        return (
            f'{streams.unstamped} images have no stamp (0 s), and cannot be paired by it: have '
            "the camera's driver stamp them"
        )
    apart = f'their newest stamps are {abs(streams.apart_s):.3f} s apart'
    come = f'colour and depth come, but no two within node.sync_slop_s: {apart}'
    if abs(streams.apart_s) > _OTHER_CLOCK_S:
        return f"{come}, as of two clocks: have the camera's driver stamp both with one"
    return f'{come}: synchronise them in the camera, or raise node.sync_slop_s'


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
        'submap': result.submap,
        'sigma_m': _largest_sigma(result.covariance[:3, :3]),
        'sigma_deg': math.degrees(_largest_sigma(result.covariance[3:, 3:])),
        'colour_depth_offset_ms': float(result.colour_depth_offset_ms),
    }
    if result.observability is not None:
        shown['kappa'] = float(result.observability.kappa)
        shown['kappa_without_radius'] = float(result.observability.kappa_without_radius)
        shown['weakest'] = weakest_axis(result.observability.weakest)
    return shown


def _largest_sigma(covariance: NDArray[np.floating]) -> float:
    """Return the standard deviation along the direction that is the least certain."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
