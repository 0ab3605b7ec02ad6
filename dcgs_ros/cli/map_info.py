# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs info MAP`: what is in a map file."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from ..core.camera import PinholeCamera
from ..core.sensor import SensorNoise
from ..io.map_archive import SavedMap, read_map
from .tables import Row, table

MAP_SUFFIX = '.dcgs'
_CLOCK_NS = 10**18  # of 2001: lower stamps count from an arbitrary start


def describe_map(path: Path) -> int:
    """Print what is in a map and return the exit status.

    Raises `MapFileError` for a file that is damaged or no map.
    """
    saved = read_map(path)
    own = int(np.count_nonzero(saved.ids < 0))
    keyframes = sum(view.keyframe >= 0 for view in saved.keyframes)
    rows: list[Row] = [
        ('size', f'{1e-6 * path.stat().st_size:.1f} MB'),
        ('format', f'version {saved.version}'),
        ('digest', 'none: the file is of version 1' if saved.version == 1 else 'ok'),
        ('Gaussians', f'{len(saved.ids)}: {len(saved.ids) - own} of the tracker, {own} added'),
        ('tracker', f'{len(saved.tracker.ids)} Gaussians, {len(saved.tracker.poses)} keyframes'),
        ('views', f'{len(saved.keyframes)}: {keyframes} keyframes and others between them'),
        ('sub-maps', f'{len(np.unique(saved.tracker.submaps))}'),
        ('landmarks', f'{len(saved.landmarks)}'),
        ('extent', _extent(saved)),
    ]
    rows += [row for number in range(len(saved.sessions)) for row in _session(saved, number)]
    print(table(path.name, rows), flush=True)
    return 0


def camera_text(camera: PinholeCamera) -> str:
    """Return size, intrinsics and distortion for the user."""
    lens = ' '.join(f'{k:g}' for k in camera.distortion)
    return (
        f'{camera.width}x{camera.height}; fx {camera.fx:g} fy {camera.fy:g} cx {camera.cx:g} '
        f'cy {camera.cy:g}; ' + (f'distortion {lens}' if lens else 'no distortion')
    )


def sensor_text(sensor: SensorNoise) -> str:
    """Return noise and range of depth for the user."""
    return (
        f'sigma(z) = {1e3 * sensor.a_m:g} mm + {1e3 * sensor.b_per_m:.3g} mm/m^2 z^2, used from '
        f'{sensor.depth_min_m:g} to {sensor.depth_max_m:g} m'
    )


def _extent(saved: SavedMap) -> str:
    """Return the box around the Gaussians of each sub-map, the largest first."""
    tracker = saved.tracker
    boxes = []
    for submap in np.unique(tracker.submaps):
        means = tracker.means[tracker.submaps[tracker.hosts] == submap]
        if len(means):
            boxes.append(np.ptp(means, axis=0))
    boxes.sort(key=lambda box: -float(box.prod()))
    return '; '.join(' x '.join(f'{side:.1f}' for side in box) + ' m' for box in boxes) or 'none'


def _session(saved: SavedMap, number: int) -> list[Row]:
    session = saved.sessions[number]
    return [
        (f'session {number + 1}', f'{session.name or "unnamed"}, {_when(saved, number)}'),
        ('', f'{session.keyframes} keyframes, {session.views} views'),
        ('', camera_text(session.camera)),
        ('', sensor_text(session.sensor)),
    ]


def _when(saved: SavedMap, number: int) -> str:
    """Return when the first and the last keyframe were recorded, by their stamps."""
    first = sum(s.keyframes for s in saved.sessions[:number])
    stamps = saved.tracker.stamps_ns[first : first + saved.sessions[number].keyframes]
    if not len(stamps):
        return 'no keyframes'
    seconds = f'{1e-9 * float(stamps.max() - stamps.min()):.1f} s'
    if stamps.min() < _CLOCK_NS:
        return f'{seconds}, stamps without a date'
    begun = datetime.fromtimestamp(int(stamps.min()) // 10**9, timezone.utc)
    return f'{begun:%Y-%m-%d %H:%M:%S} UTC, {seconds}'
