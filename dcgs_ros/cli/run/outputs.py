# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The files that a run writes: trajectories, frames.csv, config.yaml, plot and report."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from ...core.config.stages import Config
from ...core.tracking.result import TrackingState
from ...core.trajectory import Trajectory
from ...evaluation.report import RunRecord, SkippedFrame, TrackedFrame
from ...io.config_file import write_config
from ...io.trajectory import format_stamp_ns, write_tum
from ...io.whole_files import replacing

_KAPPAS = ('kappa', 'kappa_without_radius', 'kappa_rotation', 'kappa_translation')
_WEAKEST = tuple(f'weakest_{kind}{axis}' for kind in 'tr' for axis in 'xyz')
COLUMNS = (
    'index', 'stamp', 'state', 'tracked', 'keyframe', 'points', 'inliers', 'landmarks', 'ms',
    *_KAPPAS, *_WEAKEST, 'sigma_translation_m', 'sigma_rotation_rad', 'colour_depth_offset_ms',
    'gaussians', 'reason',
)  # fmt: skip


def write_tracks(folder: Path, record: RunRecord, config: Config) -> None:
    """Write the trajectory, the keyframes, a line per frame, and the configuration as used."""
    write_tum(folder / 'trajectory.tum', record.trajectory())
    write_tum(folder / 'keyframes.tum', record.keyframes())
    _write_frames(folder / 'frames.csv', record)
    write_config(folder / 'config.yaml', config)


def write_plot(folder: Path, record: RunRecord, truth: Trajectory | None) -> None:
    """Draw the trajectory, aligned to the ground truth if there is one to compare with."""
    from ...evaluation.plots import plot_trajectory  # imports matplotlib, which is slow to load

    title = f'{record.source}, {record.ablation}'
    plot_trajectory(folder / 'trajectory.png', record.trajectory(), truth, title)


def write_report(folder: Path, report: dict[str, Any]) -> None:
    """Write the report, replacing an earlier one of the same run."""
    text = json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False)
    with replacing(folder / 'report.json') as path:
        path.write_text(text + '\n', encoding='utf-8')


def _write_frames(path: Path, record: RunRecord) -> None:
    """Write a line per frame in the order of the source; unknown values are left empty."""
    rows = {frame.index: _tracked_row(frame) for frame in record.tracked}
    rows |= {frame.index: _skipped_row(frame) for frame in record.skipped}
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.DictWriter(file, COLUMNS, restval='', lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows[index] for index in sorted(rows))


def _tracked_row(frame: TrackedFrame) -> dict[str, str | int]:
    """Return the columns of a tracked frame; sigmas are square roots of covariance traces."""
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


def _skipped_row(frame: SkippedFrame) -> dict[str, str | int]:
    stamp = '' if frame.stamp_ns is None else format_stamp_ns(frame.stamp_ns)
    return {
        'index': frame.index,
        'stamp': stamp,
        'state': 'skipped',
        'tracked': 0,
        'keyframe': 0,
        'reason': f'{frame.name}: {frame.reason}',
    }
