# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""One line a frame, for spreadsheets and plots."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ...core.tracking.tracker import TrackingState
from ...evaluation.report import RunRecord, SkippedFrame, TrackedFrame
from ...io.trajectory import format_stamp_ns

_KAPPAS = ('kappa', 'kappa_without_radius', 'kappa_rotation', 'kappa_translation')
_WEAKEST = tuple(f'weakest_{kind}{axis}' for kind in 'tr' for axis in 'xyz')
COLUMNS = (
    'index', 'stamp', 'state', 'tracked', 'keyframe', 'points', 'inliers', 'landmarks', 'ms',
    *_KAPPAS, *_WEAKEST, 'sigma_translation_m', 'sigma_rotation_rad', 'colour_depth_offset_ms',
    'gaussians', 'reason',
)  # fmt: skip


def write_frames(path: Path, record: RunRecord) -> None:
    """Write all frames in the order of the source; what a frame does not have is left empty."""
    rows = {frame.index: _tracked(frame) for frame in record.tracked}
    rows |= {frame.index: _skipped(frame) for frame in record.skipped}
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, COLUMNS, restval='', lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows[index] for index in sorted(rows))


def _tracked(frame: TrackedFrame) -> dict[str, str | int]:
    """Sigmas are the roots of the covariance blocks' traces."""
    result, seen = frame.result, frame.result.observability
    row: dict[str, str | int] = {
        'index': frame.index,
        'stamp': format_stamp_ns(result.stamp_ns),
        'state': result.state.value,
        'tracked': int(result.state is not TrackingState.LOST),
        'keyframe': int(result.keyframe),
        'points': result.points,
        'inliers': result.inliers,
        'landmarks': result.landmarks,
        'ms': f'{1e3 * frame.seconds:.3f}',
        'sigma_translation_m': f'{np.sqrt(np.trace(result.covariance[:3, :3])):.6g}',
        'sigma_rotation_rad': f'{np.sqrt(np.trace(result.covariance[3:, 3:])):.6g}',
        'colour_depth_offset_ms': f'{result.colour_depth_offset_ms:.4f}',
        'gaussians': frame.gaussians,
    }
    if seen is not None:
        row |= {name: f'{getattr(seen, name):.6g}' for name in _KAPPAS}
        row |= {name: f'{x:.6f}' for name, x in zip(_WEAKEST, seen.weakest, strict=True)}
    return row


def _skipped(frame: SkippedFrame) -> dict[str, str | int]:
    stamp = '' if frame.stamp_ns is None else format_stamp_ns(frame.stamp_ns)
    return {
        'index': frame.index,
        'stamp': stamp,
        'state': 'skipped',
        'tracked': 0,
        'keyframe': 0,
        'reason': f'{frame.name}: {frame.reason}',
    }
