# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""frames.csv: a line for each frame of a run."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError
from ..core.tracking.result import TrackingState
from ..evaluation.report import RunRecord, SkippedFrame, TrackedFrame
from ..io.trajectory import format_stamp_ns, parse_stamp_ns
from ..io.whole_files import replacing

_KAPPAS = ('kappa', 'kappa_without_radius', 'kappa_rotation', 'kappa_translation')
_SKIPPED = 'skipped'  # in place of a state
_WEAKEST = tuple(f'weakest_{kind}{axis}' for kind in 'tr' for axis in 'xyz')
COLUMNS = (
    'index', 'stamp', 'state', 'tracked', 'keyframe', 'submap', 'revision', 'points', 'inliers',
    'landmarks', 'ms', *_KAPPAS, *_WEAKEST, 'sigma_translation_m', 'sigma_rotation_rad',
    'sigma_world_translation_m', 'sigma_world_rotation_rad', 'colour_depth_offset_ms', 'gaussians',
    'reason',
)  # fmt: skip


class FramesFileError(DcgsError):
    """A frames.csv cannot be read."""


@dataclass(frozen=True)
class FrameClaims:
    """What a frames.csv says of the frames that the tracker accepted, and of which there were."""

    stamps_ns: NDArray[np.int64]  # (N,)
    states: tuple[TrackingState, ...]
    sigmas_m: NDArray[np.float64]  # (N,)
    worlds: NDArray[np.int64]  # (N,) poses of different numbers are not in one world
    all_ns: NDArray[np.int64]  # (M,) stamps of all frames that have one, skipped ones included


def read_frames(path: Path) -> FrameClaims:
    """Read states and sigmas. Raises `FramesFileError` naming the line that is wrong."""
    stamps, states, sigmas, worlds, skipped = [], [], [], [], []
    with path.open(encoding='utf-8', errors='replace', newline='') as file:
        for number, row in enumerate(csv.DictReader(file), start=2):
            try:
                if row['state'] == _SKIPPED:
                    skipped += [parse_stamp_ns(row['stamp'])] if row['stamp'] else []
                    continue
                states.append(TrackingState(row['state']))
                stamps.append(parse_stamp_ns(row['stamp']))
                sigmas.append(float(row['sigma_translation_m']))
                worlds.append((int(row.get('submap') or 0), int(row.get('revision') or 0)))
            except (KeyError, TypeError, ValueError) as error:
                raise FramesFileError(f'{path}:{number}: {error}') from None
    all_ns = np.array(sorted(stamps + skipped), np.int64)
    numbers = {world: number for number, world in enumerate(sorted(set(worlds)))}
    return FrameClaims(
        np.array(stamps, np.int64), tuple(states), np.array(sigmas),
        np.array([numbers[world] for world in worlds], np.int64), all_ns,
    )  # fmt: skip


def write_frames(path: Path, record: RunRecord) -> None:
    """Write a line per frame in the order of the source; unknown values are left empty."""
    rows = {frame.index: _tracked_row(frame) for frame in record.tracked}
    rows |= {frame.index: _skipped_row(frame) for frame in record.skipped}
    with (
        replacing(path) as temporary,
        temporary.open('w', encoding='utf-8', newline='') as file,
    ):
        writer = csv.DictWriter(file, COLUMNS, restval='', lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows[index] for index in sorted(rows))


def _tracked_row(frame: TrackedFrame) -> dict[str, str | int]:
    """Return the columns of a tracked frame; sigmas are square roots of covariance traces."""
    result, seen, reference = frame.result, frame.result.observability, frame.result.reference
    row: dict[str, str | int] = {
        'index': frame.index,
        'stamp': format_stamp_ns(result.stamp_ns),
        'state': result.state.value,
        'tracked': int(result.state is not TrackingState.LOST),
        'keyframe': int(result.keyframe),
        'submap': result.submap,
        'revision': 0 if reference is None else reference.revision,
        'points': result.points,
        'inliers': result.inliers,
        'landmarks': result.landmarks,
        'ms': f'{1e3 * frame.seconds:.3f}',
        **_sigmas('sigma', result.covariance),
        **_sigmas('sigma_world', result.covariance_world),
        'colour_depth_offset_ms': f'{result.colour_depth_offset_ms:.4f}',
        'gaussians': frame.gaussians,
    }
    if seen is not None:
        row |= {name: f'{getattr(seen, name):.6g}' for name in _KAPPAS}
        row |= {name: f'{x:.6f}' for name, x in zip(_WEAKEST, seen.weakest, strict=True)}
    return row


def _sigmas(name: str, covariance: NDArray[np.floating]) -> dict[str, str]:
    """Return the columns of a covariance (6, 6)."""
    return {
        f'{name}_translation_m': f'{np.sqrt(np.trace(covariance[:3, :3])):.6g}',
        f'{name}_rotation_rad': f'{np.sqrt(np.trace(covariance[3:, 3:])):.6g}',
    }


def _skipped_row(frame: SkippedFrame) -> dict[str, str | int]:
    stamp = '' if frame.stamp_ns is None else format_stamp_ns(frame.stamp_ns)
    return {
        'index': frame.index,
        'stamp': stamp,
        'state': _SKIPPED,
        'tracked': 0,
        'keyframe': 0,
        'reason': f'{frame.name}: {frame.reason}',
    }
